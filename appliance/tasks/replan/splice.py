"""Fits a new plan of the decomposer to what a task has finished and has under way; pure.

The decomposer answers with a whole plan, as for any instruction. What of it has been done, runs, or waits already is
known by what it is (skill, robot, parameters), not by its id, which a model may write as it likes; the rest is new and
gets ids that the task has never had. Finished subtasks that it does not mention stay all the same.
"""

from collections.abc import Iterable, Mapping, Sequence

from msgspec import Struct
from msgspec.structs import replace

from appliance.model import MAX_SUBTASKS, Plan, Subtask, SubtaskRecord, SubtaskState, TaskRecord
from appliance.skills.catalogue import SkillManifest
from appliance.tasks.replan.order import before, fresh_ids, in_order
from appliance.tasks.replan.robots import robot_of
from appliance.tasks.replan.ties import left
from appliance.tasks.revising import ACTIVE


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
