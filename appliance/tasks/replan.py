"""What is done about a subtask that was given up: pure decisions, cheapest first.

Retrying elsewhere comes before all this (`machine.gives_up`, `placement`). Then `decide` tries another robot, an
alternative skill, a new plan of the decomposer, or nothing: facts in, one decision out, with the reasons why nothing
simpler would do, in words for people. The coordinator carries it out; the rules that every revision must keep are in
`machine`.

**What ties work to a robot.** A skill's manifest says what state it leaves its robot in: `ties` what no other robot has
(a load in the gripper), `prepares` what another can be brought into by doing the same (a position, being airborne),
`frees` what it ends. A robot's work since the last point at which nothing was left, the last neutral point, is what
counts.

**Another robot.** What the first robot has finished stays finished; where that brought it into a state that the rest
builds on (a position), copies of those subtasks go before the rest, for the new robot. Where the first robot has what
no other has (a load), nothing can be moved.

**An alternative skill.** Only those that the skill's manifest names, with parameters mapped. The alternative gets an id
of its own, since the effects of a handler are known by the subtask's id: under the old one it would meet the answers to
the calls of another handler.

**A new plan.** The decomposer answers with a whole plan, as for any instruction. `splice` fits it to what the task has
finished and has under way: what of it has been done, runs, or waits already is known by what it is (skill, robot,
parameters), not by its id, which a model may write as it likes; the rest is new and gets ids that the task has never
had. Finished subtasks that it does not mention stay all the same.

A plan that was allowed may not be any more with another robot or another skill in it, so what is left of a revised plan
is checked again.
"""

import hashlib
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any, cast

from msgspec import Struct
from msgspec.structs import replace

from appliance.llm.checks.schema import able
from appliance.model import MAX_SUBTASKS, Failure, Plan, RobotInfo, Subtask, SubtaskRecord, SubtaskState, TaskRecord
from appliance.skills.catalogue import Alternative, SkillManifest
from appliance.tasks.machine import ACTIVE
from appliance.tasks.settings import ReplanConfig


def in_order(subtasks: Iterable[Subtask]) -> tuple[Subtask, ...]:
    """Return subtasks so that each stands after those it comes after, otherwise as they stood."""
    waiting = list(subtasks)
    known = {each.id for each in waiting}
    done: set[str] = set()
    ordered: list[Subtask] = []
    while waiting:
        free = [each for each in waiting if done.issuperset(known.intersection(each.after))]
        if not free:
            return (*ordered, *waiting)  # a cycle: the plan's review will say so
        ordered.extend(free)
        done.update(each.id for each in free)
        waiting = [each for each in waiting if each.id not in done]
    return tuple(ordered)


def before(subtask: str, subtasks: Iterable[Subtask]) -> frozenset[str]:
    """Return the ids of all that a subtask comes after, directly or not."""
    after = {each.id: each.after for each in subtasks}
    found: set[str] = set()
    open_ids = list(after.get(subtask, ()))
    while open_ids:
        name = open_ids.pop()
        if name not in found:
            found.add(name)
            open_ids.extend(after.get(name, ()))
    return frozenset(found)


def fresh_ids(record: TaskRecord, count: int) -> list[str]:
    """Return ids for new subtasks of a task's next revision, none of them used before in this task.

    They differ by coordinator, since the two sides of a partition may both revise a plan: the effects of handlers are
    known by these ids, and a robot must not take a command of the one for that of the other.
    """
    taken = {*(each.subtask.id for each in record.subtasks), *record.retired}
    digest = hashlib.sha256(record.coordinator.encode()).digest()
    mark = "".join(chr(ord("a") + byte % 26) for byte in digest[:3])
    found: list[str] = []
    number = 0
    while len(found) < count:
        number += 1
        name = f"r{record.revised + 1}{mark}_{number}"
        if name not in taken:
            found.append(name)
    return found


class Left(Struct, frozen=True):
    """State a robot's finished work leaves it in: by word, the id of the subtask that left it."""

    tied: Mapping[str, str]
    prepared: Mapping[str, str]


def left(finished: Sequence[SubtaskRecord], manifests: Mapping[str, SkillManifest]) -> Left:
    """Return what finished subtasks of one robot, in order, leave it in.

    Args:
        finished: the robot's own, in the order in which they were done.
        manifests: by skill; one that is not known leaves nothing, since nothing is known of it.
    """
    tied: dict[str, str] = {}
    prepared: dict[str, str] = {}
    for each in finished:
        manifest = manifests.get(each.subtask.skill)
        if manifest is None:
            continue
        for word in manifest.frees:
            tied.pop(word, None)
            prepared.pop(word, None)
        for word in manifest.ties:
            tied[word] = each.subtask.id
        for word in manifest.prepares:
            # Kept in the order of the last preparation: a place is reached after taking off, not before.
            prepared.pop(word, None)
            prepared[word] = each.subtask.id
    return Left(tied, prepared)


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
    short: Callable[[RobotInfo, Sequence[Subtask]], str] = lambda _robot, _subtasks: ""
    """Robot, subtasks -> why its charge does not do for them; "" if it does."""


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
    to_do = [each.subtask for each in (*again, *rest)]
    wanted = [manifests[each.skill] for each in to_do]
    tried = {each.robot for one in rest for each in one.attempts if each.robot and each.failure}
    chosen, reason = _choose(record, label, {old, *tried, *barred}, wanted, to_do, robots)
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
    """Finished subtasks whose state the rest builds on, in order; without those that it does again at its beginning."""
    known = [manifests.get(each.subtask.skill) for each in roots]
    again = [frozenset(each.prepares) if each is not None else frozenset[str]() for each in known]
    names = {name for word, name in left(done, manifests).prepared.items() if not all(word in each for each in again)}
    return [each for each in done if each.subtask.id in names]


def _choose(
    record: TaskRecord,
    label: str,
    avoid: set[str],
    wanted: list[SkillManifest],
    to_do: list[Subtask],
    robots: Robots,
) -> tuple[RobotInfo | None, str]:
    reasons: list[str] = []
    fitting: list[RobotInfo] = []
    for robot in robots.roster.values():
        if robot.id in avoid:
            continue
        problem = "" if robot.online else f"{robot.id} is offline"
        if not problem and robot.holding:
            problem = f"{robot.id} holds {robot.holding}"
        problem = problem or robots.short(robot, to_do)
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


NOT_FOR = frozenset({"cancelled", "payload"})
"""Codes of failures that another skill does not help against: somebody stopped it, or the order itself was wrong."""


class Substitution(Struct, frozen=True, kw_only=True):
    """An alternative takes the place of a skill: the plan from then on, the new subtask in it, and a sentence."""

    plan: Plan
    subtask: Subtask
    note: str


def alternative_skill(
    record: TaskRecord, target: SubtaskRecord, *, manifests: Mapping[str, SkillManifest]
) -> Substitution | str:
    """Choose the first alternative of a skill that can take its place, or say why there is none.

    One can when it is there and runs where the other does, has not failed here before, and produces what
    later subtasks use of the other's results.
    """
    manifest = manifests.get(target.subtask.skill)
    failure = target.failure or Failure(code="", message="")
    if manifest is None or not manifest.alternatives:
        return f"{target.subtask.skill} has no alternatives"
    if failure.code in NOT_FOR:
        return f"no other skill helps against a failure of the kind {failure.code}"
    reasons: list[str] = []
    for choice in manifest.alternatives:
        problem = _problem(record, target, manifest, choice, manifests)
        if problem:
            reasons.append(problem)
            continue
        (name,) = fresh_ids(record, 1)
        subtask = Subtask(
            id=name,
            skill=choice.skill,
            robot=target.subtask.robot,
            params=mapped(choice, target.subtask.params),
            after=target.subtask.after,
        )
        note = f"{name} ({choice.skill}) takes the place of {target.subtask.id} ({manifest.id}): {failure.message}"
        return Substitution(plan=_swapped(record, target.subtask.id, subtask), subtask=subtask, note=note)
    return "; ".join(reasons)


def mapped(choice: Alternative, params: Mapping[str, Any]) -> dict[str, Any]:
    """Return the alternative's parameters: `$name` takes ours of that name if there is one, other text stands."""
    found: dict[str, Any] = {}
    for name, source in choice.params.items():
        if not source.startswith("$"):
            found[name] = source
        elif source[1:] in params:
            found[name] = params[source[1:]]
    return found


def _problem(
    record: TaskRecord,
    target: SubtaskRecord,
    manifest: SkillManifest,
    choice: Alternative,
    manifests: Mapping[str, SkillManifest],
) -> str:
    other = manifests.get(choice.skill)
    if other is None or not other.implemented:
        return f"{choice.skill} is not implemented here"
    if choice.skill in target.instead_of:
        return f"{choice.skill} was given up here before"
    if other.runs != manifest.runs:
        return f"{choice.skill} runs on {'a robot' if other.runs == 'robot' else 'a gateway'}"
    given = mapped(choice, target.subtask.params)
    missing = [name for name, param in other.params.items() if param.required and given.get(name) in (None, "")]
    if missing:
        return f"{choice.skill} needs {' and '.join(missing)}"
    used = _used(record, target, manifest, manifests)
    if lacking := sorted(used - frozenset(other.produces)):
        return f"{choice.skill} gives no {' and no '.join(lacking)}, which later subtasks use"
    return ""


def _used(
    record: TaskRecord, target: SubtaskRecord, manifest: SkillManifest, manifests: Mapping[str, SkillManifest]
) -> frozenset[str]:
    """Kinds of data that subtasks right after it take from it."""
    takers = [
        manifests[each.subtask.skill]
        for each in record.subtasks
        if target.subtask.id in each.subtask.after and each.subtask.skill in manifests
    ]
    # A report takes whatever there is: it does not need each kind of it.
    needs = [frozenset(each.consumes) & frozenset(manifest.produces) for each in takers if len(each.consumes) == 1]
    return frozenset[str]().union(*needs)


def _swapped(record: TaskRecord, old: str, new: Subtask) -> Plan:
    plan = record.plan
    assert plan is not None  # noqa: S101 - a record with subtasks has the plan they are of
    subtasks: list[Subtask] = []
    for each in record.subtasks:
        if each.subtask.id == old:
            subtasks.append(new)
        elif old in each.subtask.after and each.state is not SubtaskState.SUCCEEDED:
            after = tuple(new.id if name == old else name for name in each.subtask.after)
            subtasks.append(replace(each.subtask, after=after))
        else:
            subtasks.append(each.subtask)
    return replace(plan, subtasks=tuple(subtasks))


class Spliced(Struct, frozen=True, kw_only=True):
    """The plan from then on; `ending` names runs that are to be ended before it takes effect."""

    plan: Plan
    added: tuple[str, ...] = ()
    ending: tuple[str, ...] = ()


def splice(record: TaskRecord, proposed: Plan) -> Spliced:
    """Return the plan of a task that goes on as proposed."""
    matches = _matches(record, proposed.subtasks)
    new = [each for each in proposed.subtasks if each.id not in matches]
    names = {each.id: name for each, name in zip(new, fresh_ids(record, len(new)), strict=True)}
    names.update({theirs: ours.subtask.id for theirs, ours in matches.items()})
    begun = [each for each in record.subtasks if each.state is SubtaskState.SUCCEEDED or each.state in ACTIVE]
    matched = {each.subtask.id for each in matches.values()}
    kept = [each.subtask for each in begun if each.state is SubtaskState.SUCCEEDED or each.subtask.id in matched]
    stays = {each.id for each in kept}
    rest: list[Subtask] = []
    for each in proposed.subtasks:
        name = names[each.id]
        if name not in stays:
            ours = matches.get(each.id)
            subtask = ours.subtask if ours is not None else each
            after = tuple(dict.fromkeys(names[one] for one in each.after if one in names))
            rest.append(replace(subtask, id=name, after=after))
    return Spliced(
        plan=replace(proposed, subtasks=(*kept, *rest)),
        added=tuple(names[each.id] for each in new),
        ending=tuple(each.subtask.id for each in begun if each.subtask.id not in stays),
    )


def problems(record: TaskRecord, proposed: Plan, manifests: Mapping[str, SkillManifest]) -> tuple[str, ...]:
    """Return what is wrong with a new plan beyond what any plan may have wrong; a sentence each.

    It must not repeat what has just failed, have a robot put down what another one holds, or be too long together with
    what is finished.
    """
    found: list[str] = []
    for each in proposed.subtasks:
        for failed in record.subtasks:
            if failed.state is SubtaskState.FAILED and _same(failed, each):
                reason = failed.failure.message if failed.failure else "it failed"
                found.append(
                    f"{each.id} ({each.skill}): this has failed ({reason}): do it in another way, or leave it out"
                )
    found += _loads(record, proposed, manifests)
    if len(splice(record, proposed).plan.subtasks) > MAX_SUBTASKS:
        found.append(f"with what is finished the plan has more than {MAX_SUBTASKS} subtasks: plan less")
    return tuple(dict.fromkeys(found))


def _matches(record: TaskRecord, proposed: Sequence[Subtask]) -> dict[str, SubtaskRecord]:
    """Which of their subtasks is which of ours: the same id first, then in order; never one that has failed."""
    free = [each for each in record.subtasks if each.state is not SubtaskState.FAILED]
    found: dict[str, SubtaskRecord] = {}
    for by_id in (True, False):
        for each in in_order(proposed):
            if each.id in found:
                continue
            ours = next((one for one in free if _same(one, each) and (not by_id or one.subtask.id == each.id)), None)
            if ours is not None:
                found[each.id] = ours
                free.remove(ours)
    return found


def _same(ours: SubtaskRecord, theirs: Subtask) -> bool:
    subtask = ours.subtask
    robots = (subtask.robot, ours.bound_robot) if ours.bound_robot else (subtask.robot,)
    return theirs.skill == subtask.skill and theirs.params == subtask.params and theirs.robot in robots


def _loads(record: TaskRecord, proposed: Plan, manifests: Mapping[str, SkillManifest]) -> Iterable[str]:
    """Robots that are to hand over or put down what another robot holds."""
    holders = _holders(record, manifests)
    matched = {theirs for theirs, ours in _matches(record, proposed.subtasks).items() if _done(ours)}
    by_id = {each.id: each for each in proposed.subtasks}
    for each in proposed.subtasks:
        manifest = manifests.get(each.skill)
        if manifest is None or each.id in matched:
            continue
        for word in manifest.frees:
            holder = holders.get(word)
            if holder is None or each.robot in (None, holder):
                continue
            earlier = [by_id[name] for name in before(each.id, proposed.subtasks) if name in by_id]
            takes = any(
                one.robot == each.robot and one.skill in manifests and word in manifests[one.skill].ties
                for one in earlier
            )  # fmt: skip
            if not takes:
                yield f"{each.id} ({each.skill}): {holder} has the {word}, not {each.robot}: have {holder} do it"


def _done(record: SubtaskRecord) -> bool:
    return record.state is SubtaskState.SUCCEEDED


def _holders(record: TaskRecord, manifests: Mapping[str, SkillManifest]) -> dict[str, str]:
    """State that ties, by word: which robot has it, by what is finished."""
    order = {each.id: at for at, each in enumerate(in_order(one.subtask for one in record.subtasks))}
    found: dict[str, str] = {}
    by_robot: dict[str, list[SubtaskRecord]] = {}
    for each in sorted(filter(_done, record.subtasks), key=lambda one: order[one.subtask.id]):
        by_robot.setdefault(robot_of(each), []).append(each)
    for robot, finished in by_robot.items():
        if robot:
            found.update(dict.fromkeys(left(finished, manifests).tied, robot))
    return found


Against = Callable[[Plan, str], Sequence[str]]
"""A revised plan, the robot that takes over or "" -> what is against it."""
_TOLD = 3


def remainder(record: TaskRecord, target: SubtaskRecord, plan: Plan, robot: str) -> Plan:
    """Return what of a revised plan is not begun, with the robots that are chosen in place of their labels.

    Args:
        record: the task as it stands.
        target: the subtask that was given up.
        plan: the task's plan from then on.
        robot: who takes over from the robot of `target`; "" when nobody does.
    """
    states = {each.subtask.id: each for each in record.subtasks}
    begun = {name for name, each in states.items() if each.state is SubtaskState.SUCCEEDED or each.state in ACTIVE}
    label, taker = target.subtask.robot, robot or robot_of(target)
    rest: list[Subtask] = []
    for each in plan.subtasks:
        if each.id in begun:
            continue
        known = states.get(each.id)
        bound = known.bound_robot if known is not None else None
        chosen = (taker or each.robot) if label is not None and each.robot == label else bound or each.robot
        rest.append(replace(each, robot=chosen, after=tuple(one for one in each.after if one not in begun)))
    return replace(plan, subtasks=tuple(rest))


def allowed_robot(
    record: TaskRecord,
    target: SubtaskRecord,
    why: str,
    *,
    manifests: Mapping[str, SkillManifest],
    robots: Robots,
    config: ReplanConfig,
    against: Against,
) -> Rebinding | str:
    """Choose another robot as `another_robot` does, of those that nothing is against; else say why there is none."""
    reasons: dict[str, str] = {}
    while True:
        found = another_robot(
            record, target, why, manifests=manifests, robots=robots, config=config, barred=reasons.keys()
        )
        if not isinstance(found, Rebinding):
            return "; ".join((*list(reasons.values())[:_TOLD], found))
        wrong = against(found.plan, found.robot)
        if not wrong:
            return found
        reasons[found.robot] = f"{found.robot} may not take over: {'; '.join(wrong[:_TOLD])}"


class AskDecomposer(Struct, frozen=True, kw_only=True):
    """Nothing simpler helps: the decomposer is to replan what is left."""

    note: str


class GiveUp(Struct, frozen=True, kw_only=True):
    """Nothing can be done; why, in words."""

    note: str


Decision = Rebinding | Substitution | AskDecomposer | GiveUp


def worth_replanning(failure_code: str) -> bool:
    """Whether a subtask that is given up is looked at at all: not when somebody stopped it."""
    return failure_code != "cancelled"


def confirmed(record: TaskRecord) -> bool:
    """Whether somebody approved a plan of this task, or it came with the decomposer's, which somebody had looked at.

    One that was written by hand says nothing of how sure a planner is of it.
    """
    if record.decision is not None and record.decision.approved:
        return True
    return record.handed_in and record.plan is not None and record.plan.confidence > 0


def decide(
    record: TaskRecord,
    target: SubtaskRecord,
    *,
    manifests: Mapping[str, SkillManifest],
    robots: Robots,
    config: ReplanConfig,
    against: Against = lambda _plan, _robot: (),
) -> Decision:
    """Decide what is done about a subtask that was given up.

    Args:
        record: the task, in which the subtask stands as failed.
        target: the subtask.
        manifests: those that are known here, by skill.
        robots: the roster.
        config: what the operator allows.
        against: what is against a revised plan, by the checks that every plan has to pass.
    """
    if record.revised >= config.max_revisions:
        return GiveUp(note=f"the plan was revised {record.revised} times already (tasks.replan.max_revisions)")
    reasons: list[str] = []
    if target.subtask.robot is not None:
        robot = robot_of(target)
        why = is_the_robots(target.failure, robots.roster.get(robot)) if target.failure and robot else ""
        if why:
            rebinding = allowed_robot(
                record, target, why, manifests=manifests, robots=robots, config=config, against=against
            )
            if isinstance(rebinding, Rebinding):
                return rebinding
            reasons.append(rebinding)
    substitution = (
        alternative_skill(record, target, manifests=manifests) if config.skills else "tasks.replan.skills is off"
    )
    if isinstance(substitution, Substitution):
        wrong = against(substitution.plan, "")
        if not wrong:
            return substitution
        substitution = f"{substitution.subtask.skill} may not take its place: {'; '.join(wrong[:3])}"
    reasons.append(substitution)
    if record.handed_in and not confirmed(record):
        reasons.append("its plan was handed in with the task and is not replanned")
    elif not config.decompose:
        reasons.append("tasks.replan.decompose is off")
    elif record.replans >= config.max_replans:
        reasons.append(f"it was replanned {record.replans} times already (tasks.replan.max_replans)")
    else:
        return AskDecomposer(note="; ".join(reasons))
    return GiveUp(note="; ".join(reasons))
