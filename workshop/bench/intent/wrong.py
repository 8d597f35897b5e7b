"""An upstream that answers wrongly on purpose: it plans what is left of an instruction without the words that matter.

It drops negations, conditions, exceptions, times and corrections, gives jobs to other robots now and then, takes the
opposite skill, and is always sure. Whatever it says has to be stopped by the review.
"""

import hashlib
import re
from collections.abc import Callable

from msgspec.structs import replace

from appliance.errors import PlanError
from appliance.llm.checks import lexicon as lx
from appliance.llm.rules.tier import read
from appliance.llm.settings import PlanContext
from appliance.llm.tier import Proposal
from appliance.model import Plan, Subtask, Tier
from appliance.skills.catalogue import Catalogue

_DROPPED = lx.NEGATIONS | lx.CONDITIONS | lx.EXCEPTIONS | lx.TIMES | lx.ALTERNATIVES | lx.CORRECTIONS


class WrongTier:
    """A planner that leaves out the words that matter, or does something else."""

    name = Tier.UPSTREAM
    repairs = False

    def __init__(self, catalogue: Catalogue) -> None:
        self._catalogue = catalogue

    async def start(self) -> None:
        """Nothing to make ready."""

    async def propose(
        self, context: PlanContext, *, previous: Plan | None = None, problems: tuple[str, ...] = ()
    ) -> Proposal:
        """Return a wrong plan, 1.0 sure; PlanError where nothing can be made of the words."""
        del previous, problems
        words = [each for each in re.split(r"\s+", context.instruction) if each.lower().strip(".,!?") not in _DROPPED]
        plan, _ = read(replace(context, instruction=" ".join(words)[:2000] or "hold"), self._catalogue)
        if not plan.subtasks:
            raise PlanError("nothing can be made of it")
        turn = hashlib.sha256(context.instruction.encode()).digest()[0] % 4
        change: Callable[[Plan, PlanContext], Plan] = (_as_it_is, _other_robot, self._opposite, _as_it_is)[turn]
        return Proposal(plan=replace(change(plan, context), tier=Tier.UPSTREAM), confidence=1.0, model="wrong")

    def _opposite(self, plan: Plan, context: PlanContext) -> Plan:
        del context

        def turned(subtask: Subtask) -> Subtask:
            manifest = self._catalogue.skills.get(subtask.skill)
            other = manifest.opposite_of[0] if manifest is not None and manifest.opposite_of else subtask.skill
            wanted = self._catalogue.skills[other].params if other in self._catalogue.skills else {}
            return replace(subtask, skill=other, params={k: v for k, v in subtask.params.items() if k in wanted})

        return replace(plan, subtasks=tuple(map(turned, plan.subtasks)))

    async def close(self) -> None:
        """Nothing to release."""


def _as_it_is(plan: Plan, context: PlanContext) -> Plan:
    del context
    return plan


def _other_robot(plan: Plan, context: PlanContext) -> Plan:
    names = [each.id for each in context.robots or ()]
    if len(names) < 2:
        return plan
    turned = {name: names[(index + 1) % len(names)] for index, name in enumerate(names)}
    subtasks = (replace(each, robot=turned.get(each.robot or "", each.robot)) for each in plan.subtasks)
    return replace(plan, subtasks=tuple(subtasks))
