"""What a run says, whatever it says: it becomes events that can be told, and the run has one end."""

import asyncio
import json
from collections import Counter
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.model import Need, Phase, RunEvent, RunEventKind, RunRequest
from appliance.pool.container import LOST, Connection, Ending
from appliance.pool.conversation import Call, Conversation

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


async def converse(bodies: list[bytes], refused: Counter[str] | None = None) -> tuple[RunEvent, list[RunEvent]]:
    """Have a run say this; returns its last event and those before."""
    reader = asyncio.StreamReader()
    for body in bodies:
        reader.feed_data(len(body).to_bytes(4, "big") + body)
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


@pytest.mark.parametrize("at", [0, -1, 1e300, 10**400, "x", None, True])
def test_a_start_is_when_it_can_have_been(at: Any) -> None:
    """A handler that lies about when it began is taken to have begun when it said so."""
    body = json.dumps({"ev": "started", "at": at}).encode()
    _, (started,) = asyncio.run(converse([body]))
    assert started.startup_ms is not None
    assert 0 < started.startup_ms < 1e15
