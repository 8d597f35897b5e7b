"""Outcomes of plans, skills and robots, and their statistics by skill and robot. Pure, the clock passed in.

What a task's last record says of its plan, of its skills and of its robots is added up: successes, failures, durations
and memory. Only what is their own fault counts: a run that was lost with its gateway says nothing of the skill, a robot
that broke nothing of the plan.

Everything fades: after `half_life_s` an outcome counts half, so that a robot that was mended is trusted again without
anybody saying so, and a gateway's experience follows the fleet. The table is bounded; the pair that was heard of
longest ago goes first. `feedback` keeps it in the gateway's store.
"""

from collections import OrderedDict, deque
from collections.abc import Callable, Iterable
from statistics import median

from msgspec import Struct

from appliance.model import (
    Failure,
    Provenance,
    RevisionKind,
    SubtaskRecord,
    SubtaskState,
    TaskRecord,
    TaskState,
    plan_hash,
)
from appliance.model.planner_api import Row

NOT_ITS_FAULT = frozenset({"unreachable", "refused", "pool", "stopped", "orphaned", "cancelled", "prerequisite"})
"""Codes of failures that are of gateways, containers and people."""
PLANS_FAULT = frozenset({"plan", "payload", "not-found", "config", "precondition"})
"""Codes of failures by which a plan asked for what there is not, or for what cannot be done as things stand."""


class Outcome(Struct, frozen=True, kw_only=True):
    """What became of one attempt at a skill."""

    skill: str
    robot: str = ""
    """Empty for what runs on no robot."""
    good: bool
    duration_s: float | None = None
    peak_mb: float | None = None
    why: str = ""
    """Of a failure."""


def outcomes(record: TaskRecord) -> tuple[Outcome, ...]:
    """Return what became of each attempt of a task that says something of its skill or robot."""
    found: list[Outcome] = []
    for each in record.subtasks:
        found += [
            Outcome(
                skill=each.subtask.skill, robot=attempt.robot or each.bound_robot or "", good=False, why=said
            )
            for attempt in each.attempts
            if (said := _blames(attempt.failure))
        ]  # fmt: skip
        if each.state is SubtaskState.SUCCEEDED:
            found.append(_success(each))
    for revision in record.revisions:
        found += [
            Outcome(skill=each.skill, robot=each.robot or "", good=False, why=said)
            for each in revision.dropped
            if each.state is SubtaskState.FAILED and (said := _blames(each.failure))
        ]
    return tuple(found)


class PlanOutcome(Struct, frozen=True):
    """Whether a plan of the decomposer turned out well, and where it came from."""

    origin: Provenance
    good: bool


def plan_outcomes(record: TaskRecord) -> tuple[PlanOutcome, ...]:
    """Return how the decomposer's plans of a task turned out, as far as its record says.

    Bad: an operator turned it down or put another in its place; it asked for what there is not, or had to be made
    again. Good: it succeeded as it was made.
    """
    found: list[PlanOutcome] = []
    decision = record.decision
    if decision is not None and decision.plan is not None and decision.plan.provenance is not None:
        found.append(PlanOutcome(decision.plan.provenance, good=False))
    first = record.plan.provenance if record.plan is not None else None
    # What became of an edited plan says nothing of the plan that it was made of.
    if first is not None and not first.edited and (good := _ran_well(record, first)) is not None:
        found.append(PlanOutcome(first, good))
    return tuple(found)


def _ran_well(record: TaskRecord, origin: Provenance) -> bool | None:
    if record.replans or any(each.kind is RevisionKind.PLAN for each in record.revisions):
        return False
    if record.state is TaskState.SUCCEEDED and record.plan is not None:
        # A plan that another robot or skill had to help out of was not carried out as it was made.
        return True if not record.revised and plan_hash(record.plan) == origin.hash else None
    if record.state is TaskState.FAILED:
        codes = {each.failure.code for each in record.subtasks if each.failure is not None}
        codes |= {record.failure.code} if record.failure is not None else set()
        return False if codes & PLANS_FAULT else None
    return None


def _success(target: SubtaskRecord) -> Outcome:
    last = target.attempts[-1] if target.attempts else None
    return Outcome(
        skill=target.subtask.skill,
        robot=(last.robot if last is not None else None) or target.bound_robot or "",
        good=True,
        duration_s=None if target.duration_ms is None else target.duration_ms / 1e3,
        peak_mb=last.peak_mb if last is not None else None,
    )


def _blames(failure: Failure | None) -> str:
    """Why an attempt failed, if that is the fault of its skill or robot; "" otherwise."""
    if failure is None or failure.code in NOT_ITS_FAULT or failure.code in PLANS_FAULT:
        return ""
    return failure.message[:200] or failure.code


HALF_LIFE_S = 4 * 3600.0
MOST_PAIRS = 4096
WINDOW = 15
"""Durations remembered of a pair, as of a skill (`tasks.durations`)."""
LEAST_DURATIONS = 3
"""Of a pair, below which the skill's own are believed."""
TRUST = 0.9
"""Share of successes expected of what nothing is known about."""
PRIOR = 1.0
"""How many outcomes that expectation is worth."""
SHUN_BELOW = 0.5
LEAST_BAD = 1.5
"""Failures, weighed by age, before a robot is given a skill last: one may be chance."""


class Tally(Struct, kw_only=True):
    """Of one skill on one robot."""

    good: float = 0.0
    bad: float = 0.0
    at: float = 0.0
    """When the two were weighed last."""
    why: str = ""
    """Of the latest failure."""
    durations_s: deque[float]
    peak_mb: float = 0.0


class Experience:
    """The table.

    Args:
        clock: seconds.
        half_life_s: after which an outcome counts half.
        most: pairs.
    """

    def __init__(self, clock: Callable[[], float], *, half_life_s: float = HALF_LIFE_S, most: int = MOST_PAIRS) -> None:
        self._clock = clock
        self._half_life_s = half_life_s
        self._most = most
        self._pairs: OrderedDict[tuple[str, str], Tally] = OrderedDict()

    def add(self, outcomes: Iterable[Outcome]) -> None:
        """Take in what became of attempts."""
        now = self._clock()
        for each in outcomes:
            tally = self._pairs.setdefault((each.skill, each.robot), Tally(at=now, durations_s=deque(maxlen=WINDOW)))
            self._fade(tally, now)
            tally.good += each.good
            tally.bad += not each.good
            if not each.good:
                tally.why = each.why
            if each.duration_s is not None and 0 <= each.duration_s < 86_400:
                tally.durations_s.append(round(each.duration_s, 3))
            if each.peak_mb:
                tally.peak_mb = max(each.peak_mb, 0.9 * tally.peak_mb)
            self._pairs.move_to_end((each.skill, each.robot))
        while len(self._pairs) > self._most:
            self._pairs.popitem(last=False)

    def reliability(self, skill: str, robot: str) -> float:
        """Return the share of successes expected of a skill on a robot, from 0 to 1."""
        tally = self._pairs.get((skill, robot))
        if tally is None:
            return TRUST
        good, bad = self._weighed(tally)
        return (good + PRIOR * TRUST) / (good + bad + PRIOR)

    def shuns(self, skill: str, robot: str) -> str:
        """Return why a robot should be given a skill only when no other can do it; "" when nothing is against it."""
        tally = self._pairs.get((skill, robot))
        if tally is None:
            return ""
        good, bad = self._weighed(tally)
        if bad < LEAST_BAD or self.reliability(skill, robot) >= SHUN_BELOW:
            return ""
        return f"{skill} failed on {robot} {bad:.1f} times of {good + bad:.1f} lately: {tally.why}"

    def expected_s(self, skill: str, robot: str = "") -> float | None:
        """Return how long a run is expected to take: as on that robot, else as on any; None when nothing is known."""
        tally = self._pairs.get((skill, robot))
        if tally is not None and len(tally.durations_s) >= LEAST_DURATIONS:
            return median(tally.durations_s)
        every = [each for (name, _), known in self._pairs.items() if name == skill for each in known.durations_s]
        return median(every) if every else None

    def peak_mb(self, skill: str) -> float:
        """Return the most memory that runs of a skill took lately; 0: not known."""
        return max((tally.peak_mb for (name, _), tally in self._pairs.items() if name == skill), default=0.0)

    def rows(self) -> list[Row]:
        """Return the table, the least reliable first."""
        now = self._clock()
        found: list[Row] = []
        for (skill, robot), tally in self._pairs.items():
            good, bad = self._weighed(tally)
            found.append(
                Row(
                    skill=skill,
                    robot=robot,
                    good=round(good, 3),
                    bad=round(bad, 3),
                    reliability=round(self.reliability(skill, robot), 3),
                    expected_s=median(tally.durations_s) if tally.durations_s else None,
                    peak_mb=round(tally.peak_mb, 1),
                    durations_s=tuple(tally.durations_s),
                    why=tally.why,
                    shunned=bool(self.shuns(skill, robot)),
                    age_s=round(max(0.0, now - tally.at), 1),
                )
            )
        return sorted(found, key=lambda row: (row.reliability, row.skill, row.robot))

    def load(self, rows: Iterable[Row]) -> None:
        """Take in what was kept; the time that the gateway was away does not count."""
        now = self._clock()
        for row in rows:
            if len(self._pairs) < self._most:
                self._pairs[row.skill, row.robot] = Tally(
                    good=row.good,
                    bad=row.bad,
                    at=now,
                    why=row.why,
                    durations_s=deque(row.durations_s, maxlen=WINDOW),
                    peak_mb=row.peak_mb,
                )

    def _weighed(self, tally: Tally) -> tuple[float, float]:
        share = 0.5 ** (max(0.0, self._clock() - tally.at) / self._half_life_s)
        return tally.good * share, tally.bad * share

    def _fade(self, tally: Tally, now: float) -> None:
        tally.good, tally.bad = self._weighed(tally)
        tally.at = now
