"""Replays a log through the task state machine: do the logged inputs give the logged end states?

The log holds every transition a coordinator applied and every record it wrote. Folding the former over nothing
with the same `machine.apply` must give the latter; a difference is a bug in the machine, a gap in the log, or
a log of another version. Recorded logs thereby become regression tests.
"""

from collections import Counter
from pathlib import Path

import msgspec
from msgspec import Struct

from appliance.errors import RecordError
from appliance.model import SubtaskRecord, TaskRecord
from appliance.record.reader import read
from appliance.tasks import machine
from appliance.tasks.machine import StaleTransitionError, Transition, TransitionKind
from appliance.tasks.transition import TAKES_OVER, fingerprint


class TaskReplay(Struct, frozen=True, kw_only=True):
    """One task of a log: the state it was logged in last, the state that its transitions give, what differs."""

    task: str
    instruction: str
    logged: str
    replayed: str
    transitions: int
    stale: int = 0
    """Transitions that did not fit: of a coordinator that had been superseded."""
    differences: tuple[str, ...] = ()

    @property
    def same(self) -> bool:
        """Whether the replay agrees with the log."""
        return not self.differences


class ReplayReport(Struct, frozen=True, kw_only=True):
    """All tasks of a log. `same` is true only if there is one and every one agrees."""

    path: str
    messages: int
    tasks: tuple[TaskReplay, ...]
    unreadable: int = 0
    same: bool = False


class _Folding:
    """One task while the log is read."""

    def __init__(self) -> None:
        self.record: TaskRecord | None = None
        self.history: dict[int, TaskRecord] = {}
        self.versions: dict[str, TaskRecord] = {}
        """By fingerprint: what a takeover may go on from."""
        self.logged: TaskRecord | None = None
        self.transitions = 0
        self.stale = 0
        self.gaps: list[str] = []

    def take(self, event: Transition) -> None:
        self.transitions += 1
        base = self.record
        if base is not None and event.coordinator != base.coordinator and event.kind not in TAKES_OVER:
            # Of the other side of a partition, or of one that was succeeded and does not know it yet.
            self.stale += 1
            return
        if event.base in self.versions:
            base = self.versions[event.base]
        elif event.kind is TransitionKind.ADOPTED and base is not None:
            # The new coordinator goes on from the last *written* record; progress since then is not in it.
            base = self.history.get(event.sequence - 1, base)
        try:
            self.record = machine.apply(base, event)
        except StaleTransitionError as error:
            self.stale += 1
            if base is None or event.sequence > base.sequence + 1:
                self.gaps.append(f"gap before transition {event.sequence} ({event.kind}): {error.message}")
            return
        self.history[event.sequence] = self.record
        self.versions[fingerprint(self.record)] = self.record


def replay(path: Path) -> ReplayReport:
    """Fold the transitions of an MCAP log and compare with the records logged last.

    Raises:
        RecordError: the file cannot be read, or holds no task.
    """
    tasks: dict[str, _Folding] = {}
    counts: Counter[str] = Counter()
    for message in read(path):
        counts["messages"] += 1
        chunks = message.key.split("/")
        if len(chunks) < 5 or chunks[2] != "task" or chunks[4] not in ("transition", "record"):
            continue
        try:
            if chunks[4] == "transition":
                event = msgspec.json.decode(message.payload, type=Transition)
                tasks.setdefault(event.task, _Folding()).take(event)
            else:
                record = msgspec.json.decode(message.payload, type=TaskRecord)
                tasks.setdefault(record.id, _Folding()).logged = record
        except msgspec.DecodeError:
            counts["unreadable"] += 1
    if not tasks:
        raise RecordError(f"{path} holds no task", remedy="record while tasks run, with `swiftbot record`")
    outcomes = tuple(_outcome(task, folding) for task, folding in sorted(tasks.items()))
    return ReplayReport(
        path=str(path),
        messages=counts["messages"],
        tasks=outcomes,
        unreadable=counts["unreadable"],
        same=all(outcome.same for outcome in outcomes),
    )


def _outcome(task: str, folding: _Folding) -> TaskReplay:
    logged, replayed = folding.logged, folding.record
    differences = list(folding.gaps)
    if logged is None:
        differences.append("no record of it was logged")
    elif replayed is None:
        differences.append("its transitions were not logged")
    else:
        differences.extend(compare(logged, replayed))
    shown = logged or replayed
    return TaskReplay(
        task=task,
        instruction=shown.instruction if shown else "",
        logged=str(logged.state) if logged else "",
        replayed=str(replayed.state) if replayed else "",
        transitions=folding.transitions,
        stale=folding.stale,
        differences=tuple(differences),
    )


def compare(logged: TaskRecord, replayed: TaskRecord) -> tuple[str, ...]:
    """What differs between two records of a task, a sentence each; empty when they tell the same."""
    found: list[str] = []
    if logged.state is not replayed.state:
        found.append(f"task: logged {logged.state}, replayed {replayed.state}")
    if logged.revised != replayed.revised:
        found.append(f"task: logged {logged.revised} revisions of its plan, replayed {replayed.revised}")
    ids = [each.subtask.id for each in logged.subtasks]
    if ids != [each.subtask.id for each in replayed.subtasks]:
        return (*found, "the subtasks are not the same")
    for one, other in zip(logged.subtasks, replayed.subtasks, strict=True):
        found.extend(_compare_subtask(one, other))
    return tuple(found)


def _compare_subtask(logged: SubtaskRecord, replayed: SubtaskRecord) -> list[str]:
    name = logged.subtask.id
    found = [
        f"{name}: logged {what} {a}, replayed {b}"
        for what, a, b in (
            ("state", logged.state, replayed.state),
            ("attempt", logged.attempt, replayed.attempt),
            ("gateway", logged.gateway, replayed.gateway),
            ("robot", logged.bound_robot, replayed.bound_robot),
        )
        if a != b
    ]
    if logged.result != replayed.result:
        found.append(f"{name}: the results differ")
    if logged.failure != replayed.failure:
        found.append(f"{name}: the failures differ")
    return found
