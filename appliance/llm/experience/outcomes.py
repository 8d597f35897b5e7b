"""What a task's record says of its plan, of its skills and of its robots. Pure.

Only what is their own fault counts: a run that was lost with its gateway says nothing of the skill, a robot that broke
nothing of the plan.
"""

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
