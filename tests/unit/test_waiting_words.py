"""What people read of a task that waits, and of a cancel: by the record alone, in the words of the command line."""

import pytest
from msgspec.structs import replace
from rich.console import Console, RenderableType

from appliance import console
from appliance.client import cancel_outcome
from appliance.model import Failure, Plan, Subtask, SubtaskRecord, SubtaskState, TaskRecord, TaskState
from appliance.tasks.views import view, waits_for

LOST = "waits for robot rover_1, lost since 14:03:22 UTC, while it held the red box"
WAITING = TaskRecord(
    id="t-1",
    instruction="fetch it",
    coordinator="gw-1",
    state=TaskState.RUNNING,
    plan=Plan(domain="navigation", subtasks=()),
    subtasks=(
        SubtaskRecord(subtask=Subtask(id="s1", skill="pick", robot="rover_1"), state=SubtaskState.SUCCEEDED),
        SubtaskRecord(
            subtask=Subtask(id="s2", skill="goto", robot="rover_1"),
            state=SubtaskState.READY,
            note=LOST,
            failure=Failure(code="robot", message="rover_1 did not answer"),
        ),
    ),
)


def printed(what: RenderableType) -> str:
    """Return what is printed on a wide terminal."""
    out = Console(width=220, record=True, file=None, force_terminal=False)
    with out.capture() as captured:
        out.print(what)
    return captured.get()


def test_a_task_that_waits_for_a_lost_robot_says_so_everywhere() -> None:
    """Also where the attempt before failed: the reason it waits goes before that failure, and the failure stays."""
    assert waits_for(WAITING) == LOST.removeprefix("waits for ")
    assert view(WAITING).waits == LOST.removeprefix("waits for ")
    shown = printed(console.task_table(WAITING))
    assert LOST in shown
    assert "rover_1 did not answer" in shown
    assert "lost since 14:03:22 UTC" in printed(console.task_list([WAITING]))


def test_a_task_that_has_ended_waits_for_nothing() -> None:
    """Notes of subtasks that were left standing say nothing of it any more."""
    ended = replace(WAITING, state=TaskState.CANCELLED)
    assert not waits_for(ended)
    assert view(ended).waits is None
    assert "waits for" not in printed(console.task_list([ended]))


@pytest.mark.parametrize(
    ("state", "said"),
    [
        (TaskState.CANCELLED, "task t-1 is cancelled"),
        (TaskState.CANCELLING, "task t-1 is being cancelled: 1 of its runs are being ended"),
        (TaskState.SUCCEEDED, "task t-1 succeeded before the cancel came"),
        (TaskState.FAILED, "task t-1 failed before the cancel came"),
        (TaskState.RUNNING, "the cancel of task t-1 is noted; its coordinator gw-1 has not confirmed it yet"),
    ],
)
def test_a_cancel_says_what_came_of_it(state: TaskState, said: str) -> None:
    """In words, for each state that its answer may have."""
    running = replace(WAITING.subtasks[1], state=SubtaskState.RUNNING)
    assert cancel_outcome(replace(WAITING, state=state, subtasks=(WAITING.subtasks[0], running))) == said
