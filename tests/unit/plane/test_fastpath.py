"""What is heard of the copies of one decision is counted once, in whatever order and on whatever threads it comes."""

import threading
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import ConflictError, DeadlineError, PrerequisiteError, SwiftbotError
from appliance.model import encode
from appliance.plane.fastpath import STORED, Copies
from appliance.plane.messages import Found
from appliance.plane.versions import Record, Write

ASKED = Write(key="k", value=b"v", write="w")
RECORD = Record(key="k", value=b"v", version={"a": 1}, write="w")
OTHER = encode(Found(Record(key="k", value=b"x", version={"b": 1})))
FULL = PrerequisiteError("the disk is full")
LATE = DeadlineError("no answer")


def _copies(ended: list[Copies], *others: str) -> Copies:
    return Copies(ASKED, others, ended.append, lambda _: None)


def test_the_ordinary_write() -> None:
    """It is over when its own copy and all others are on disks, not before, and all have what was decided."""
    ended: list[Copies] = []
    copies = _copies(ended, "b", "c")
    copies.heard("b", STORED)
    copies.committed(RECORD, None)
    assert ended == []
    copies.heard("c", STORED)
    assert ended == [copies]
    assert copies.stored
    assert copies.record == RECORD


def test_a_gateway_alone() -> None:
    """With no other replica its own copy is all there is to wait for."""
    ended: list[Copies] = []
    _copies(ended).committed(RECORD, None)
    assert [each.stored for each in ended] == [True]


_EVENT = st.one_of(
    st.tuples(st.just("heard"), st.sampled_from("bcdx"), st.sampled_from([STORED, OTHER, b"", LATE])),
    st.tuples(st.just("give_up")),
    st.tuples(st.just("committed"), st.sampled_from([None, FULL, ValueError("odd")])),
    st.tuples(st.just("abandon")),
)


@given(st.lists(_EVENT, max_size=12))
def test_it_ends_once(events: list[tuple[Any, ...]]) -> None:
    """Whatever comes: it ends at most once, and just when its own copy failed, or that and all answers are there."""
    ended: list[Copies] = []
    copies = _copies(ended, "b", "c", "d")
    first: dict[str, bytes | SwiftbotError] = {}
    committed, failed, told, abandoned = False, False, 0, False
    for kind, *rest in events:
        if kind == "heard":
            copies.heard(*rest)
            if rest[0] != "x":
                first.setdefault(*rest)
        elif kind == "give_up":
            copies.give_up(LATE)
            for name in "bcd":
                first.setdefault(name, LATE)
        elif kind == "committed":
            if committed:
                continue
            committed, failed = True, rest[0] is not None
            copies.committed(None if failed else RECORD, rest[0])
        else:
            told += copies.abandon(LATE)
            abandoned = True
        over = committed and (failed or len(first) == 3)
        assert copies.over == (over or abandoned)
        assert len(ended) + told == int(over or abandoned)
        assert copies.outcomes == first
    if ended and not failed and not abandoned:
        assert copies.stored == all(outcome == STORED for outcome in first.values())
    if failed:
        assert not copies.stored
        assert isinstance(copies.problem, SwiftbotError)


def test_it_ends_once_on_many_threads() -> None:
    """Answers, the commit and the end of patience at one moment, a hundred times."""
    for _ in range(100):
        ended: list[Copies] = []
        copies = _copies(ended, "b", "c")
        start = threading.Barrier(5)
        calls = (
            lambda copies=copies: copies.heard("b", STORED),
            lambda copies=copies: copies.heard("c", STORED),
            lambda copies=copies: copies.heard("c", ConflictError("late")),
            lambda copies=copies: copies.give_up(LATE),
            lambda copies=copies: copies.committed(RECORD, None),
        )

        def go(call: Any, start: threading.Barrier = start) -> None:
            start.wait()
            call()

        threads = [threading.Thread(target=go, args=(call,)) for call in calls]
        for each in threads:
            each.start()
        for each in threads:
            each.join()
        assert ended == [copies]
        assert copies.outcomes.keys() == {"b", "c"}
