"""The contract of a tier: what the cascade asks of every planner, model or not.

Guarantees a tier gives: `propose` never changes anything outside itself; it may be cancelled at any await and be
asked again afterwards; what it returns is a proposal, not yet validated. Failures are `SwiftbotError`s that name
cause and remedy (`PrerequisiteError`: cannot work here; `UnreachableError`, `DeadlineError`: not now; `PlanError`:
understood too little). The cascade survives any other exception too, but counts it as a defect.
"""

from typing import Protocol

from msgspec import Struct

from appliance.llm.settings import PlanContext
from appliance.model import Plan, Tier


class Proposal(Struct, frozen=True, kw_only=True):
    """A plan as a tier proposes it. `problems` are its own reservations, for people.

    `confidence` is the probability, 0 to 1, that the plan is right: one scale for all tiers.
    """

    plan: Plan
    confidence: float
    problems: tuple[str, ...] = ()
    model: str = ""
    """The model that wrote it; empty for rules."""
    gateway: str = ""
    """The gateway that has that model, if it is another one."""


class Planner(Protocol):
    """A tier of the cascade."""

    name: Tier

    @property
    def repairs(self) -> bool:
        """Whether asking again with the validator's problems can help (models: yes, rules: no)."""
        ...

    async def start(self) -> None:
        """Make ready; a tier that cannot be ready yet starts in the background and says so when asked."""
        ...

    async def propose(
        self, context: PlanContext, *, previous: Plan | None = None, problems: tuple[str, ...] = ()
    ) -> Proposal:
        """Plan an instruction; with `previous` and `problems`, mend that plan."""
        ...

    async def close(self) -> None:
        """Release everything."""
        ...
