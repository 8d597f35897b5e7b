"""What became of the tasks and their effects: the invariants of a chaos run, checked on what was recorded. Pure.

1. Every task that was accepted has a record, and it has ended.
2. Each effect of a subtask that succeeded is in the ledger exactly once; of one that did not, at most once.
3. Nothing is in the ledger that no task asked for.
4. No effect of a subtask comes before the last one of those it comes after.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from msgspec import Struct

from appliance.model import SubtaskState, TaskRecord
from appliance.tasks.machine import Transition, TransitionKind
from workshop.bench.chaos.ledger import Line
from workshop.bench.chaos.plan import Wanted
from workshop.bench.figures import summary

MOST_EVIDENCE = 50
LATE_NS = 2_000_000_000
"""What is said of a gateway so long after it is back is not about that outage."""


class Down(Struct, kw_only=True):
    """An outage as it really was; monotonic nanoseconds, and the wall clock's for comparing with what was logged."""

    gateway: str
    kind: str
    at_ns: int
    wall_ns: int
    until_ns: int = 0
    coordinated: tuple[str, ...] = ()
    """Tasks that it was known to coordinate."""
    noticed_ns: dict[str, int] = {}
    """When each other gateway said that it was lost."""
    taken_over_ns: dict[str, int] = {}
    """When each of its tasks was taken over by another."""


class Submitted(Struct, frozen=True, kw_only=True):
    """What became of handing in a task: accepted, or the code of the error; that one may be accepted all the same."""

    task: str
    accepted: bool
    problem: str = ""


def effects(
    wanted: Sequence[Wanted], records: Mapping[str, TaskRecord | None], lines: Sequence[Line]
) -> dict[str, Any]:
    """Check the ledger; returns the evidence of each kind, at most 50 of it, and how many there are."""
    counts = Counter(each.entry for each in lines)
    at = {each.entry: number for number, each in reversed(list(enumerate(lines)))}
    last = {each.entry: number for number, each in enumerate(lines)}
    known: set[str] = set()
    doubled: list[str] = []
    lost: list[str] = []
    early: list[str] = []
    for task in wanted:
        entries = task.entries()
        record = records.get(task.task)
        for subtask in task.plan.subtasks:
            mine = entries[subtask.id]
            known.update(mine)
            doubled += [f"{each} {counts[each]} times" for each in mine if counts[each] > 1]
            done = record is not None and any(
                each.subtask.id == subtask.id and each.state is SubtaskState.SUCCEEDED for each in record.subtasks
            )
            if done:
                lost += [each for each in mine if not counts[each]]
            begun = min((at[each] for each in mine if each in at), default=None)
            before = [last[each] for name in subtask.after for each in entries[name] if each in last]
            if begun is not None and before and max(before) > begun:
                early.append(f"{subtask.id} of {task.task} acted before one that it comes after had")
    strange = [each for each in counts if each not in known]
    found = {"doubled": doubled, "lost": lost, "early": early, "strange": strange}
    return {
        "lines": len(lines),
        "wanted": sum(len(each) for task in wanted for each in task.entries().values()),
        **{kind: len(each) for kind, each in found.items()},
        "evidence": {kind: each[:MOST_EVIDENCE] for kind, each in found.items() if each},
    }


def outcomes(submitted: Sequence[Submitted], records: Mapping[str, TaskRecord | None]) -> dict[str, Any]:
    """Return how tasks ended; `missing`: accepted without a record, `open`: with one that has not ended."""
    states: Counter[str] = Counter()
    missing: list[str] = []
    unended: list[str] = []
    failed: list[str] = []
    attempts: Counter[int] = Counter()
    why: Counter[str] = Counter()
    for each in submitted:
        record = records.get(each.task)
        if record is None:
            if each.accepted:
                missing.append(each.task)
            else:
                states["not accepted"] += 1
            continue
        states[record.state.value] += 1
        if not record.state.final:
            doing = ", ".join(f"{sub.subtask.id} {sub.state} {sub.note}" for sub in record.subtasks)
            unended.append(f"{each.task} ({record.state} at {record.coordinator}: {doing})")
        elif record.failure is not None:
            failed.append(f"{each.task}: {record.failure.code}: {record.failure.message}")
        for sub in record.subtasks:
            attempts[sub.attempt] += 1
            why.update(one.failure.code for one in sub.attempts if one.failure)
    return {
        "submitted": len(submitted),
        "accepted": sum(each.accepted for each in submitted),
        "refused": dict(Counter(each.problem for each in submitted if each.problem)),
        "states": dict(states),
        "missing": missing,
        "open": unended[:MOST_EVIDENCE],
        "failed": failed[:MOST_EVIDENCE],
        "attempts": {str(number): attempts[number] for number in sorted(attempts)},
        "attempts_failed": dict(why),
    }


class Follower:
    """Follows who coordinates what, and when an outage was noticed and made good, as it is published."""

    def __init__(self) -> None:
        self.coordinator: dict[str, str] = {}
        self.takeovers: Counter[str] = Counter()
        self.ended: set[str] = set()
        self.downs: list[Down] = []

    def moved(self, step: Transition, now_ns: int) -> None:
        """Hear of a transition."""
        before = self.coordinator.get(step.task)
        self.coordinator[step.task] = step.coordinator
        if step.kind is not TransitionKind.ADOPTED:
            return
        if before is not None and before != step.coordinator:
            self.takeovers[step.task] += 1
        for down in reversed(self.downs):
            if step.task in down.coordinated and step.task not in down.taken_over_ns:
                down.taken_over_ns[step.task] = now_ns
                return

    def told(self, record: TaskRecord) -> None:
        """Hear of a record."""
        if record.state.final:
            self.ended.add(record.id)

    def noticed(self, member: str, by: str, now_ns: int) -> None:
        """Hear from a gateway that it has lost another."""
        for down in reversed(self.downs):
            if down.gateway == member:
                # Later it is another loss: of a link, or of a gateway that stands still under the load.
                if not down.until_ns or now_ns < down.until_ns + LATE_NS:
                    down.noticed_ns.setdefault(by, now_ns)
                return

    def down(self, gateway: str, kind: str, now_ns: int, wall_ns: int) -> Down:
        """A gateway goes down now."""
        tasks = tuple(
            sorted(task for task, who in self.coordinator.items() if who == gateway and task not in self.ended)
        )
        found = Down(gateway=gateway, kind=kind, at_ns=now_ns, wall_ns=wall_ns, coordinated=tasks)
        self.downs.append(found)
        return found


def downtime(downs: Sequence[Down]) -> dict[str, Any]:
    """Return detection and takeover times, milliseconds: from the fault, and of takeover from its first detection too.

    A takeover is the transition by which another gateway (or the same one, when it is back first) goes on.
    """
    detection: dict[str, list[float]] = {}
    takeover: list[float] = []
    after: list[float] = []
    for down in downs:
        found = detection.setdefault(down.kind, [])
        found += [(at - down.at_ns) / 1e6 for at in down.noticed_ns.values()]
        if not down.noticed_ns:
            continue
        first = min(down.noticed_ns.values())
        takeover += [(at - down.at_ns) / 1e6 for at in down.taken_over_ns.values()]
        after += [max(0.0, (at - first) / 1e6) for at in down.taken_over_ns.values()]
    return {
        "outages": dict(Counter(down.kind for down in downs)),
        "most_down_at_once": _most_at_once(downs),
        "unnoticed": [
            f"{down.kind} of {down.gateway} for {(down.until_ns - down.at_ns) / 1e9:.2f} s"
            for down in downs
            if not down.noticed_ns
        ],
        "detection": {kind: summary(each) for kind, each in detection.items()},
        "takeover": summary(takeover),
        "takeover_after_detection": summary(after),
        "coordinated_when_lost": sum(len(down.coordinated) for down in downs),
    }


def _most_at_once(downs: Sequence[Down]) -> int:
    return max((sum(one.at_ns <= other.at_ns < one.until_ns for one in downs) for other in downs), default=0)
