"""Whose turn it is at a robot: tasks that need the same parts of it go one after another, in one order. Pure.

Tasks that have begun go first, then the higher priority, then who was accepted first or was moved there by an operator.
The order is one for all robots: of the tasks that wait, the first waits for nobody but runs, and these end. A task that
waits for something else (a place that is closed, a pause) holds no robot meanwhile.
"""

from collections.abc import Callable, Iterable, Sequence

from appliance.errors import RefusedError
from appliance.model import RobotWork, Subtask, SubtaskRecord, SubtaskState, TaskRecord, TaskState
from appliance.tasks.machine import ACTIVE

APART_NS = 10**9
"""How far before the first one a task is put that is to go first."""


def work_of(
    record: TaskRecord,
    *,
    robots_of: Callable[[SubtaskRecord], Iterable[str]],
    takes_s: Callable[[Subtask, str], float],
    uses: Callable[[Subtask], Iterable[str]],
    blocked: Callable[[str], bool],
) -> list[RobotWork]:
    """Return what a task still has for robots, robot by robot.

    Args:
        record: the task.
        robots_of: the robots of a subtask, as far as they are known.
        takes_s: how long a subtask takes a robot.
        uses: the parts of a robot that it needs.
        blocked: whether a subtask waits for something else than its turn.
    """
    by_robot: dict[str, list[SubtaskRecord]] = {}
    for each in record.subtasks:
        for robot in robots_of(each):
            by_robot.setdefault(robot, []).append(each)
    begun_at = {robot for robot, subtasks in by_robot.items() if any(map(_begun, subtasks))}
    stands = bool(record.paused) or record.state is not TaskState.RUNNING
    stands = stands or (record.proposal is not None and record.proposal.waits)
    found: list[RobotWork] = []
    for robot, subtasks in by_robot.items():
        left = [each for each in subtasks if not each.state.final]
        if not left or record.state.final:
            continue
        ready = [each for each in left if each.state is SubtaskState.READY]
        if any(each.state in ACTIVE for each in left):
            state = "runs"
        elif stands or (ready and all(blocked(each.subtask.id) for each in ready)):
            state = "later"
        elif robot in begun_at or (ready and begun_at):
            state = "begun"
        else:
            state = "ready" if ready else "later"
        found.append(
            RobotWork(
                robot=robot, task=record.id, state=state, priority=record.priority, place_ns=place_of(record),
                takes_s=round(sum(takes_s(each.subtask, robot) for each in left)),
                uses=tuple(sorted({use for each in left for use in uses(each.subtask)})),
            )
        )  # fmt: skip
    return found


def place_of(record: TaskRecord) -> int:
    """Return what orders a task among those of its priority."""
    return record.place_ns or record.created_ns


def goes_first(mine: RobotWork, work: Iterable[RobotWork]) -> RobotWork | None:
    """Return the task that has a robot before this one; None when it is this one's turn.

    Args:
        mine: what a task has for a robot just now.
        work: what all tasks have for robots.
    """
    before = [
        each
        for each in work
        if each.robot == mine.robot
        and each.task != mine.task
        and not set(each.uses).isdisjoint(mine.uses)
        and (each.state == "runs" or (each.state in ("begun", "ready") and each.rank < mine.rank))
    ]
    return min(before, key=lambda each: (each.state != "runs", each.rank), default=None)


def moved_before(record: TaskRecord, work: Sequence[RobotWork], other: str) -> tuple[int, int]:
    """Return the priority and the place with which a task goes right before another one, or first.

    Args:
        record: the task.
        work: what all tasks have for robots.
        other: the task that it goes before; empty: all that wait for its robots.

    Raises:
        RefusedError: they do not wait for the same robot.
    """
    robots = {each.robot for each in work if each.task == record.id}
    rivals = [each for each in work if each.robot in robots and each.task != record.id]
    if not robots:
        raise RefusedError(
            f"task {record.id} has nothing to do with a robot", remedy="`swiftbot robots queue` shows who waits"
        )
    if not other:
        priority = max((each.priority for each in rivals), default=record.priority)
        if priority < record.priority:
            return record.priority, place_of(record)
        first = min((each.place_ns for each in rivals if each.priority == priority), default=place_of(record))
        return priority, first - APART_NS
    met = next((each for each in rivals if each.task == other), None)
    if met is None:
        raise RefusedError(
            f"task {other[:80]} does not wait for a robot of task {record.id}",
            remedy="`swiftbot robots queue` shows who waits",
        )
    lower = [each.place_ns for each in rivals if each.priority == met.priority and each.place_ns < met.place_ns]
    return met.priority, (max(lower, default=met.place_ns - 2 * APART_NS) + met.place_ns) // 2


def _begun(target: SubtaskRecord) -> bool:
    return target.state in ACTIVE or target.state is SubtaskState.SUCCEEDED or bool(target.attempts)
