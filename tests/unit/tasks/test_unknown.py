"""Fields of a newer version outlive being read and written by this one, wherever in a task's record they stand."""

from collections.abc import Iterator
from typing import Any, cast

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.model import (
    Attempt,
    Choice,
    Failure,
    Group,
    Pause,
    Phase,
    Plan,
    Split,
    Subtask,
    SubtaskRecord,
    SubtaskState,
    TaskRecord,
    TaskState,
    Way,
    encode,
)  # fmt: skip
from appliance.model.tasks import LostRun
from appliance.tasks.records import read_record, unknown, with_unknown

PLAN = Plan(domain="d", subtasks=(Subtask(id="a", skill="go"), Subtask(id="b", skill="go", after=("a",))))
LOST = LostRun(subtask="a", attempt=1, gateway="gw-2", state=SubtaskState.RUNNING)
RECORD = TaskRecord(
    id="t-1",
    instruction="x",
    state=TaskState.RUNNING,
    plan=PLAN,
    group=Group(members=("gw-1", "gw-2"), root="gw-1"),
    pauses=(Pause(by="ann", why="one"), Pause(by="ann", why="two")),
    subtasks=(
        SubtaskRecord(
            subtask=PLAN.subtasks[0],
            attempts=(
                Attempt(number=1, gateway="gw-2", failure=Failure(code="handler", message="no")),
                Attempt(
                    number=2,
                    gateway="gw-1",
                    choice=Choice(phase=Phase.LOCAL_WARM, way=Way.HERE, by="gw-1", gateway="gw-1"),
                ),
            ),
        ),
        SubtaskRecord(subtask=PLAN.subtasks[1]),
    ),
    splits=(Split(coordinator="gw-2", sequence=3, state=TaskState.RUNNING, runs=(LOST, replace(LOST, subtask="b"))),),
)


def tables(value: Any) -> Iterator[dict[str, Any]]:
    """All objects in a decoded record, parameters and results left out: these are anybody's."""
    if isinstance(value, dict):
        table = cast("dict[str, Any]", value)
        yield table
        for name, each in table.items():
            if name not in ("params", "result", "partial"):
                yield from tables(each)
    elif isinstance(value, list):
        for each in cast("list[Any]", value):
            yield from tables(each)


def newer(record: TaskRecord) -> dict[str, Any]:
    """A record as a newer version might have written it, with a field more in everything."""
    table = msgspec.json.decode(encode(record))
    for number, each in enumerate(list(tables(table))):
        each["of_a_later_version"] = number
    return table


NAMES = st.sampled_from(["later_a", "later_b", "later_c"])
FIELDS = st.dictionaries(NAMES, st.integers(-9, 9) | st.text("abc", max_size=5), max_size=3)


@settings(deadline=None)
@given(data=st.data())
def test_unknown_fields_come_back(data: st.DataObject) -> None:
    """Of the record, and of all that is in it; what is known is as it was."""
    table: dict[str, Any] = msgspec.json.decode(encode(RECORD))
    for each in list(tables(table)):
        each.update(data.draw(FIELDS))
    value = encode(table)
    read = read_record(value)
    assert read == RECORD
    assert msgspec.json.decode(with_unknown(read, unknown(value))) == table


def test_they_stay_with_what_they_are_of() -> None:
    """A record that has gone on: what is new has none, what is gone took its own along, and none comes to another."""
    kept = unknown(encode(newer(RECORD)))
    before = {each["of_a_later_version"]: each for each in tables(newer(RECORD))}
    first = RECORD.subtasks[0]
    attempts = (replace(first.attempts[1], left="moved"), Attempt(number=3, gateway="gw-3"))
    changed = replace(
        RECORD,
        note="changed",
        pauses=RECORD.pauses[1:],
        group=replace(RECORD.group, number=2) if RECORD.group is not None else None,
        subtasks=(RECORD.subtasks[1], replace(first, attempts=attempts)),
    )
    after = msgspec.json.decode(with_unknown(changed, kept))
    assert read_record(encode(after)) == changed
    second, again = after["subtasks"]
    assert before[second["of_a_later_version"]]["subtask"]["id"] == "b"
    assert before[again["of_a_later_version"]]["subtask"]["id"] == "a"
    assert before[again["attempts"][0]["of_a_later_version"]]["number"] == 2
    assert "of_a_later_version" not in again["attempts"][1]
    assert before[after["pauses"][0]["of_a_later_version"]]["why"] == "two"
    assert "of_a_later_version" in after["group"]


def test_a_record_that_this_version_knows_is_written_as_ever() -> None:
    """Nothing is unknown in it, and its encoding is the plain one."""
    kept = unknown(encode(RECORD))
    assert not kept
    assert with_unknown(RECORD, kept) == encode(RECORD)


@pytest.mark.parametrize(
    "value",
    [b"", b"[]", b"3", b"\xff", b'{"subtasks": 3}', b'{"subtasks": [3, {}]}', b'{"plan": [], "x": 1}', b"[" * 100_000],
)
def test_garbage_harms_nobody(value: bytes) -> None:
    """Bytes that are no record raise nothing, and change none."""
    kept = unknown(value)
    assert read_record(with_unknown(RECORD, kept)) == RECORD
