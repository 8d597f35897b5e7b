"""The rules of operators' orders on a task: approve, reject, pause, resume, retry.

What becomes of an order is decided by the record alone: taken, done already, or why not. Two operators who act on one
task are decided between there and by the compare-and-set under which the record is written: the one whose order is in
the record was first, and the other gets the name of the first.
"""

import time
from collections.abc import Mapping
from typing import Any

from appliance.errors import (
    ConflictError,
    NotFoundError,
    RefusedError,
)
from appliance.llm.checks.schema import able, is_unnamed
from appliance.model import (
    Approval,
    Plan,
    Proposal,
    RobotInfo,
    Subtask,
    SubtaskState,
    TaskRecord,
    TaskState,
    Word,
)
from appliance.model.task_api import ApproveAsk, FirstAsk, PauseAsk, RejectAsk, ResumeAsk, RetryAsk
from appliance.skills.catalogue import SkillManifest
from appliance.tasks.machine import ACTIVE, SHORTEST, matches
from appliance.tasks.records import refuse_trimmed


def needs_approval(
    plan: Plan, wanted: Approval, *, manifests: Mapping[str, SkillManifest], robots: Mapping[str, RobotInfo]
) -> str:
    """Why a plan has to be approved before it takes effect; empty when it need not be.

    Args:
        plan: the plan.
        wanted: what configuration and request ask for.
        manifests: skills by name.
        robots: the roster: what flies is dangerous, whatever it does, and so is what one that flies may be chosen for.
    """
    if wanted is Approval.NEVER:
        return ""
    if wanted is Approval.ALWAYS:
        return "every plan is approved first"
    reasons: list[str] = []
    for each in plan.subtasks:
        manifest = manifests.get(each.skill)
        if manifest is not None and manifest.danger:
            reasons.append(f"{each.id} ({each.skill}): {manifest.danger}")
        elif manifest is not None and "base" in manifest.uses and (flying := _flying(each, manifest, robots)):
            reasons.append(f"{each.id} ({each.skill}): {flying}")
    more = f", and {len(reasons) - 5} more" if len(reasons) > 5 else ""
    return "; ".join(reasons[:5]) + more


def _flying(subtask: Subtask, manifest: SkillManifest, robots: Mapping[str, RobotInfo]) -> str:
    """Which robot that flies does a subtask, or may be chosen for it; offline ones too, since they may come back."""
    name = subtask.robot or ""
    if not is_unnamed(name):
        robot = robots.get(name)
        return f"{name} flies" if robot is not None and robot.flies else ""
    found = [each for each in sorted(robots) if robots[each].flies and not able(robots[each], manifest)]
    return f"{found[0]} may be chosen, which flies" if found else ""


def proposal_for(record: TaskRecord, ask: ApproveAsk | RejectAsk) -> Proposal | None:
    """The proposal that an operator's word is about; None when this very order has been carried out already.

    Raises:
        ConflictError: somebody else was faster, or another plan waits by now.
        RefusedError: nothing waits, or the hash is too short to mean one.
    """
    proposal, decision = record.proposal, record.decision
    if ask.act and decision is not None and decision.act == ask.act:
        return None
    waits = record.state in (TaskState.PROPOSED, TaskState.RUNNING) and proposal is not None and proposal.waits
    if not waits or proposal is None:
        if decision is not None:
            did = "approved" if decision.approved else "rejected"
            edited = " in an edited form" if decision.edited else ""
            said = f": {decision.why}" if decision.why else ""
            raise ConflictError(
                f"{decision.by or 'another operator'} has {did} the plan of task {record.id}{edited} already{said}",
                remedy=f"see `swiftbot task show {record.id}`",
            )
        raise RefusedError(
            f"nothing of task {record.id} waits for an operator's word: it is {record.state}",
            remedy=f"see `swiftbot task show {record.id}`",
        )
    if ask.hash and not matches(ask.hash, proposal.hash):
        if len(ask.hash) < SHORTEST:
            raise RefusedError(f"{ask.hash!r} is too short for a hash", remedy=f"give {SHORTEST} characters or more")
        raise ConflictError(
            f"the plan of task {record.id} that waits by now is another one: {proposal.hash[:12]}",
            remedy="look at it, then decide",
        )
    return proposal


def may_pause(record: TaskRecord, ask: PauseAsk) -> bool:
    """Whether a pause is to be written; False when this very order was.

    Raises:
        ConflictError: somebody else has paused it.
        RefusedError: it has ended, or is being ended.
    """
    for each in record.pauses:
        if not each.stop:
            if ask.act and each.act == ask.act:
                return False
            raise ConflictError(f"task {record.id} is {each.text} already")
    if record.state.final or record.state is TaskState.CANCELLING:
        raise RefusedError(f"task {record.id} is {record.state}: there is nothing to pause")
    return True


def may_resume(record: TaskRecord, ask: ResumeAsk) -> bool:
    """Whether a pause is to be taken back; False when there is none any more.

    Raises:
        RefusedError: it waits for a soft stop to be lifted, or has ended.
    """
    del ask
    if record.state.final:
        raise RefusedError(f"task {record.id} has {record.state}", remedy=f"`swiftbot task retry {record.id}`")
    if any(not each.stop for each in record.pauses):
        return True
    if record.pauses:
        raise RefusedError(
            f"task {record.id} goes on when the stop is lifted: {record.paused}", remedy="`swiftbot resume`"
        )
    return False


def may_move(record: TaskRecord, ask: FirstAsk) -> bool:
    """Whether a task is to be put before others; False when this very order was carried out.

    Raises:
        RefusedError: it has ended, or is to go before itself.
    """
    if ask.act and record.ranked_by is not None and record.ranked_by.act == ask.act:
        return False
    if record.state.final or record.state is TaskState.CANCELLING:
        raise RefusedError(f"task {record.id} is {record.state}: it waits for no robot")
    if ask.before == record.id:
        raise RefusedError(f"task {record.id} cannot go before itself", remedy="name another task, or none")
    return True


def may_retry(record: TaskRecord, ask: RetryAsk) -> bool:
    """Whether something is to be tried again; False when this very order was carried out.

    Raises:
        NotFoundError: the plan has no such subtask.
        RefusedError: there is nothing to try again, with the reason.
    """
    if ask.act and record.retried_by is not None and record.retried_by.act == ask.act:
        return False
    refuse_trimmed(record)
    target = None
    if ask.subtask:
        try:
            target = record.of(ask.subtask)
        except KeyError:
            known = ", ".join(each.subtask.id for each in record.subtasks) or "none"
            raise NotFoundError(
                f"task {record.id} has no subtask {ask.subtask[:60]!r}", remedy=f"it has: {known}"
            ) from None
        if target.state is SubtaskState.SUCCEEDED:
            raise RefusedError(f"{ask.subtask} has succeeded, and what has succeeded is kept")
    if record.state in (TaskState.FAILED, TaskState.CANCELLED):
        return True
    if record.state is TaskState.SUCCEEDED:
        raise RefusedError(f"task {record.id} has succeeded", remedy="submit it again")
    if record.state is not TaskState.RUNNING or target is None:
        who = f"; {record.retried_by.by} had it tried again" if record.retried_by is not None else ""
        raise RefusedError(
            f"task {record.id} is {record.state}{who}: there is nothing to try again",
            remedy="name one of its subtasks, or wait for its end",
        )
    if target.state not in (*ACTIVE, SubtaskState.FAILED):
        raise RefusedError(f"{ask.subtask} is {target.state}: it has not been tried yet, or will be by itself")
    return True


def needed_robots(record: TaskRecord) -> tuple[str, ...]:
    """The robots that a task still needs, by name, or by label (`any1`) where none is chosen yet."""
    names = {robot for each in record.subtasks if not each.state.final for robot in each.robots}
    if record.state is TaskState.PROPOSED and record.proposal is not None:
        names |= {robot for each in record.proposal.plan.subtasks for robot in each.robots}
    return tuple(sorted(names))


def revived(record: TaskRecord, ask: RetryAsk, *, elapsed_s: float) -> dict[str, Any] | None:
    """Return the fields of the transition that begins a task again that has ended; None when that was done.

    A deadline that has passed is dropped: with it the task would end at once.
    """
    if not may_retry(record, ask):
        return None
    return {
        "subtask": ask.subtask,
        "note": f"tried again by {ask.by or 'an operator'}",
        "word": word_of(ask),
        "deadline_s": record.deadline_s if record.deadline_s > elapsed_s else 0.0,
    }


def word_of(ask: RejectAsk | RetryAsk | FirstAsk) -> Word:
    """Return who gives an order, and why, as a record keeps it."""
    return Word(by=ask.by, why=ask.why, act=ask.act, at_ns=time.time_ns())
