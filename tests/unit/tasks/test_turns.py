"""Whose turn it is at a robot: one order for all robots, so that tasks never wait for each other in a circle."""

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.errors import RefusedError
from appliance.model import Attempt, Pause, RobotWork, Subtask, SubtaskRecord, SubtaskState, TaskRecord, TaskState
from appliance.model.gateways import GatewayStatus, queues
from appliance.tasks.turns import goes_first, moved_before, work_of

R1 = SubtaskRecord(subtask=Subtask(id="s1", skill="goto", robot="r1"), state=SubtaskState.READY)
R2 = SubtaskRecord(subtask=Subtask(id="s2", skill="goto", robot="r2"), state=SubtaskState.READY)
RECORD = TaskRecord(id="t-1", instruction="go", state=TaskState.RUNNING, subtasks=(R1, R2), created_ns=100)


def states(record: TaskRecord, *blocked: str) -> dict[str, str]:
    """Return how a task stands at its robots."""
    found = work_of(
        record, robots_of=lambda each: each.subtask.robots, takes_s=lambda _subtask, _robot: 5.0,
        uses=lambda _: ("base",), blocked=lambda subtask: subtask in blocked,
    )  # fmt: skip
    assert all(each.task == "t-1" and each.uses == ("base",) and each.takes_s == 5.0 for each in found)
    return {each.robot: each.state for each in found}


def test_how_a_task_stands_at_its_robots() -> None:
    """A robot is a task's own from its first run there to its last; one that cannot go on holds none."""
    assert states(RECORD) == {"r1": "ready", "r2": "ready"}
    later = replace(RECORD, subtasks=(R1, replace(R2, state=SubtaskState.WAITING)))
    assert states(later) == {"r1": "ready", "r2": "later"}
    assert states(RECORD, "s1") == {"r1": "later", "r2": "ready"}
    runs = replace(RECORD, subtasks=(replace(R1, state=SubtaskState.RUNNING), R2))
    assert states(runs) == {"r1": "runs", "r2": "begun"}
    tried = replace(RECORD, subtasks=(replace(R1, attempts=(Attempt(number=1, gateway="gw-1"),)), R2))
    assert states(tried) == {"r1": "begun", "r2": "begun"}
    pause = Pause(by="ann", at_ns=1)
    assert states(replace(runs, pauses=(pause,))) == {"r1": "runs", "r2": "later"}
    assert states(replace(RECORD, pauses=(pause,))) == {"r1": "later", "r2": "later"}
    done = replace(RECORD, subtasks=(replace(R1, state=SubtaskState.SUCCEEDED), R2))
    assert states(done) == {"r2": "begun"}
    assert states(replace(RECORD, state=TaskState.CANCELLED)) == {}


def work(task: str, state: str = "ready", **fields: object) -> RobotWork:
    """Return what a task has for r1."""
    return replace(RobotWork(robot="r1", task=task, state=state, uses=("base",), place_ns=10), **fields)


def test_who_goes_first() -> None:
    """Runs, then tasks that have begun, then by priority and acceptance; not those at other robots or parts."""
    mine = work("t-5")
    assert goes_first(mine, [mine]) is None
    for other in (
        work("t-9", "runs"),
        work("t-9", "begun"),
        work("t-4"),
        work("t-9", priority=6),
        work("t-9", place_ns=9),
    ):
        assert goes_first(mine, [mine, other]) == other
    for other in (work("t-9"), work("t-4", "later"), work("t-4", robot="r2"), work("t-4", uses=("camera",))):
        assert goes_first(mine, [mine, other]) is None
    assert goes_first(work("t-5", "begun"), [work("t-9", priority=9)]) is None


def test_a_task_is_put_before_others() -> None:
    """Before all that wait for its robots, or right before one: with its priority, between it and the one before it."""
    record = replace(RECORD, id="t-5", priority=5, created_ns=50)
    rows = [
        work("t-5", place_ns=50),
        work("t-2", place_ns=20),
        work("t-3", place_ns=40),
        work("t-8", robot="r2", priority=9),
    ]
    assert moved_before(record, rows, "t-3") == (5, 30)
    priority, place_ns = moved_before(record, rows, "")
    assert priority == 5
    assert place_ns < 20
    assert moved_before(record, [*rows, work("t-7", priority=7, place_ns=70)], "t-7")[0] == 7
    assert moved_before(replace(record, priority=8), rows, "") == (8, 50)
    with pytest.raises(RefusedError, match="does not wait for a robot of task t-5"):
        moved_before(record, rows, "t-8")
    with pytest.raises(RefusedError, match="nothing to do with a robot"):
        moved_before(record, rows[1:], "")


def test_a_queue_is_told_once_by_robot_in_order() -> None:
    """Two gateways may tell of a task that changes hands."""
    one = GatewayStatus(id="gw-1", fleet="f", work=(work("t-2"), work("t-1", "later"), work("t-4", robot="r0")))
    other = GatewayStatus(id="gw-2", fleet="f", work=(work("t-2"), work("t-3", "runs", priority=0)))
    assert [(each.robot, each.task) for each in queues([one, other])] == [
        ("r0", "t-4"), ("r1", "t-3"), ("r1", "t-2"), ("r1", "t-1")
    ]  # fmt: skip


TASKS = st.lists(
    st.tuples(
        st.booleans(), st.integers(0, 9), st.integers(0, 3),
        st.dictionaries(st.sampled_from(["r1", "r2", "r3"]), st.sampled_from(["runs", "own", "later"]), min_size=1),
    ),
    min_size=1, max_size=7,
)  # fmt: skip


@given(TASKS)
def test_tasks_never_wait_for_each_other_in_a_circle(tasks: list[tuple[bool, int, int, dict[str, str]]]) -> None:
    """Over any tasks at several robots: where nothing runs, somebody may go."""
    rows = [
        RobotWork(
            robot=robot, task=f"t-{number}", priority=priority, place_ns=place_ns, uses=("base",),
            state=("begun" if begun else "ready") if state == "own" else state,
        )
        for number, (begun, priority, place_ns, robots) in enumerate(tasks)
        for robot, state in robots.items()
    ]  # fmt: skip
    wants = [each for each in rows if each.state in ("begun", "ready")]
    waits = {(each.task, first.task) for each in wants if (first := goes_first(each, rows)) and first.state != "runs"}
    reaches = set(waits)
    for _ in tasks:
        reaches |= {(a, d) for (a, b), (c, d) in itertools.product(reaches, waits) if b == c}
    assert all(a != b for a, b in reaches)
    if wants and all(each.state != "runs" for each in rows):
        assert any(goes_first(each, rows) is None for each in wants)
