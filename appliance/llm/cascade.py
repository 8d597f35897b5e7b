"""The cascade: asks the tiers in order and takes the first plan that is valid, allowed and sure enough.

Why it exists: a small local model is quick and private but weaker, an upstream one is better but may be slow, away or
not allowed, and rules always answer for plain orders. What was planned before and carried out with success comes first
of all (`plan_cache`). Every plan, that one too, passes the same validator and the safety policy. A model whose plan is
not valid is asked once more with the problems; then, or when it is not sure enough, too slow, or broken, the next tier
is asked. What each made of it goes with the plan (`Provenance`), so that a person sees why it came from where it did.
`Figures` counts what was asked and what came of it, for the status of the gateway.
"""

import asyncio
import contextlib
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

import msgspec
import structlog
from msgspec import Struct, field

from appliance.errors import ConfigError, DeadlineError, PlanError, RefusedError, SwiftbotError
from appliance.llm.analysis import analyse
from appliance.llm.checks.schema import MAX_PROBLEMS, validate
from appliance.llm.completion import completed
from appliance.llm.feedback import Memory
from appliance.llm.plan_cache import catalogue_digest, digest, plan_key
from appliance.llm.preprocessing import explained, no_plan, refused, rule_refused, stop_refused, told, training_refused
from appliance.llm.review import Facts, Review, reasons, review
from appliance.llm.routing import Budget, Gate, Privacy, Thresholds
from appliance.llm.rule_words import rule_words
from appliance.llm.settings import LlmConfig, PlanContext, PlanOutcome, SafetyConfig, so_far
from appliance.llm.stop_words import stop_request
from appliance.llm.tier import Planner, Proposal
from appliance.llm.tiers import Slot, configured
from appliance.llm.training_words import training_request
from appliance.model import (
    Finding,
    Plan,
    PlannerStatus,
    Provenance,
    Severity,
    SlotStatus,
    TaskRecord,
    Tier,
    TierAttempt,
    TierFigures,
    UpstreamStatus,
    plan_hash,
)
from appliance.model.planner_api import Analysis, ProposeAsk, Proposed
from appliance.skills.catalogue import Catalogue

_LATEST = 64


def _latencies() -> deque[float]:
    return deque(maxlen=_LATEST)


class Counted(Struct):
    """Of one tier."""

    asked: int = 0
    failed: int = 0
    ms: deque[float] = field(default_factory=_latencies)


class Figures:
    """Since the start."""

    def __init__(self) -> None:
        self.tiers: dict[str, Counted] = {}
        self.withheld = 0
        """Instructions that were not sent upstream for privacy."""
        self._planned = 0
        self._escalated = 0

    def asked(self, tier: str) -> None:
        """Count a question to a tier."""
        self.tiers.setdefault(tier, Counted()).asked += 1

    def failed(self, tier: str) -> None:
        """Count a tier's answer that was not taken."""
        self.tiers.setdefault(tier, Counted()).failed += 1

    def took(self, tier: str, ms: float) -> None:
        """Note how long a tier took."""
        self.tiers.setdefault(tier, Counted()).ms.append(ms)

    def planned(self, tier: Tier, attempts: Sequence[TierAttempt]) -> None:
        """Count a plan; it was escalated when another tier was asked before."""
        self._planned += 1
        asked = [each.tier for each in attempts if not any(text.startswith("not asked") for text in each.problems)]
        self._escalated += bool(asked) and asked[0] != tier.value

    def status(self, slots: Sequence[Slot], memory: Memory, gate: Gate) -> PlannerStatus:
        """Return it all."""
        told: list[object] = [getattr(slot.planner, "status", None) for slot in slots]
        upstream = next((each for each in told if isinstance(each, UpstreamStatus)), None)
        return PlannerStatus(
            tiers={
                tier: TierFigures(
                    asked=each.asked, failed=each.failed, p50_ms=round(median(each.ms), 3) if each.ms else 0.0
                )
                for tier, each in self.tiers.items()
            },
            slot=next((each for each in told if isinstance(each, SlotStatus)), None),
            cache=memory.cache.figures,
            upstream=None
            if upstream is None
            else UpstreamStatus(
                state=upstream.state,
                retry_after_s=upstream.retry_after_s,
                requests=upstream.requests,
                spent=upstream.spent,
                budget=upstream.budget,
                withheld=self.withheld,
            ),
            waiting=gate.waiting,
            refused=gate.refused,
            planned=self._planned,
            escalated=self._escalated,
            thresholds=memory.thresholds.all,
        )


if TYPE_CHECKING:
    from appliance.model.planner_api import Swapped


log = structlog.get_logger(__name__)

Judge = Callable[[Plan, float, float], tuple[Plan, Review]]
"""Completes a plan by what the site knows, and reviews it; given how sure its planner is, and from when plans run."""


_GUESS = 0.1
"""A plan that is less sure is right one time in fifteen (`llm.show_confidence`)."""


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
        check_model: Callable[[Path], None] = lambda _: None,
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
            check_model: raises IdentityError where a model's folder may not be loaded.
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
        self._check_model = check_model
        given = None if slots is None else tuple(slots)
        self._slots = (
            configured(config, catalogue, peers, self._pay, self._safety, check_model) if given is None else given
        )
        self._privacy = Privacy(
            never=config.upstream_never, robots=config.upstream_never_robots, tag=config.upstream_private_tag
        )
        base = {slot.planner.name.value: config.run_confidence for slot in self._slots}
        thresholds = Thresholds(base, clock=clock)
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
        from appliance.llm.local import swap  # noqa: PLC0415 - a gateway that swaps nothing does not pay for it

        if self._changing.locked():
            raise RefusedError("another model is being loaded already", remedy="wait until that is done")
        async with self._changing:
            self._slots, swapped = await swap(self._slots, folder, self._config, self._catalogue, self._check_model)
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
        return Proposed(plan=said.plan, confidence=said.confidence, model=said.model)

    async def plan(self, context: PlanContext) -> PlanOutcome:
        """Plan an instruction.

        Raises:
            PlanError: no tier gave a valid plan that was sure enough; `problems` says what each lacked.
            RefusedError: too many instructions wait; `retry_after_s` says when to ask again.
        """
        context = self._privacy.marked(context)
        if problem := refused(context.instruction):
            raise problem

        if (stop := stop_request(context.instruction, [each.id for each in context.robots or ()])) is not None:
            raise stop_refused(stop)
        if (training := training_request(context.instruction, [each.id for each in context.robots or ()])) is not None:
            raise training_refused(training)
        if (said := rule_words(context.instruction, context.robots or (), context.site)) is not None and said.rule:
            raise rule_refused(context.instruction)

        words = told(context)

        def judge(plan: Plan, confidence: float, run_from: float) -> tuple[Plan, Review]:
            whole, added = completed(words.restored(plan, verbatim=self._catalogue.verbatim), context, self._catalogue)
            found = self._review(whole, context, confidence=confidence, run_from=run_from, added=added)
            return whole, found

        # The review goes by the words as they were typed, and by the whole roster.
        return await self._turn(context, judge, words.context(context))

    async def replan(
        self,
        record: TaskRecord,
        context: PlanContext,
        *,
        problems: Callable[[Plan], Sequence[str]],
        rest: Callable[[Plan], Plan],
    ) -> PlanOutcome:
        """Make a new plan for what is left of a task in which something failed.

        The tiers get what is done, running, failed and open, and answer with a whole plan; it passes the same
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

        def judge(plan: Plan, confidence: float, run_from: float) -> tuple[Plan, Review]:
            # Its form first: what cannot be a plan cannot be fitted to the record either.
            wrong = validate(plan, self._catalogue)
            if not wrong:
                try:
                    wrong = tuple(problems(plan))
                    part = rest(plan)
                except PlanError as error:
                    wrong = (*wrong, error.message, *error.problems)
                else:
                    found = self._review(part, context, confidence=confidence, run_from=run_from)
                    return plan, msgspec.structs.replace(found, findings=(*map(_refusal, wrong), *found.findings))
            return plan, Review(findings=tuple(map(_refusal, wrong)), confidence=confidence)

        return await self._turn(context, judge)

    def review(self, plan: Plan, context: PlanContext) -> Review:
        """Review a plan that a person or a robot wrote: as any, but the words only give notes."""
        return review(Facts(plan, context, self._catalogue, self._safety, require_implemented=True, edited=True))

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

    async def _turn(self, context: PlanContext, judge: Judge, asked: PlanContext | None = None) -> PlanOutcome:
        """Plan by the cache, else by the tiers, which are asked with `asked`."""
        began = time.monotonic()
        async with self._gate.turn():
            key = plan_key(context, catalogue=self._catalogue_digest, policy=self._policy_digest)
            found = self._cached(key, judge) or await self._cascade(asked or context, judge)
        plan = found.plan
        self._figures.planned(plan.tier, found.attempts)
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
            confirm=found.review.holds,
            findings=found.review.findings,
        )
        plan = msgspec.structs.replace(plan, provenance=provenance)
        return PlanOutcome(plan=plan, attempts=found.attempts)

    def _cached(self, key: str, judge: Judge) -> "_Found | None":
        """Return the plan of the cache, if it still holds."""
        began = time.monotonic()
        kept = self.memory.cache.find(key)
        if kept is None:
            return None
        # It has been carried out with success: how sure its planner was then says nothing now.
        completed_, found = judge(kept.plan, 1.0, 0.0)
        if found.problems:
            log.info("a plan of the cache does not hold any more", problems=found.problems)
            self.memory.forget_plan(key)
            return None
        elapsed = round(1000 * (time.monotonic() - began), 3)
        plan = msgspec.structs.replace(
            completed_, tier=Tier.CACHE, confidence=round(kept.confidence, 4), latency_ms=elapsed
        )
        first = kept.plan.provenance
        return _Found(
            plan=plan,
            review=found,
            attempts=(TierAttempt(tier=Tier.CACHE.value, ok=True, confidence=plan.confidence),),
            model=first.model if first is not None else "",
            gateway=first.gateway if first is not None else "",
            cache=kept.told,
        )

    async def _cascade(self, context: PlanContext, judge: Judge) -> "_Found":
        attempts: list[TierAttempt] = []
        best: _Candidate | None = None
        refusals: list[Finding] = []
        proposed: set[Tier] = set()
        words = len(context.instruction.split())
        for slot in self._slots:
            if not getattr(slot.planner, "present", True) or slot.instead_of in proposed:
                continue
            tier = slot.planner.name.value
            if skipped := self._skip(slot, context, words):
                attempts.append(TierAttempt(tier=tier, ok=False, problems=(skipped,)))
                continue
            candidate, attempt, answered = await self._ask(slot, context, judge, refusals)
            attempts.append(attempt)
            if answered:
                proposed.add(slot.planner.name)
            if candidate is not None:
                candidate = msgspec.structs.replace(candidate, index=len(attempts) - 1)
                if attempt.ok:
                    return candidate.found(attempts)
                if attempt.confidence >= self._config.show_confidence and (best is None or candidate.rank < best.rank):
                    best = candidate
            self._figures.failed(tier)
        if best is not None:
            attempts[best.index] = msgspec.structs.replace(attempts[best.index], ok=True)
            return best.found(attempts)
        # The words themselves first: "every 10 minutes" is the reason, not the place that a planner took it for.
        told = [each for each in refusals if each.check in ("negation", "polarity", "time")]
        named = {each.check for each in told}
        real = [*told, *(each for each in reasons(context, self._catalogue) if each.check not in named), *refusals]
        raise no_plan(attempts, explained(context.instruction), real)

    async def _ask(
        self, slot: Slot, context: PlanContext, judge: Judge, refusals: list[Finding]
    ) -> "tuple[_Candidate | None, TierAttempt, bool]":
        """Ask one tier, with one repair; a candidate that is returned is not refused. Last: whether it proposed any.

        The attempt is `ok` when the plan may be taken at once: no other plan for the same words could do better.
        """
        tier = slot.planner.name.value
        self._figures.asked(tier)
        began = time.monotonic()
        least = max(self._config.run_confidence, self.memory.thresholds.of(tier))
        if slot.leaves_machine:
            context = self._privacy.trimmed(context)

        def attempt(ok: bool, confidence: float, problems: Sequence[str]) -> TierAttempt:
            elapsed = round(1000 * (time.monotonic() - began), 3)
            self._figures.took(tier, elapsed)
            return TierAttempt(
                tier=tier, ok=ok, confidence=confidence, latency_ms=elapsed, problems=tuple(problems[:MAX_PROBLEMS])
            )

        def judged(proposal: Proposal) -> tuple[float, Plan, Review]:
            plan, found = judge(proposal.plan, round(min(1.0, max(0.0, proposal.confidence)), 4), least)
            return found.confidence, plan, found

        try:
            async with _deadline(slot.deadline_s, tier):
                proposal = await slot.planner.propose(context)
                confidence, plan, found = judged(proposal)
                if found.problems and slot.planner.repairs and self._config.repair:
                    log.info("plan is repaired", tier=tier, problems=found.problems)
                    proposal = await slot.planner.propose(context, previous=proposal.plan, problems=found.problems)
                    confidence, plan, found = judged(proposal)
        except PlanError as error:
            if error.oversize:
                refusals.append(
                    Finding(check="size", severity=Severity.REFUSE, message=error.message, hint=error.remedy)
                )
            return None, attempt(ok=False, confidence=0.0, problems=(error.message, *error.problems)), True
        except SwiftbotError as error:
            log.warning("planner tier gave no plan", tier=tier, why=str(error))
            return None, attempt(ok=False, confidence=0.0, problems=(str(error),)), False
        except Exception as error:  # supervision boundary: a broken tier must not keep the next from being asked
            log.exception("planner tier is broken", tier=tier)
            return None, attempt(ok=False, confidence=0.0, problems=(f"internal error: {error!r}"[:300],)), False
        if found.problems:
            refusals += [each for each in found.findings if each.severity is Severity.REFUSE]
            said = attempt(ok=False, confidence=confidence, problems=(*found.problems, *proposal.problems))
            return None, said, True
        candidate = _Candidate(proposal=msgspec.structs.replace(proposal, plan=plan), review=found)
        said = attempt(ok=not found.doubts, confidence=confidence, problems=(*found.holds, *proposal.problems))
        return candidate, said, True

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

    def _review(
        self,
        plan: Plan,
        context: PlanContext,
        *,
        confidence: float,
        run_from: float,
        added: frozenset[str] = frozenset(),
    ) -> Review:
        return review(
            Facts(
                plan,
                context,
                self._catalogue,
                self._safety,
                require_implemented=self._config.require_implemented,
                confidence=confidence,
                run_from=run_from,
                added=added,
            )
        )


class _Candidate(msgspec.Struct, frozen=True, kw_only=True):
    """A plan that is not refused; `index` of its attempt."""

    proposal: Proposal
    review: Review
    index: int = 0

    @property
    def rank(self) -> tuple[bool, int, float]:
        """Order of preference, the best first: what is no mere guess, what fewer checks hold, what is surer."""
        others = sum(each.check != "confidence" for each in self.review.findings if each.severity is Severity.HOLD)
        return self.review.confidence < _GUESS, others, -self.review.confidence

    def found(self, attempts: Sequence[TierAttempt]) -> "_Found":
        attempt = attempts[self.index]
        plan = msgspec.structs.replace(
            self.proposal.plan,
            tier=Tier(attempt.tier),
            confidence=attempt.confidence,
            latency_ms=attempt.latency_ms,
            provenance=None,
        )
        return _Found(
            plan=plan,
            review=self.review,
            attempts=tuple(attempts),
            model=self.proposal.model,
            gateway=self.proposal.gateway,
        )


def _refusal(problem: str) -> Finding:
    return Finding(check="continuation", severity=Severity.REFUSE, message=problem)


class _Found(msgspec.Struct, frozen=True, kw_only=True):
    """A plan, and how it came about."""

    plan: Plan
    review: Review
    attempts: tuple[TierAttempt, ...]
    model: str = ""
    gateway: str = ""
    cache: str = ""


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
