"""What the next decision on a record may rest on while others are on their way to the disk."""

from hypothesis import given
from hypothesis import strategies as st

from appliance.plane.ahead import Ahead, Known, Mark
from appliance.plane.versions import Record

KEYS = ("a", "b")


def record(key: str, count: int) -> Record:
    """The state of a record after so many changes."""
    return Record(key=key, value=str(count).encode(), version={"g": count})


@given(st.lists(st.tuples(st.sampled_from(["now", "later", "drop", "run"]), st.sampled_from(KEYS)), max_size=60))
def test_what_is_known_is_what_all_that_is_queued_will_leave(steps: list[tuple[str, str]]) -> None:
    """Whatever is queued and run in turn: a decision ahead rests on the state that the calls before it leave."""
    ahead, committed = Ahead(), dict[str, Record]()
    queue: list[tuple[Mark, Record | None, str]] = []
    number = 0

    def look(key: str) -> tuple[bool, Record | None]:
        return True, committed.get(key)

    def left(key: str) -> Record | None:
        """The state once all that is queued has run."""
        state = committed.get(key)
        for _, put, dropped in queue:
            if dropped == key:
                state = None
            elif put is not None and put.key == key:
                state = put
        return state

    for what, key in steps:
        number += 1
        if what == "run":
            if queue:
                mark, put, dropped = queue.pop(0)
                if put is not None:
                    committed[put.key] = put
                committed.pop(dropped, None)
                ahead.settled(mark)
            continue
        found = ahead.known(key, look)
        if found is not None:
            assert found.record == left(key)
        if what == "now" and found is not None:
            queue.append((Mark(decided=record(key, number)), record(key, number), ""))
        elif what == "drop":
            queue.append((Mark(touches=""), None, key))
        else:
            queue.append((Mark(touches=key), record(key, number), ""))
        ahead.queued(queue[-1][0])
    while queue:
        mark, put, dropped = queue.pop(0)
        if put is not None:
            committed[put.key] = put
        committed.pop(dropped, None)
        ahead.settled(mark)
    assert all(ahead.known(key, look) == Known(committed.get(key), on_its_way=False) for key in KEYS)


def test_what_is_not_in_memory_is_not_known() -> None:
    """A record that only the file has is decided on by the store's thread, unless it was decided on just now."""
    ahead = Ahead()
    assert ahead.known("a", lambda _: (False, None)) is None
    mark = Mark(decided=record("a", 1))
    ahead.queued(mark)
    assert ahead.known("a", lambda _: (False, None)) == Known(record("a", 1), on_its_way=True)
    ahead.settled(mark)
    assert ahead.known("a", lambda _: (False, None)) is None
