"""Why an operator should agree to a plan before it runs. Pure."""

from appliance.llm.checks.policy import matched
from appliance.llm.safety.settings import SafetyConfig
from appliance.model import Plan


def reasons_to_confirm(plan: Plan, config: SafetyConfig, *, confidence: float, confirm_below: float) -> tuple[str, ...]:
    """Return why a plan should wait for an operator; none when it need not.

    Args:
        plan: a valid one.
        config: the policy.
        confidence: how sure its tier is.
        confirm_below: the threshold, as experience has moved it.
    """
    found: list[str] = []
    if confidence < confirm_below:
        found.append(f"confidence {confidence:.2f} below confirm threshold {confirm_below:.2f}")
    skills = sorted({each.skill for each in plan.subtasks if matched(each.skill, config.confirm_skills)})
    if skills:
        found.append(f"{', '.join(skills)} has to be agreed to (safety.confirm_skills)")
    return tuple(found)
