"""Which tasks a question means, and pages of them: over however many gateways, nothing is left out or told twice."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.errors import UnreachableError
from appliance.model import Failure, Pause, Subtask, SubtaskRecord, TaskRecord, TaskState, encode
from appliance.model.task_api import TaskList, TasksAsk
from appliance.plane.dht import Record
from appliance.tasks import history
from appliance.tasks.endpoints import newest_tasks
from appliance.tasks.records import trimmed

from .fake_plane import FakePlane


def task(number: int, **fields: Any) -> TaskRecord:
    """Return a record; several may be accepted in one moment."""
    more: dict[str, Any] = {"instruction": f"go to dock {number}", "created_ns": number // 2, **fields}
    return TaskRecord(id=f"t-{number:03d}", **more)


RECORDS = st.lists(
    st.builds(
        task, st.integers(0, 60), submitter=st.sampled_from(("ann", "bob")),
        state=st.sampled_from((TaskState.RUNNING, TaskState.FAILED)), sequence=st.integers(0, 3),
    ),
    unique_by=lambda record: record.id, max_size=40,
)  # fmt: skip


@given(RECORDS, st.integers(1, 4), st.integers(1, 9), st.integers(200, 4000), st.data())
def test_page_after_page_has_each_task_once(
    records: list[TaskRecord], gateways: int, limit: int, most_bytes: int, data: st.DataObject
) -> None:
    """However the tasks lie on gateways, with copies, and whatever a page or an answer holds: all, in order, once."""
    shards: list[list[TaskRecord]] = [[] for _ in range(gateways)]
    for record in records:
        for shard in data.draw(st.sets(st.integers(0, gateways - 1), min_size=1)):
            shards[shard].append(record)
    wanted = TasksAsk(limit=limit, by="ANN")
    seen: list[TaskRecord] = []
    ask = wanted
    for _ in range(len(records) + 1):
        merged, more = history.together([history.newest(each, ask, most_bytes=most_bytes) for each in shards])
        page = history.newest(merged.values(), ask, most_bytes=most_bytes)
        seen += page.tasks
        assert len(page.tasks) <= limit
        if not (more or page.more):
            break
        assert page.tasks, "a page that says that there are more has at least one"
        ask = replace(wanted, before_ns=page.tasks[-1].created_ns, before=page.tasks[-1].id)
    expected = [each for each in records if each.submitter == "ann" and each.created_ns > 0]
    first = [each for each in records if each.submitter == "ann" and each.created_ns == 0]
    assert [each.id for each in seen if each.created_ns > 0] == [
        each.id for each in sorted(expected, key=history.place, reverse=True)
    ]
    assert len({each.id for each in seen}) == len(seen) <= len(expected) + len(first)


def test_filters() -> None:
    """State or what people see of it, robot, submitter, time, text; all that are given hold."""
    plan = (SubtaskRecord(subtask=Subtask(id="s1", skill="goto", robot="rover_1")),
            SubtaskRecord(subtask=Subtask(id="s2", skill="goto", robot="any"), bound_robot="drone_1"))  # fmt: skip
    paused = task(1, state=TaskState.RUNNING, subtasks=plan, pauses=(Pause(by="ann"),), submitter="Ann")
    failed = task(2, state=TaskState.FAILED, failure=Failure(code="robot", message="Battery is EMPTY"))
    for ask, meant in (
        (TasksAsk(status=("paused",)), [paused]), (TasksAsk(status=("running",)), [paused]),
        (TasksAsk(status=("failed", "paused")), [paused, failed]), (TasksAsk(status=("succeeded",)), []),
        (TasksAsk(robot="rover_1"), [paused]), (TasksAsk(robot="drone_1"), [paused]), (TasksAsk(robot="rover"), []),
        (TasksAsk(by="ANN"), [paused]), (TasksAsk(since_ns=1), [failed]), (TasksAsk(text="battery is empty"), [failed]),
        (TasksAsk(text="DOCK"), [paused, failed]), (TasksAsk(text="t-002"), [failed]),
        (TasksAsk(text="dock", by="ann", robot="rover_1", status=("failed",)), []),
    ):  # fmt: skip
        assert [each for each in (paused, failed) if history.matches(each, ask)] == meant, ask


def test_a_row_of_a_table_has_what_an_export_needs() -> None:
    """Robots in one cell, the failure's code and words; the same columns for every task."""
    row = history.flat(task(2, state=TaskState.FAILED, failure=Failure(code="robot", message="empty")))
    assert (row["status"], row["error"], row["message"]) == ("failed", "robot", "empty")
    assert list(row) == list(history.flat(TaskRecord(id="", instruction="")))


@pytest.mark.anyio
async def test_a_filter_looks_at_what_the_owner_has() -> None:
    """By a copy that is behind, a task would match that has long ended; tombstones are there when asked for."""
    plane: Any = FakePlane()
    running = task(5, state=TaskState.RUNNING)
    small = trimmed(task(4, state=TaskState.FAILED, submitter="ann"), "")
    for each in (running, small):
        key = f"task/{each.id}"
        plane.dht.records[key] = Record(key=key, value=encode(each), version={"gw-2": 1})
    ask = TasksAsk(status=("running",), local=True)
    assert [each.id for each in (await newest_tasks(plane, ask, ())).tasks] == [running.id]
    plane.dht.mine = False
    assert (await newest_tasks(plane, ask, ())).tasks == ()
    assert [each.id for each in (await newest_tasks(plane, TasksAsk(local=True), ())).tasks] == [running.id]
    plane.dht.mine = True
    found = await newest_tasks(plane, TasksAsk(local=True, by="ann", remembered=True), ())
    assert found.tasks == (small,)


@pytest.mark.anyio
async def test_the_page_of_a_fleet_names_who_did_not_answer() -> None:
    """The others' tasks are there, and what an answer left out makes the page end where that answer ends."""
    plane: Any = FakePlane()
    record = task(9)
    plane.dht.records["task/t-009"] = Record(key="task/t-009", value=encode(record), version={"gw-1": 1})

    async def answer(gateway: str, ask: TasksAsk) -> TaskList:
        assert ask.local
        assert ask.text == "dock"
        if gateway == "gw-3":
            raise UnreachableError("gone")
        return TaskList(tasks=(task(20), task(12)), more=True)

    plane.rpc.on["tasks"] = answer
    found = await newest_tasks(plane, TasksAsk(limit=5, text="dock"), ())
    assert [each.id for each in found.tasks] == ["t-020", "t-012"]
    assert (found.more, found.unreachable) == (True, ("gw-3",))
