"""What the last resort's plan means for one that a model made before and was not sure enough of. Pure.

The rules and a model have nothing in common but the instruction. Where they say the same it is right nearly always;
where they differ the likelier one counts, and of two that are as likely the model's: when the rules are wrong they are
further from what was meant.
"""

from appliance.llm.tier import Proposal
from appliance.model import Plan

AGREED = 0.9
"""How sure a plan is that two planners made: of 32 such held-out plans 30 were exact."""
FURTHER = 0.75
"""What a probability of the last resort counts beside a model's."""


def after_resort(plan: Plan, confidence: float, resort: Proposal) -> float | None:
    """Return how sure a model's plan is now that the last resort has one too; None where that one is to be taken.

    Args:
        plan: the model's.
        confidence: how sure it was.
        resort: the last resort's; one that does not say how likely it is right is taken.
    """
    if resort.likely is None:
        return None
    if _said(plan) == _said(resort.plan):
        return max(AGREED, confidence)
    return None if FURTHER * resort.likely > confidence else confidence


def _said(plan: Plan) -> list[tuple[object, ...]]:
    return [(each.id, each.skill, each.robot, each.params, sorted(each.after)) for each in plan.subtasks]
