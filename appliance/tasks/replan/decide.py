"""What to do about a subtask that was given up, cheapest first: another robot, another skill, a new plan, or nothing.

Pure: facts in, one decision out, with the reasons why nothing simpler would do, in words for people.
"""

from collections.abc import Mapping

from msgspec import Struct

from appliance.model import SubtaskRecord, TaskRecord
from appliance.skills.catalogue import SkillManifest
from appliance.tasks.replan.allowed import Against, allowed_robot
from appliance.tasks.replan.robots import Rebinding, Robots, is_the_robots, robot_of
from appliance.tasks.replan.settings import ReplanConfig
from appliance.tasks.replan.skills import Substitution, alternative_skill


class AskDecomposer(Struct, frozen=True, kw_only=True):
    """Nothing simpler helps: the decomposer is to plan anew what is left."""

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
        reasons.append("its plan was handed in with the task and is not planned anew")
    elif not config.decompose:
        reasons.append("tasks.replan.decompose is off")
    elif record.replans >= config.max_replans:
        reasons.append(f"it was planned anew {record.replans} times already (tasks.replan.max_replans)")
    else:
        return AskDecomposer(note="; ".join(reasons))
    return GiveUp(note="; ".join(reasons))
