"""Whether a revision may be: what of a revised plan is still to be done, and by whom; the robots that may take over.

Pure. A plan that was allowed may not be any more with another robot or another skill in it.
"""

from collections.abc import Callable, Mapping, Sequence

from msgspec.structs import replace

from appliance.model import Plan, Subtask, SubtaskRecord, SubtaskState, TaskRecord
from appliance.skills.catalogue import SkillManifest
from appliance.tasks.replan.robots import Rebinding, Robots, another_robot, robot_of
from appliance.tasks.replan.settings import ReplanConfig
from appliance.tasks.revising import ACTIVE

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
