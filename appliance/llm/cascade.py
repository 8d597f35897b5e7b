"""The cascade: asks the tiers in order and takes the first plan that is valid, allowed and sure enough.

Why it exists: a small local model is quick and private but weaker, an upstream one is better but may be slow, away or
not allowed, and rules always answer for plain orders. What was planned before and carried out with success comes first
of all (`routing.cache`). Every plan, that one too, passes the same validator and the safety policy. A model whose plan
is not valid is asked once more with the problems; then, or when it is not sure enough, too slow, or broken, the next
tier is asked. What each made of it goes with the plan (`Provenance`), so that a person sees why it came from where it
did.
"""

import asyncio
import contextlib
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import msgspec
import structlog

from appliance.errors import ConfigError, DeadlineError, PlanError, RefusedError, SwiftbotError
from appliance.llm.analysis import Analysis, analyse
from appliance.llm.experience.memory import Memory
from appliance.llm.figures import Figures
from appliance.llm.intake import explained, no_plan, refused
from appliance.llm.peers import ProposeAsk, Proposed
from appliance.llm.routing.agreement import after_resort
from appliance.llm.routing.budget import Budget
from appliance.llm.routing.canonical import catalogue_digest, digest, plan_key
from appliance.llm.routing.gate import Gate
from appliance.llm.routing.privacy import Privacy
from appliance.llm.routing.thresholds import Thresholds
from appliance.llm.checks.policy import unsafe
from appliance.llm.safety.confirming import reasons_to_confirm
from appliance.llm.checks.grounding import ungrounded
from appliance.llm.safety.settings import SafetyConfig
from appliance.llm.settings import LlmConfig, PlanContext, PlanOutcome, TierAttempt
from appliance.llm.so_far import so_far
from appliance.llm.tier import Planner, Proposal
from appliance.llm.tiers import Slot, configured
from appliance.llm.checks.schema import MAX_PROBLEMS, validate
from appliance.model import Plan, PlannerStatus, Provenance, TaskRecord, Tier, plan_hash
from appliance.skills.catalogue import Catalogue

if TYPE_CHECKING:
    from appliance.llm.api import Swapped

__all__ = ["Decomposer", "Slot"]

log = structlog.get_logger(__name__)

Check = Callable[[Plan, bool], tuple[str, ...]]
"""What is wrong with a plan; the second argument: whether it is held to the words of the instruction."""


class Decomposer:
    """Turns instructions into validated plans. One per gateway; calls may run at the same time."""

    def __init__(
        self,
        config: LlmConfig,
        catalogue: Catalogue,
        *,
        safety: SafetyConfig | None = None,
        gateway: str = "",
        peers: Planner | None = None,
        slots: Sequence[Slot] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Build the tiers that the configuration names.

        Args:
            config: order, deadlines and thresholds.
            catalogue: the skills there are.
            safety: the policy that every plan is held to; by default one that forbids nothing.
            gateway: this one, for the plans' provenance.
            peers: the tier that asks other gateways.
            slots: tiers in place of the configured ones; the seam for tests and measurements.
            clock: seconds, for what is remembered.

        Raises:
            ConfigError: the configuration names unknown tiers or values out of range.
        """
        config.check()
        self._config = config
        self._catalogue = catalogue
        self._safety = safety or SafetyConfig()
        self._safety.check()
        self._gateway = gateway
        self._budget = Budget(
            cost=config.upstream_budget,
            requests=config.upstream_requests,
            price_in=config.upstream_price_in,
            price_out=config.upstream_price_out,
        )
        given = None if slots is None else tuple(slots)
        self._slots = configured(config, catalogue, peers, self._pay) if given is None else given
        self._privacy = Privacy(
            never=config.upstream_never, robots=config.upstream_never_robots, tag=config.upstream_private_tag
        )
        base = {slot.planner.name.value: slot.min_confidence for slot in self._slots}
        thresholds = Thresholds(base, confirm_below=self._safety.confirm_below, clock=clock)
        self.memory = Memory(thresholds=thresholds, budget=self._budget, most_plans=config.cache, clock=clock)
        """What became of earlier plans, and what follows for the next."""
        self._gate = Gate(at_once=config.at_once, waiting=config.waiting)
        self._figures = Figures()
        self._catalogue_digest = catalogue_digest(catalogue)
        self._policy_digest = digest(self._safety, config.require_implemented)
        self._changing = asyncio.Lock()

    @property
    def asked(self) -> dict[str, int]:
        """Tier -> times asked, since start."""
        return {tier: each.asked for tier, each in self._figures.tiers.items()}

    @property
    def failed(self) -> dict[str, int]:
        """Tier -> times it gave no acceptable plan."""
        return {tier: each.failed for tier, each in self._figures.tiers.items() if each.failed}

    @property
    def tiers(self) -> tuple[str, ...]:
        """The tiers there are, in order of asking."""
        return tuple(slot.planner.name.value for slot in self._slots)

    @property
    def models(self) -> tuple[str, ...]:
        """The tiers with the model of each, in order of asking, for GatewayStatus; not those of other gateways."""
        own = [slot.planner for slot in self._slots if slot.planner.name is not Tier.PEER]
        named = [(each.name.value, str(getattr(each, "model", ""))) for each in own]
        return tuple(f"{tier}:{model}" if model else tier for tier, model in named)

    @property
    def status(self) -> PlannerStatus:
        """How the planner does, for GatewayStatus."""
        return self._figures.status(self._slots, self.memory, self._gate)

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
        await self.memory.close()

    async def swap(self, folder: str) -> "Swapped":
        """Have the local tier use another model, without a moment in which there is none.

        Args:
            folder: of an onnxruntime-genai model.

        Raises:
            PrerequisiteError, UnreachableError, DeadlineError, PlanError: it cannot be loaded, or fails its self-test;
                the model before goes on.
            RefusedError: another swap is under way.
        """
        from appliance.llm.swapping import swap  # noqa: PLC0415 - a gateway that swaps nothing does not pay for it

        if self._changing.locked():
            raise RefusedError("another model is being loaded already", remedy="wait until that is done")
        async with self._changing:
            self._slots, swapped = await swap(self._slots, folder, self._config, self._catalogue)
        return swapped

    async def propose(self, ask: ProposeAsk) -> Proposed:
        """Answer another gateway: what the local model makes of an instruction, unchecked.

        Raises:
            UnreachableError: there is no local model, or it does not answer.
            RefusedError: too many wait.
        """
        if problem := refused(ask.instruction):
            raise problem
        slot = next((each for each in self._slots if each.planner.name is Tier.LOCAL), None)
        if slot is None:
            raise ConfigError(f"{self._gateway} has no local model", remedy="see `swiftbot fleet` for who has one")
        context = PlanContext(instruction=ask.instruction, robots=ask.robots)
        async with self._gate.turn(), _deadline(slot.deadline_s, "local"):
            said = await slot.planner.propose(context)
        return Proposed(plan=said.plan, confidence=said.confidence, doubtful=said.doubtful, model=said.model)

    async def plan(self, context: PlanContext) -> PlanOutcome:
        """Plan an instruction.

        Raises:
            PlanError: no tier gave a valid plan that was sure enough; `problems` says what each lacked.
            RefusedError: too many instructions wait; `retry_after_s` says when to ask again.
        """
        context = self._privacy.marked(context)
        if problem := refused(context.instruction):
            raise problem

        def check(plan: Plan, grounded: bool) -> tuple[str, ...]:
            return self._check(plan, context, grounded=grounded)

        return await self._turn(context, check)

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
        checks as any, as far as it is not begun yet, and `problems` besides.

        Args:
            record: the task as it stands.
            context: the instruction, the roster and the site of now.
            problems: what is wrong with a plan as the continuation of the task.
            rest: what of a plan is still to be begun; PlanError when there is nothing.

        Raises:
            PlanError: no tier gave a valid plan that was sure enough; `problems` says what each lacked.
            RefusedError: too many instructions wait.
        """
        context = self._privacy.marked(msgspec.structs.replace(context, so_far=so_far(record)))

        def check(plan: Plan, grounded: bool) -> tuple[str, ...]:
            # Its form first: what cannot be a plan cannot be fitted to the record either.
            wrong = validate(plan, self._catalogue)
            if wrong:
                return wrong
            try:
                return (*problems(plan), *self._check(rest(plan), context, grounded=grounded))
            except PlanError as error:
                return (error.message, *error.problems)

        return await self._turn(context, check)

    def check(self, plan: Plan, context: PlanContext) -> tuple[str, ...]:
        """Return what is wrong with a plan that somebody hands in: as of any plan, but its words are its author's."""
        return self._check(plan, context, grounded=False, require_implemented=True)

    def confirm(self, plan: Plan) -> tuple[str, ...]:
        """Return why an operator should agree to a plan that a robot hands in: its author's confidence says nothing."""
        return reasons_to_confirm(plan, self._safety, confidence=1.0, confirm_below=0.0)

    def analyse(self, context: PlanContext, plan: Plan) -> Analysis:
        """Return what an instruction asks for, with its plan and by what is known of the skills and robots."""
        known = self.memory.experience
        return analyse(
            context.instruction,
            plan,
            self._catalogue,
            context.robots,
            expected_s=known.expected_s,
            peak_mb=known.peak_mb,
            reliability=known.reliability,
            shuns=known.shuns,
        )

    # --- the way through the tiers ------------------------------------------------------------------------------

    async def _turn(self, context: PlanContext, check: Check) -> PlanOutcome:
        began = time.monotonic()
        async with self._gate.turn():
            key = plan_key(context, catalogue=self._catalogue_digest, policy=self._policy_digest)
            found = self._cached(key, check) or await self._cascade(context, check)
        plan = found.plan
        self._figures.planned(plan.tier, found.attempts)
        thresholds = self.memory.thresholds
        provenance = Provenance(
            tier=plan.tier,
            model=found.model,
            gateway=found.gateway or self._gateway,
            confidence=plan.confidence,
            latency_ms=round(1000 * (time.monotonic() - began), 3),
            attempts=found.attempts,
            hash=plan_hash(plan),
            key=key,
            cache=found.cache,
            confirm=reasons_to_confirm(
                plan, self._safety, confidence=plan.confidence, confirm_below=thresholds.confirm_below
            ),
        )
        plan = msgspec.structs.replace(plan, provenance=provenance)
        return PlanOutcome(plan=plan, attempts=found.attempts)

    def _cached(self, key: str, check: Check) -> "_Found | None":
        """Return the plan of the cache, if it still holds."""
        began = time.monotonic()
        kept = self.memory.cache.find(key)
        if kept is None:
            return None
        if problems := check(kept.plan, False):
            log.info("a plan of the cache does not hold any more", problems=problems)
            self.memory.forget_plan(key)
            return None
        elapsed = round(1000 * (time.monotonic() - began), 3)
        plan = msgspec.structs.replace(
            kept.plan, tier=Tier.CACHE, confidence=round(kept.confidence, 4), latency_ms=elapsed
        )
        first = kept.plan.provenance
        return _Found(
            plan=plan,
            attempts=(TierAttempt(tier=Tier.CACHE.value, ok=True, confidence=plan.confidence),),
            model=first.model if first is not None else "",
            gateway=first.gateway if first is not None else "",
            cache=kept.told,
        )

    async def _cascade(self, context: PlanContext, check: Check) -> "_Found":
        attempts: list[TierAttempt] = []
        best: tuple[Proposal, int] | None = None
        proposed: set[Tier] = set()
        words = len(context.instruction.split())
        for slot in self._slots:
            if not getattr(slot.planner, "present", True) or slot.instead_of in proposed:
                continue
            tier = slot.planner.name.value
            if skipped := self._skip(slot, context, words):
                attempts.append(TierAttempt(tier=tier, ok=False, problems=(skipped,)))
                continue
            proposal, attempt, answered = await self._ask(slot, context, check)
            attempts.append(attempt)
            if answered:
                proposed.add(slot.planner.name)
            if attempt.ok and proposal is not None:
                sure = None if best is None else after_resort(best[0].plan, attempts[best[1]].confidence, proposal)
                if best is None or sure is None:
                    return _stamped(proposal, attempts, len(attempts) - 1)
                attempts[best[1]] = msgspec.structs.replace(attempts[best[1]], confidence=sure)
                why = f"the plan of {attempts[best[1]].tier} is taken: {sure:.2f} sure with this one beside it"
                attempts[-1] = msgspec.structs.replace(attempt, ok=False, problems=(why, *attempt.problems))
                continue
            self._figures.failed(tier)
            # A proposal that comes back is valid: here it was only not sure enough.
            usable = proposal is not None and slot.fallback and attempt.confidence >= self._config.floor_confidence
            if usable and proposal and (best is None or attempt.confidence > attempts[best[1]].confidence):
                best = (proposal, len(attempts) - 1)
        if best is not None:
            proposal, index = best
            attempts[index] = msgspec.structs.replace(attempts[index], ok=True)
            return _stamped(proposal, attempts, index)
        raise no_plan(attempts, explained(context.instruction))

    async def _ask(self, slot: Slot, context: PlanContext, check: Check) -> tuple[Proposal | None, TierAttempt, bool]:
        """Ask one tier, with one repair; a proposal that is returned is valid. Last: whether it proposed anything."""
        tier = slot.planner.name.value
        self._figures.asked(tier)
        began = time.monotonic()
        if slot.leaves_machine:
            context = self._privacy.trimmed(context)

        def attempt(ok: bool, confidence: float, problems: Sequence[str]) -> TierAttempt:
            elapsed = round(1000 * (time.monotonic() - began), 3)
            self._figures.took(tier, elapsed)
            return TierAttempt(
                tier=tier, ok=ok, confidence=confidence, latency_ms=elapsed, problems=tuple(problems[:MAX_PROBLEMS])
            )

        try:
            async with _deadline(slot.deadline_s, tier):
                proposal = await slot.planner.propose(context)
                problems = check(proposal.plan, slot.grounded)
                if problems and slot.planner.repairs and self._config.repair:
                    log.info("plan is repaired", tier=tier, problems=problems)
                    proposal = await slot.planner.propose(context, previous=proposal.plan, problems=problems)
                    problems = check(proposal.plan, slot.grounded)
        except PlanError as error:
            return None, attempt(ok=False, confidence=0.0, problems=(error.message, *error.problems)), True
        except SwiftbotError as error:
            log.warning("planner tier gave no plan", tier=tier, why=str(error))
            return None, attempt(ok=False, confidence=0.0, problems=(str(error),)), False
        except Exception as error:  # supervision boundary: a broken tier must not keep the next from being asked
            log.exception("planner tier is broken", tier=tier)
            return None, attempt(ok=False, confidence=0.0, problems=(f"internal error: {error!r}"[:300],)), False
        confidence = round(min(1.0, max(0.0, proposal.confidence)), 4)
        if problems:
            return None, attempt(ok=False, confidence=confidence, problems=(*problems, *proposal.problems)), True
        least = max(slot.min_confidence, self.memory.thresholds.of(tier))
        lacks: tuple[str, ...] = ()
        if confidence < least:
            lacks = (f"confidence {confidence:.2f} is below {least:.2f}",)
        elif proposal.doubtful and not slot.takes_doubtful:
            lacks = ("it breaks a rule of plans, of which no confidence is enough",)
        return proposal, attempt(ok=not lacks, confidence=confidence, problems=(*lacks, *proposal.problems)), True

    def _paid(self) -> None:
        self.memory.spent()

    def _pay(self) -> tuple[Budget, Callable[[], None]]:
        """What upstream may cost, and whom to tell that it did."""
        return self._budget, self._paid

    def _skip(self, slot: Slot, context: PlanContext, words: int) -> str:
        if slot.leaves_machine and (why := self._privacy.withholds(context)):
            self._figures.withheld += slot.planner.name is Tier.UPSTREAM
            return f"not asked: {why}"
        if words > slot.max_words:
            return f"not asked: {words} words are more than the {slot.max_words} it is good at"
        return ""

    def _check(
        self, plan: Plan, context: PlanContext, *, grounded: bool, require_implemented: bool | None = None
    ) -> tuple[str, ...]:
        require = self._config.require_implemented if require_implemented is None else require_implemented
        wrong = validate(plan, self._catalogue, robots=context.robots, site=context.site, require_implemented=require)
        if wrong:
            return wrong
        wrong = unsafe(plan, context, self._catalogue, self._safety)
        return wrong or (ungrounded(plan, context) if grounded and self._safety.grounded else ())


class _Found(msgspec.Struct, frozen=True, kw_only=True):
    """A plan, and how it came about."""

    plan: Plan
    attempts: tuple[TierAttempt, ...]
    model: str = ""
    gateway: str = ""
    cache: str = ""


def _stamped(proposal: Proposal, attempts: Sequence[TierAttempt], index: int) -> _Found:
    attempt = attempts[index]
    plan = msgspec.structs.replace(
        proposal.plan,
        tier=Tier(attempt.tier),
        confidence=attempt.confidence,
        latency_ms=attempt.latency_ms,
        provenance=None,
    )
    return _Found(plan=plan, attempts=tuple(attempts), model=proposal.model, gateway=proposal.gateway)


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
