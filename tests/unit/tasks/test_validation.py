"""Records from elsewhere: unsound ones are distinguished from sound ones."""

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.model import Subtask, SubtaskRecord, TaskRecord
from appliance.tasks.records import MOST_SUBTASKS, unsound


def record(*subtasks: tuple[str, tuple[str, ...]], **params: Any) -> TaskRecord:
    """Return a record with subtasks by id and what they come after."""
    return TaskRecord(
        id="t-1",
        instruction="x",
        subtasks=tuple(
            SubtaskRecord(subtask=Subtask(id=name, skill="go", after=after, params=params)) for name, after in subtasks
        ),
    )


@pytest.mark.thorough
def test_what_cannot_end_is_unsound() -> None:
    """Cycles, what comes after nothing, two of one name, far too many and far too deep: each is reported."""
    deep: Any = {}
    for _ in range(200):
        deep = {"x": deep}
    bad = {
        "wait for each other": record(("a", ("b",)), ("b", ("a",))),
        "'a' wait": record(("a", ("a",))),
        "which there is not": record(("a", ("z",))),
        "same id": record(("a", ()), ("a", ())),
        "1,000,000 subtasks": record(*[("a", ())] * 1_000_000),
        "nested": record(("a", ()), deep=deep),
    }
    for reason, each in bad.items():
        failure = unsound(each)
        assert failure is not None
        assert reason in failure.message
    assert unsound(record()) is None
    assert unsound(record(*((f"s{number}", ()) for number in range(MOST_SUBTASKS)))) is None


@settings(deadline=None)
@given(after=st.lists(st.sets(st.integers(0, 9)), max_size=10))
def test_plans_in_order_are_sound(after: list[set[int]]) -> None:
    """Whatever comes only after earlier ones can be driven."""
    before = [tuple(f"s{each}" for each in sorted(those) if each < number) for number, those in enumerate(after)]
    sound = record(*((f"s{number}", those) for number, those in enumerate(before)))
    assert unsound(sound) is None


def test_what_comes_after_megabytes_of_others_is_looked_at_once() -> None:
    """A chain as long as can be, each after all before it many times over, is found sound, or not, without a pause."""
    names = [f"s{number}" for number in range(MOST_SUBTASKS)]
    chain = [(name, tuple(names[:place]) * 20) for place, name in enumerate(names)]
    assert unsound(record(*chain)) is None
    failure = unsound(record(("s0", (names[-1],)), *chain[1:]))
    assert failure is not None
    assert "wait for each other" in failure.message
