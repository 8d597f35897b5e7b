"""An alternative skill in place of one that was given up: only those that its manifest names, parameters mapped.

Pure. The alternative gets an id of its own, since the effects of a handler are known by the subtask's id: under the
old one it would meet the answers to the calls of another handler.
"""

from collections.abc import Mapping
from typing import Any

from msgspec import Struct
from msgspec.structs import replace

from appliance.model import Failure, Plan, Subtask, SubtaskRecord, SubtaskState, TaskRecord
from appliance.skills.catalogue import Alternative, SkillManifest
from appliance.tasks.replan.order import fresh_ids

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
