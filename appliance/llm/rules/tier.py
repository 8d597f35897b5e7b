"""The tier that is always there: pure parsing, no model, no network, milliseconds."""

import asyncio

from appliance.errors import PlanError
from appliance.llm.rules.domains import domain_of
from appliance.llm.rules.mending import mend
from appliance.llm.rules.odds import odds_right
from appliance.llm.rules.parser import Parser, Reading
from appliance.llm.settings import PlanContext
from appliance.llm.tier import Proposal
from appliance.model import Plan, Tier
from appliance.skills.catalogue import Catalogue

MAX_CHARACTERS = 4000
"""Longer text is no plain instruction."""


def read(context: PlanContext, catalogue: Catalogue) -> tuple[Plan, Reading]:
    """Parse an instruction; pure. The plan may be empty or not valid: the caller decides.

    Raises:
        PlanError: the instruction is empty or too long, or asks for too much at once.
    """
    text = context.instruction.strip()
    if not text:
        raise PlanError("the instruction is empty", remedy="say what a robot shall do")
    if len(text) > MAX_CHARACTERS:
        raise PlanError(
            f"the instruction has {len(text)} characters", remedy=f"at most {MAX_CHARACTERS}; give it in parts"
        )
    reading = Parser(catalogue, robots=context.robots, site=context.site).parse(text)
    domain = domain_of(reading.subtasks, catalogue)
    return Plan(domain=domain, subtasks=reading.subtasks, tier=Tier.RULES, confidence=reading.confidence), reading


UNDERSTOOD = 0.97
"""Share of the words that the rules must understand: half an instruction carried out is a wrong one."""
HALF_UNDERSTOOD = 0.05
"""How sure a plan is from which words are missing: of the held-out instructions with 0.8 to 0.97 one in nine was right,
of shorter ones none."""


class RulesTier:
    """Plans by rules."""

    name = Tier.RULES
    repairs = False

    def __init__(self, catalogue: Catalogue) -> None:
        self._catalogue = catalogue

    async def start(self) -> None:
        """Nothing to make ready."""

    async def propose(
        self, context: PlanContext, *, previous: Plan | None = None, problems: tuple[str, ...] = ()
    ) -> Proposal:
        """Parse; PlanError names what was not understood when nothing was."""
        del previous, problems
        if context.so_far is not None:
            plan = mend(context.so_far, self._catalogue, context.robots)
            return Proposal(plan=plan, confidence=plan.confidence)
        # In a thread: a long text takes a quarter of a second, and the loop has leases to keep.
        plan, reading = await asyncio.to_thread(read, context, self._catalogue)
        lost = tuple(f"not understood: {piece!r}" for piece in reading.lost)
        if not plan.subtasks:
            raise PlanError(
                "the instruction was not understood",
                problems=lost,
                remedy='use plain orders, such as "Robot_1: go to goal 2, then photograph the shelf"',
            )
        sure = odds_right(reading.confidence, words=len(context.instruction.split()), subtasks=len(plan.subtasks))
        if reading.confidence < UNDERSTOOD:
            sure = min(sure, HALF_UNDERSTOOD)
        return Proposal(plan=plan, confidence=sure, problems=lost)

    async def close(self) -> None:
        """Nothing to release."""
