"""Records from elsewhere: unsound ones are told from sound ones, and unknown fields outlive being read and written."""

from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.model import Subtask, SubtaskRecord, TaskRecord, encode
from appliance.tasks.bounds import read_record
from appliance.tasks.soundness import MOST_SUBTASKS, unknown, unsound, with_unknown


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
    """Cycles, what comes after nothing, two of one name, far too many and far too deep: each is told."""
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


NAMES = st.sampled_from(["later_a", "later_b", "later_c"])
FIELDS = st.dictionaries(NAMES, st.integers(-9, 9) | st.text("abc", max_size=5), max_size=3)


@settings(deadline=None)
@given(own=FIELDS, subtask=FIELDS)
def test_unknown_fields_come_back(own: dict[str, Any], subtask: dict[str, Any]) -> None:
    """Of the record and of its subtasks; what is known is as it was."""
    known = record(("a", ()), ("b", ("a",)))
    table: dict[str, Any] = msgspec.json.decode(encode(known)) | own
    table["subtasks"][1] |= subtask
    value = encode(table)
    read = read_record(value)
    assert read == known
    assert msgspec.json.decode(with_unknown(read, unknown(value))) == table


def test_garbage_has_no_unknown_fields() -> None:
    """Bytes that are no record give none, and raise nothing."""
    for value in (b"", b"[]", b"\xff", b'{"subtasks": 3}', b'{"subtasks": [3, {}]}', b"[" * 100_000):
        assert unknown(value) == {}
