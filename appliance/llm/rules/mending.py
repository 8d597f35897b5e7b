"""What rules can do when the rest of a plan is to be planned anew: drop-in alternatives, and nothing else.

A failed subtask is replaced by a skill that manifests name as an alternative, or as an alternative of that, on a robot
that can do it. Rules understand words, not causes: where that does not help they say so.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from appliance.errors import PlanError
from appliance.llm.checks.schema import able
from appliance.llm.so_far import SoFar, Step
from appliance.model import Plan, RobotInfo, Subtask, Tier
from appliance.skills.catalogue import Catalogue, SkillManifest

CONFIDENCE = 1.0
"""The rules' is the share of the words that were understood, and here are none that could be misunderstood: what takes
the place of a failed subtask is what the manifests declare."""


def mend(so_far: SoFar, catalogue: Catalogue, robots: Sequence[RobotInfo] | None) -> Plan:
    """Return the earlier plan with alternatives in place of what failed; pure.

    Raises:
        PlanError: there is none for one of them.
    """
    subtasks: list[Subtask] = []
    names = {each.id: f"s{number}" for number, each in enumerate(so_far.steps, start=1)}
    stuck: list[str] = []
    for each in so_far.steps:
        after = tuple(names[one] for one in each.after if one in names)
        if each.state != "failed":
            subtasks.append(
                Subtask(id=names[each.id], skill=each.skill, robot=each.robot, params=each.params, after=after)
            )
        elif (found := _instead(each, catalogue, robots or (), so_far)) is not None:
            skill, robot, params = found
            subtasks.append(Subtask(id=names[each.id], skill=skill, robot=robot, params=params, after=after))
        else:
            stuck.append(f"{each.id} ({each.skill}) has failed and no alternative to it is known: {each.reason}")
    if stuck:
        raise PlanError(
            "rules cannot plan around a failure",
            problems=tuple(stuck),
            remedy="configure a model (llm.local_model or llm.upstream_url), or give a new instruction",
        )
    domains = [catalogue.skills[each.skill].domain for each in subtasks if each.skill in catalogue.skills]
    return Plan(domain=domains[0] if domains else "", subtasks=tuple(subtasks), tier=Tier.RULES, confidence=CONFIDENCE)


def _instead(
    step: Step, catalogue: Catalogue, robots: Sequence[RobotInfo], so_far: SoFar
) -> tuple[str, str | None, dict[str, Any]] | None:
    """A skill in place of a failed one, its robot and parameters: breadth first over declared alternatives."""
    failed = {(each.skill, each.robot) for each in so_far.of("failed")}
    queue: list[tuple[str, Mapping[str, Any]]] = [(step.skill, step.params)]
    seen = {step.skill}
    for name, params in queue:
        manifest = catalogue.skills.get(name)
        for choice in manifest.alternatives if manifest is not None else ():
            other = catalogue.skills.get(choice.skill)
            if other is None or choice.skill in seen:
                continue
            seen.add(choice.skill)
            given = {key: params[text[1:]] if text.startswith("$") else text for key, text in choice.params.items()
                     if not text.startswith("$") or text[1:] in params}  # fmt: skip
            queue.append((choice.skill, given))
            robot = _robot(step, other, robots)
            complete = all(not param.required or given.get(key) for key, param in other.params.items())
            if other.implemented and complete and robot != "" and (other.id, robot) not in failed:
                return other.id, robot, given
    return None


def _robot(step: Step, manifest: SkillManifest, robots: Sequence[RobotInfo]) -> str | None:
    """The robot for it: the same if it can, else any that can; "" when there is none, None when none is needed."""
    if manifest.runs == "compute":
        return None
    fitting = sorted(each.id for each in robots if each.online and not able(each, manifest))
    if step.robot in fitting:
        return step.robot
    return fitting[0] if fitting else ""
