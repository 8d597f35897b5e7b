"""The cascade: asks the tiers in order and takes the first plan that is valid and sure enough.

Why it exists: a small local model is quick and private but weaker, an upstream one is better but may be slow, away or
not allowed, and rules always answer for plain orders. Every plan passes the same validator. A model whose plan is not
valid is asked once more with the problems; then, or when it is not sure enough, too slow, or broken, the next tier is
asked. What each made of it is recorded, so that a person sees why a plan came from where it did.

There is no plan cache yet, on purpose: "seen before and succeeded" needs outcomes by instruction shape, which nobody
stores so far; a cache of plans that were never carried out would repeat mistakes at full confidence.
"""

import asyncio
import contextlib
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec
import structlog
from msgspec import Struct

from appliance.errors import DeadlineError, PlanError, SwiftbotError
from appliance.llm.rules.tier import RulesTier
from appliance.llm.settings import LlmConfig, PlanContext, PlanOutcome, TierAttempt
from appliance.llm.so_far import so_far
from appliance.llm.tier import Planner, Proposal
from appliance.llm.validate import MAX_PROBLEMS, validate
from appliance.model import Plan, TaskRecord, Tier
from appliance.skills.catalogue import Catalogue

log = structlog.get_logger(__name__)


class Slot(Struct, frozen=True, kw_only=True):
    """A tier with the cascade's terms for it."""

    planner: Planner
    deadline_s: float
    min_confidence: float
    max_words: int = 100_000
    leaves_machine: bool = False
    fallback: bool = True
    """Whether its valid plan may be taken, below its own threshold, when nothing better came."""


class Decomposer:
    """Turns instructions into validated plans. One per gateway; calls may run at the same time."""

    def __init__(self, config: LlmConfig, catalogue: Catalogue, *, slots: Sequence[Slot] | None = None) -> None:
        """Build the tiers that the configuration names.

        Args:
            config: order, deadlines and thresholds.
            catalogue: the skills there are.
            slots: tiers in place of the configured ones; the seam for tests and measurements.

        Raises:
            ConfigError: the configuration names unknown tiers or values out of range.
        """
        config.check()
        self._config = config
        self._catalogue = catalogue
        self._slots = tuple(slots) if slots is not None else _configured(config, catalogue)
        self.asked: dict[str, int] = {}
        """Tier -> times asked, since start."""
        self.failed: dict[str, int] = {}
        """Tier -> times it gave no acceptable plan."""

    @property
    def tiers(self) -> tuple[str, ...]:
        """The tiers there are, in order of asking."""
        return tuple(slot.planner.name.value for slot in self._slots)

    @property
    def models(self) -> tuple[str, ...]:
        """The tiers with the model of each, in order of asking, for GatewayStatus."""
        named = {"local": Path(self._config.local_model).name, "upstream": self._config.upstream_model}
        return tuple(f"{tier}:{named[tier]}" if named.get(tier) else tier for tier in self.tiers)

    async def start(self) -> None:
        """Make the tiers ready; one that cannot be is named in the log and asked again with each plan."""
        for slot in self._slots:
            try:
                await slot.planner.start()
            except SwiftbotError as error:
                log.warning("planner tier is not ready", tier=slot.planner.name.value, why=str(error))

    async def close(self) -> None:
        """Release all tiers, whatever one of them does."""
        for slot in self._slots:
            try:
                await slot.planner.close()
            except Exception as error:  # noqa: BLE001 - supervision boundary: the others must be closed too
                log.warning("planner tier did not close", tier=slot.planner.name.value, why=repr(error))

    async def plan(self, context: PlanContext) -> PlanOutcome:
        """Plan an instruction.

        Raises:
            PlanError: no tier gave a valid plan that was sure enough; `problems` says what each lacked.
        """
        return await self._cascade(context, lambda plan: self._check(plan, context))

    async def replan(
        self,
        record: TaskRecord,
        context: PlanContext,
        *,
        problems: Callable[[Plan], Sequence[str]],
        rest: Callable[[Plan], Plan],
    ) -> PlanOutcome:
        """Plan anew what is left of a task in which something failed.

        The tiers are told what is done, running, failed and open, and answer with a whole plan; it passes the same
        validator as any, as far as it is not begun yet, and `problems` besides.

        Args:
            record: the task as it stands.
            context: the instruction, the roster and the site of now.
            problems: what is wrong with a plan as the continuation of the task.
            rest: what of a plan is still to be begun; PlanError when there is nothing.

        Raises:
            PlanError: no tier gave a valid plan that was sure enough; `problems` says what each lacked.
        """
        context = msgspec.structs.replace(context, so_far=so_far(record))

        def check(plan: Plan) -> tuple[str, ...]:
            # Its form first: what cannot be a plan cannot be fitted to the record either.
            wrong = validate(plan, self._catalogue)
            if wrong:
                return wrong
            try:
                return (*problems(plan), *self._check(rest(plan), context))
            except PlanError as error:
                return (error.message, *error.problems)

        return await self._cascade(context, check)

    async def _cascade(self, context: PlanContext, check: Callable[[Plan], tuple[str, ...]]) -> PlanOutcome:
        attempts: list[TierAttempt] = []
        best: tuple[Plan, int] | None = None
        words = len(context.instruction.split())
        for slot in self._slots:
            if skipped := _skip(slot, context, words):
                attempts.append(TierAttempt(tier=slot.planner.name.value, ok=False, problems=(skipped,)))
                continue
            proposal, attempt = await self._ask(slot, context, check)
            attempts.append(attempt)
            if attempt.ok and proposal is not None:
                return PlanOutcome(plan=_stamped(proposal, attempt), attempts=tuple(attempts))
            self.failed[attempt.tier] = self.failed.get(attempt.tier, 0) + 1
            # A proposal that comes back is valid: here it was only not sure enough.
            usable = proposal is not None and slot.fallback and attempt.confidence >= self._config.floor_confidence
            if usable and proposal is not None and (best is None or attempt.confidence > best[0].confidence):
                best = (_stamped(proposal, attempt), len(attempts) - 1)
        if best is not None:
            plan, index = best
            attempts[index] = msgspec.structs.replace(attempts[index], ok=True)
            return PlanOutcome(plan=plan, attempts=tuple(attempts))
        raise _refusal(attempts)

    async def _ask(
        self, slot: Slot, context: PlanContext, check: Callable[[Plan], tuple[str, ...]]
    ) -> tuple[Proposal | None, TierAttempt]:
        """Ask one tier, with one repair; a proposal that is returned is valid."""
        tier = slot.planner.name.value
        self.asked[tier] = self.asked.get(tier, 0) + 1
        began = time.monotonic()

        def attempt(ok: bool, confidence: float, problems: Sequence[str]) -> TierAttempt:
            elapsed = round(1000 * (time.monotonic() - began), 3)
            return TierAttempt(
                tier=tier, ok=ok, confidence=confidence, latency_ms=elapsed, problems=tuple(problems[:MAX_PROBLEMS])
            )

        try:
            async with _deadline(slot.deadline_s, tier):
                proposal = await slot.planner.propose(context)
                problems = check(proposal.plan)
                if problems and slot.planner.repairs and self._config.repair:
                    log.info("plan is repaired", tier=tier, problems=problems)
                    proposal = await slot.planner.propose(context, previous=proposal.plan, problems=problems)
                    problems = check(proposal.plan)
        except PlanError as error:
            return None, attempt(ok=False, confidence=0.0, problems=(error.message, *error.problems))
        except SwiftbotError as error:
            log.warning("planner tier gave no plan", tier=tier, why=str(error))
            return None, attempt(ok=False, confidence=0.0, problems=(str(error),))
        except Exception as error:  # supervision boundary: a broken tier must not keep the next from being asked
            log.exception("planner tier is broken", tier=tier)
            return None, attempt(ok=False, confidence=0.0, problems=(f"internal error: {error!r}"[:300],))
        confidence = round(min(1.0, max(0.0, proposal.confidence)), 4)
        if problems:
            return None, attempt(ok=False, confidence=confidence, problems=(*problems, *proposal.problems))
        if confidence < slot.min_confidence:
            why = f"confidence {confidence:.2f} is below {slot.min_confidence:.2f}"
            return proposal, attempt(ok=False, confidence=confidence, problems=(why, *proposal.problems))
        return proposal, attempt(ok=True, confidence=confidence, problems=proposal.problems)

    def _check(self, plan: Plan, context: PlanContext) -> tuple[str, ...]:
        return validate(
            plan,
            self._catalogue,
            robots=context.robots,
            site=context.site,
            require_implemented=self._config.require_implemented,
        )


def _configured(config: LlmConfig, catalogue: Catalogue) -> tuple[Slot, ...]:
    slots: list[Slot] = []
    for name in config.tiers:
        if name == Tier.LOCAL and config.local_model:
            from appliance.llm.local import LocalTier  # noqa: PLC0415 - a gateway without model must not pay for it

            slots.append(
                Slot(
                    planner=LocalTier(config, catalogue),
                    deadline_s=config.local_deadline_s,
                    min_confidence=config.local_min_confidence,
                    max_words=config.local_max_words,
                )
            )
        elif name == Tier.UPSTREAM and config.upstream_url:
            from appliance.llm.upstream import UpstreamTier  # noqa: PLC0415 - as above

            slots.append(
                Slot(
                    planner=UpstreamTier(config, catalogue),
                    deadline_s=config.upstream_deadline_s,
                    min_confidence=config.upstream_min_confidence,
                    leaves_machine=True,
                )
            )
        elif name == Tier.RULES:
            slots.append(
                Slot(
                    planner=RulesTier(catalogue),
                    deadline_s=config.rules_deadline_s,
                    min_confidence=config.rules_min_confidence,
                    # Below its threshold words were not understood: carrying out the rest would be inventing.
                    fallback=False,
                )
            )
    return tuple(slots)


def _skip(slot: Slot, context: PlanContext, words: int) -> str:
    if slot.leaves_machine and context.private:
        return "not asked: the instruction is private"
    if words > slot.max_words:
        return f"not asked: {words} words are more than the {slot.max_words} it is good at"
    return ""


def _stamped(proposal: Proposal, attempt: TierAttempt) -> Plan:
    return msgspec.structs.replace(
        proposal.plan, tier=Tier(attempt.tier), confidence=attempt.confidence, latency_ms=attempt.latency_ms
    )


def _refusal(attempts: Sequence[TierAttempt]) -> PlanError:
    if not attempts:
        return PlanError("no planner is configured", remedy='set llm.tiers; "rules" needs nothing else')
    problems = [f"{each.tier}: {problem}" for each in attempts for problem in each.problems]
    # The last tier asked is the one of last resort: its problems are the most telling.
    last = attempts[-1].problems or ("no plan",)
    return PlanError(
        f"no valid plan for the instruction: {'; '.join(last[:3])}",
        remedy='mend that, or use plain orders such as "Robot_1: go to goal 2, then photograph the shelf"',
        problems=tuple(problems[:MAX_PROBLEMS]),
    )


@contextlib.asynccontextmanager
async def _deadline(seconds: float, tier: str):
    """Abandon a tier that does not answer in time."""
    try:
        async with asyncio.timeout(seconds):
            yield
    except TimeoutError as error:
        raise DeadlineError(
            f"tier {tier} gave no answer within {seconds:g} s", remedy="see its deadline in [llm]"
        ) from error
