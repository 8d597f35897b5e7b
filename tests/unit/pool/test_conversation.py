"""What a run says, whatever it says: it becomes events that can be told, and the run has one end."""

import asyncio
import json
from collections import Counter
from collections.abc import Sequence
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.model import Need, Phase, RunEvent, RunEventKind, RunRequest
from appliance.pool.container import LOST, Connection, Ending
from appliance.pool.runner.frames import MAX_FRAME
from appliance.pool.runs import MOST_CALLS, Call, Conversation

KINDS = ("started", "progress", "log", "alive", "partial", "checkpoint", "call", "result", "error")
NAMES = (
    "at",
    "fraction",
    "note",
    "text",
    "fields",
    "result",
    "data",
    "calls",
    "n",
    "name",
    "args",
    "cpu_ms",
    "peak_mb",
)
NAMES += ("code", "message", "remedy", "retryable", "trace")
ANY_TEXT = st.text(st.characters(), max_size=5)
"""Halves of surrogate pairs among it."""
NUMBERS = st.one_of(st.integers(), st.floats(), st.sampled_from([10**400, -(10**400), 2**64, 1e308]))
VALUES = st.recursive(
    st.one_of(st.none(), st.booleans(), NUMBERS, ANY_TEXT, st.just({"$b64": "QQ=="}), st.just({"$b64": "?"})),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(ANY_TEXT, inner, max_size=3)),
    max_leaves=6,
)
FRAMES = st.dictionaries(st.sampled_from(NAMES), VALUES, max_size=4).flatmap(
    lambda fields: st.one_of(st.sampled_from(KINDS), VALUES).map(lambda kind: {"ev": kind, **fields})
)
ENTERED_NS = 1_000


class Listener:
    """The other end of a connection, which takes what is sent."""

    def write(self, data: bytes) -> None:
        """Take it."""

    async def drain(self) -> None:
        """Never full."""


async def lost() -> Ending:
    """Nobody knows how the container ended."""
    return LOST


async def converse(
    bodies: list[bytes], refused: Counter[str] | None = None, raw: Sequence[bytes] = ()
) -> tuple[RunEvent, list[RunEvent]]:
    """Have a run say this; returns its last event and those before."""
    reader = asyncio.StreamReader()
    for body in bodies:
        reader.feed_data(len(body).to_bytes(4, "big") + body)
    for piece in raw:
        reader.feed_data(piece)
    reader.feed_eof()
    events: list[RunEvent] = []

    async def answer(call: Call) -> dict[str, Any]:
        return {"name": call.name}

    conversation = Conversation(
        Connection(reader, Listener()),  # type: ignore[arg-type]
        RunRequest(task="t", subtask="s", attempt=1, skill="probe", need=Need(image="base")),
        gateway="g1",
        container="c1",
        phase=Phase.LOCAL_WARM,
        entered_ns=ENTERED_NS,
        on_event=events.append,
        on_call=answer,
        refused=refused if refused is not None else Counter(),
        ending=lost,
    )
    return await conversation.listen(), events


@given(st.lists(FRAMES, max_size=4))
def test_whatever_a_handler_says_its_run_has_one_end(frames: list[dict[str, Any]]) -> None:
    """Numbers without bounds, no numbers, broken text, unknown things: each ends it or is left out; all can be told."""
    final, events = asyncio.run(converse([json.dumps(each).encode() for each in frames]))
    assert final.kind in (RunEventKind.SUCCEEDED, RunEventKind.FAILED)
    for event in (*events, final):
        assert msgspec.json.decode(msgspec.json.encode(event), type=RunEvent).kind is event.kind


@given(st.lists(FRAMES, max_size=4))
def test_whatever_is_left_out_is_counted_and_told(frames: list[dict[str, Any]]) -> None:
    """News and results of a wrong type, unknown events: none is lost without a count, and each failure says what."""
    refused: Counter[str] = Counter()
    final, events = asyncio.run(converse([json.dumps(each).encode() for each in frames], refused))
    assert final.kind in (RunEventKind.SUCCEEDED, RunEventKind.FAILED)
    if final.failure is not None:
        assert final.failure.code
        assert final.failure.message
    heard = []  # what was read: all up to the frame that ended the run
    for each in frames:
        heard.append(each)
        if each["ev"] in ("result", "error") or each["ev"] not in KINDS:
            break
    broken = "runner frame" in refused
    if not broken:
        wrong = sum(each["ev"] == "partial" and not is_table(each, "result") for each in heard)
        wrong += sum(
            each["ev"] == "checkpoint" and not (is_table(each, "data") and is_count(each.get("calls", 0)))
            for each in heard
        )
        wrong += sum(each["ev"] == "progress" and not is_number(each.get("fraction", 0.0)) for each in heard)
        bare = sum(
            each["ev"] == "log" and each.get("fields") is not None and not is_table(each, "fields") for each in heard
        )
        assert refused["run news"] == wrong + bare
        assert sum("was left out" in event.note for event in events) >= wrong
        results = [each for each in heard if each["ev"] == "result"]
        assert refused["result"] == sum(not is_table(each, "result") for each in results)
        if results:
            assert (final.kind is RunEventKind.SUCCEEDED) == is_table(results[0], "result")


def is_table(frame: dict[str, Any], key: str) -> bool:
    """Whether a frame has a table there; one that stands for bytes is none."""
    value = frame.get(key)
    return isinstance(value, dict) and not (len(value) == 1 and isinstance(value.get("$b64"), str))


def is_count(value: Any) -> bool:
    """Whether it can be a number of calls."""
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= MOST_CALLS


def is_number(value: Any) -> bool:
    """Whether it is a number."""
    return isinstance(value, int | float) and not isinstance(value, bool)


@st.composite
def streams(draw: st.DrawFn) -> tuple[bytes, bool]:
    """Return bytes as a runner may send them, and whether they are whole frames of JSON objects to the end."""
    parts: list[bytes] = []
    whole = True
    for _ in range(draw(st.integers(0, 4))):
        kind = draw(st.sampled_from(["news", "news", "bytes", "list", "long", "cut"]))
        body = json.dumps({"ev": "progress", "fraction": 0.5}).encode()
        if kind == "bytes":
            body = draw(st.binary(min_size=1, max_size=30))
        elif kind == "list":
            body = json.dumps([body.decode()]).encode()
        length = len(body)
        if kind == "long":
            length = draw(st.integers(MAX_FRAME + 1, 2**32 - 1))
        elif kind == "cut":
            length += draw(st.integers(1, 2**20))
        whole = whole and kind == "news"
        parts.append(length.to_bytes(4, "big") + body)
        if not whole:
            break
    return b"".join(parts), whole


@given(streams(), st.integers(1, 64))
def test_bytes_that_are_no_frames_end_the_run_with_one_counted_error(stream: tuple[bytes, bool], step: int) -> None:
    """Malformed, cut off or longer than any frame, in pieces of any size: counted once, with a reason and a remedy."""
    data, whole = stream
    refused: Counter[str] = Counter()
    final, _ = asyncio.run(converse([], refused, raw=[data[at : at + step] for at in range(0, len(data), step)]))
    assert final.kind is RunEventKind.FAILED
    assert final.failure is not None
    assert final.failure.message
    assert final.failure.remedy
    assert (final.failure.code, refused["runner frame"]) == (("pool", 0) if whole else ("payload", 1))


@pytest.mark.parametrize("at", [0, -1, 1e300, 10**400, "x", None, True])
def test_a_start_is_when_it_can_have_been(at: Any) -> None:
    """A handler that lies about when it began is taken to have begun when it said so."""
    body = json.dumps({"ev": "started", "at": at}).encode()
    _, (started,) = asyncio.run(converse([body]))
    assert started.startup_ms is not None
    assert 0 < started.startup_ms < 1e15
