"""Another robot in place of one that cannot go on: whether it may be, which one, and what it has to do first.

Pure. What the first robot has finished stays finished; where that brought it into a state that the rest builds on (a
position), copies of those subtasks go before the rest, for the new robot. Where the first robot has what no other has
(a load), nothing can be moved.
"""

import re
from collections.abc import Callable, Collection, Mapping
from typing import cast

from msgspec import Struct
from msgspec.structs import replace

from appliance.llm.checks.schema import able
from appliance.model import MAX_SUBTASKS, Failure, Plan, RobotInfo, Subtask, SubtaskRecord, SubtaskState, TaskRecord
from appliance.skills.catalogue import SkillManifest
from appliance.tasks.replan.order import before, fresh_ids, in_order
from appliance.tasks.replan.settings import ReplanConfig
from appliance.tasks.replan.ties import left
from appliance.tasks.revising import ACTIVE

_ANY = re.compile(r"any\d{0,2}")
_ITS_FAULT = ("robot", "busy", "taken", "contract", "precondition")
"""Codes of failures that are of one robot: another may have its hand free, or be there already."""
_ITS_WORD = ("refused", "unreachable", "deadline")
"""Codes that are a robot's when it is offline, or when a handler passed its final refusal on."""


class Rebinding(Struct, frozen=True, kw_only=True):
    """Another robot takes over: the plan from then on, and why that one."""

    plan: Plan
    robot: str
    note: str


class Robots(Struct, frozen=True, kw_only=True):
    """What is known of the robots: the roster, and which have a run in progress."""

    roster: Mapping[str, RobotInfo]
    busy: Collection[str] = ()
    shuns: Callable[[str, str], str] = lambda _skill, _robot: ""
    """Skill, robot -> why the robot is chosen last for it, by experience; "" if nothing is against it."""


def robot_of(target: SubtaskRecord) -> str:
    """Return the robot that a subtask is bound to, or named for; "" when there is none."""
    label = target.subtask.robot or ""
    return target.bound_robot or ("" if _ANY.fullmatch(label) else label)


def is_the_robots(failure: Failure, robot: RobotInfo | None) -> str:
    """Return why a failure is the robot's, in words, or "" when it is not."""
    if robot is None:
        return "it is not in the roster any more"
    if not robot.online:
        return "it is offline"
    if failure.code in _ITS_FAULT or (failure.code in _ITS_WORD and not failure.retryable):
        return failure.message
    return ""


def another_robot(
    record: TaskRecord,
    target: SubtaskRecord,
    why: str,
    *,
    manifests: Mapping[str, SkillManifest],
    robots: Robots,
    config: ReplanConfig,
    barred: Collection[str] = (),
) -> Rebinding | str:
    """Choose another robot for what a subtask's robot has left to do.

    Args:
        record: the task.
        target: the subtask that cannot go on.
        why: what is wrong with its robot, in words.
        manifests: by skill.
        robots: the roster.
        config: what the operator allows.
        barred: robots that are not to be chosen.

    Returns:
        The rebinding, or why there is none.
    """
    old, label = robot_of(target), target.subtask.robot or ""
    mine = [each for each in record.subtasks if each.subtask.robot == label]
    done = _finished(record, old, mine)
    problem = _not_allowed(label, mine, config) or _tied(old, done, manifests, robots)
    if problem:
        return problem
    rest = [each for each in mine if each.state is not SubtaskState.SUCCEEDED]
    roots = _roots(record, rest)
    again = _to_repeat(done, roots, manifests)
    if len(record.subtasks) + len(again) > MAX_SUBTASKS:
        return f"the plan would have more than {MAX_SUBTASKS} subtasks"
    if unknown := [each.subtask.skill for each in (*rest, *again) if each.subtask.skill not in manifests]:
        return f"what {unknown[0]} needs of a robot is not known here"
    wanted = [manifests[each.subtask.skill] for each in (*rest, *again)]
    tried = {each.robot for one in rest for each in one.attempts if each.robot and each.failure}
    chosen, reason = _choose(record, label, {old, *tried, *barred}, wanted, robots, config)
    if chosen is None:
        return f"no other robot can take over: {reason}"
    plan = _with_copies(record, {each.subtask.id for each in roots}, [each.subtask for each in again])
    repeated = f", which first repeats {', '.join(each.subtask.id for each in again)}" if again else ""
    return Rebinding(plan=plan, robot=chosen.id, note=f"{chosen.id} takes over from {old or label}: {why}{repeated}")


def _not_allowed(label: str, mine: list[SubtaskRecord], config: ReplanConfig) -> str:
    if config.robots == "never":
        return "tasks.replan.robots is `never`"
    if config.robots == "any" and not _ANY.fullmatch(label):
        return f"{label} was named by the operator (tasks.replan.robots is `any`)"
    if running := [each.subtask.id for each in mine if each.state in ACTIVE]:
        return f"{', '.join(running)} of the same robot have not ended"
    for each in mine:
        listed: object = each.subtask.params.get("robots")
        if isinstance(listed, list | tuple) and label in cast("list[object]", listed):
            return f"{each.subtask.id} is done by several robots together"
    return ""


def _tied(old: str, done: list[SubtaskRecord], manifests: Mapping[str, SkillManifest], robots: Robots) -> str:
    for word, subtask in left(done, manifests).tied.items():
        return f"{old} still has the {word} of {subtask}"
    known = robots.roster.get(old)
    return f"{old} holds {known.holding}" if known is not None and known.holding else ""


def _finished(record: TaskRecord, robot: str, mine: list[SubtaskRecord]) -> list[SubtaskRecord]:
    """What a robot has finished of its chain, in order."""
    order = {each.id: at for at, each in enumerate(in_order(one.subtask for one in record.subtasks))}
    done = [each for each in mine if each.state is SubtaskState.SUCCEEDED and robot_of(each) == robot]
    return sorted(done, key=lambda each: order[each.subtask.id])


def _roots(record: TaskRecord, rest: list[SubtaskRecord]) -> list[SubtaskRecord]:
    """Those of the rest that come after none of it."""
    everything = [each.subtask for each in record.subtasks]
    ids = {each.subtask.id for each in rest}
    return [each for each in rest if not ids & before(each.subtask.id, everything)]


def _to_repeat(
    done: list[SubtaskRecord], roots: list[SubtaskRecord], manifests: Mapping[str, SkillManifest]
) -> list[SubtaskRecord]:
    """Finished subtasks whose state the rest builds on, in order; without those that it does anew at its beginning."""
    known = [manifests.get(each.subtask.skill) for each in roots]
    anew = [frozenset(each.prepares) if each is not None else frozenset[str]() for each in known]
    names = {name for word, name in left(done, manifests).prepared.items() if not all(word in each for each in anew)}
    return [each for each in done if each.subtask.id in names]


def _choose(
    record: TaskRecord,
    label: str,
    avoid: set[str],
    wanted: list[SkillManifest],
    robots: Robots,
    config: ReplanConfig,
) -> tuple[RobotInfo | None, str]:
    reasons: list[str] = []
    fitting: list[RobotInfo] = []
    for robot in robots.roster.values():
        if robot.id in avoid:
            continue
        problem = "" if robot.online else f"{robot.id} is offline"
        battery = robot.battery_percent
        if not problem and battery is not None and battery < config.min_battery_percent:
            problem = f"{robot.id} has {battery:.0f} % of its battery"
        if not problem and robot.holding:
            problem = f"{robot.id} holds {robot.holding}"
        problem = problem or next((text for each in wanted if (text := able(robot, each))), "")
        if problem:
            reasons.append(problem)
        else:
            fitting.append(robot)
    others = {robot_of(each) for each in record.subtasks if each.subtask.robot not in (None, label)}
    shunned = {robot.id: any(robots.shuns(each.id, robot.id) for each in wanted) for robot in fitting}
    fitting.sort(key=lambda robot: (robot.id in others, shunned[robot.id], robot.id in robots.busy, robot.id))
    if not fitting:
        return None, "; ".join(sorted(reasons)[:4]) or "there is no other"
    return fitting[0], ""


def _with_copies(record: TaskRecord, roots: set[str], again: list[Subtask]) -> Plan:
    """The plan with copies of `again`, one after the other, before the first of the rest (`roots`)."""
    plan = record.plan
    assert plan is not None  # noqa: S101 - a record with subtasks has the plan they are of
    if not again:
        return plan
    names = fresh_ids(record, len(again))
    copies: list[Subtask] = []
    for name, each in zip(names, again, strict=True):
        # After what the original came after, and that is done, so that it has the same results to go by.
        after = tuple(name for name in each.after if record.of(name).state is SubtaskState.SUCCEEDED)
        copies.append(replace(each, id=name, after=(*after, *(copies[-1].id for _ in copies[-1:]))))
    changed = [
        replace(each.subtask, after=(*each.subtask.after, names[-1])) if each.subtask.id in roots else each.subtask
        for each in record.subtasks
    ]
    return replace(plan, subtasks=(*changed, *copies))
