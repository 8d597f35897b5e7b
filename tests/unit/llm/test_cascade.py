"""The cascade: order, thresholds, repair, deadlines, broken tiers. Tiers are fakes at the one seam; plans are real."""

import asyncio
import subprocess
import sys
from collections.abc import Callable

import msgspec
import pytest

from appliance.errors import ConfigError, PlanError, RefusedError, UnreachableError
from appliance.llm.cascade import Decomposer, Slot
from appliance.llm.review import ACCOUNTED
from appliance.llm.rules.tier import RulesTier
from appliance.llm.settings import LlmConfig, PlanContext, SafetyConfig
from appliance.llm.tier import Proposal
from appliance.model import Plan, RobotInfo, Site, Subtask, Tier
from appliance.skills.catalogue import Catalogue

pytestmark = pytest.mark.anyio

ASK = PlanContext(instruction="go to dock 1")


def going(place: str = "dock 1", *, robot: str = "any") -> Plan:
    """Return a plan of one goto."""
    return Plan(domain="navigation", subtasks=(Subtask(id="s1", skill="goto", robot=robot, params={"place": place}),))


BAD = Plan(domain="navigation", subtasks=(Subtask(id="s1", skill="dance", robot="any"),))


class FakeTier:
    """A planner that does what the test says: a proposal, an error, or nothing for ever."""

    def __init__(self, name: Tier, *answers: Proposal | Exception | None, repairs: bool = True) -> None:
        self.name = name
        self.repairs = repairs
        self.answers = list(answers)
        self.asked: list[tuple[Plan | None, tuple[str, ...]]] = []
        self.closed = False
        self.fail_start: Exception | None = None
        self.fail_close: Exception | None = None

    async def start(self) -> None:
        """Start, or fail as told."""
        if self.fail_start:
            raise self.fail_start

    async def propose(
        self, context: PlanContext, *, previous: Plan | None = None, problems: tuple[str, ...] = ()
    ) -> Proposal:
        """Give the next answer."""
        del context
        self.asked.append((previous, problems))
        answer = self.answers.pop(0)
        if answer is None:
            await asyncio.Event().wait()
        if isinstance(answer, Exception):
            raise answer
        assert answer is not None
        return answer

    async def close(self) -> None:
        """Close, or fail as told."""
        self.closed = True
        if self.fail_close:
            raise self.fail_close


Build = Callable[..., Decomposer]


@pytest.fixture
def build(catalogue: Catalogue) -> Build:
    """Return a function that makes a cascade of these tiers, each sure from 0.6 on."""

    def make(*tiers: FakeTier, deadline_s: float = 5.0, max_words: int = 50, **config: object) -> Decomposer:
        slots = [
            Slot(
                planner=tier,
                deadline_s=deadline_s,
                max_words=max_words if tier.name is Tier.LOCAL else 50,
                leaves_machine=tier.name is Tier.UPSTREAM,
            )
            for tier in tiers
        ]
        return Decomposer(LlmConfig(**config), catalogue, slots=slots)  # type: ignore[arg-type]

    return make


def accounted(confidence: float) -> float:
    """Return how sure a plan is that accounts for all words."""
    return pytest.approx(ACCOUNTED + (1 - ACCOUNTED) * confidence)  # pyright: ignore[reportReturnType]


def sure(plan: Plan, confidence: float = 0.9) -> Proposal:
    """Return a proposal."""
    return Proposal(plan=plan, confidence=confidence)


async def test_first_tier_that_is_valid_and_sure_wins(build: Build) -> None:
    """The first good plan is taken, stamped with its tier, and nobody else is asked."""
    local, upstream = FakeTier(Tier.LOCAL, sure(going())), FakeTier(Tier.UPSTREAM)
    outcome = await build(local, upstream).plan(ASK)
    assert (outcome.plan.tier, outcome.plan.confidence) == (Tier.LOCAL, accounted(0.9))
    assert [attempt.tier for attempt in outcome.attempts] == ["local"]
    assert upstream.asked == []


async def test_invalid_plan_is_repaired_once_with_the_problems(build: Build) -> None:
    """A model whose plan is not valid is asked once more, with the plan and what is wrong with it."""
    local = FakeTier(Tier.LOCAL, sure(BAD), sure(going()))
    outcome = await build(local).plan(ASK)
    assert outcome.plan.subtasks == going().subtasks
    previous, problems = local.asked[1]
    assert previous == BAD
    assert "there is no such skill" in problems[0]


@pytest.mark.parametrize("last", [True, False])
async def test_more_subtasks_than_a_plan_may_have_is_the_reason_that_is_told(
    build: Build, catalogue: Catalogue, last: bool
) -> None:
    """By the rules' own bound and by a model's plan that is too long: the limit, and to split the task."""
    robots = tuple(RobotInfo(id=f"rover_{number}", kind="zenoh", uses=("base",)) for number in range(50))
    text = "All robots go to dock 1. Then all robots go to dock 2."
    step = going().subtasks[0]
    subtasks = tuple(msgspec.structs.replace(step, id=f"s{number}") for number in range(65))
    model = FakeTier(Tier.LOCAL, sure(msgspec.structs.replace(going(), subtasks=subtasks)), repairs=False)
    broken = FakeTier(Tier.UPSTREAM, UnreachableError("no server", remedy="start it"))
    tiers = (broken, RulesTier(catalogue)) if last else (model, broken)
    with pytest.raises(PlanError, match="64") as refused:
        await build(*tiers).plan(PlanContext(instruction=text, robots=robots))
    assert "split it into tasks of at most 64" in refused.value.remedy


async def test_plan_that_stays_invalid_escalates(build: Build) -> None:
    """After one repair in vain the next tier is asked, and the attempt says what was wrong."""
    local, upstream = FakeTier(Tier.LOCAL, sure(BAD), sure(BAD)), FakeTier(Tier.UPSTREAM, sure(going()))
    outcome = await build(local, upstream).plan(ASK)
    assert outcome.plan.tier is Tier.UPSTREAM
    assert len(local.asked) == 2
    assert not outcome.attempts[0].ok
    assert "no such skill" in outcome.attempts[0].problems[0]


@pytest.mark.parametrize("config", [{"repair": False}, {}])
async def test_no_repair_where_it_cannot_help(build: Build, config: dict[str, bool]) -> None:
    """Without `repair`, or with a tier that does not repair, an invalid plan is not asked for again."""
    tier = FakeTier(Tier.LOCAL, sure(BAD), sure(going()), repairs=not config)
    tier.repairs = bool(config)
    with pytest.raises(PlanError):
        await build(tier, **config).plan(ASK)
    assert len(tier.asked) == 1


async def test_slow_tier_is_abandoned(build: Build) -> None:
    """A tier that gives no answer within its deadline is left for the next one."""
    local, upstream = FakeTier(Tier.LOCAL, None), FakeTier(Tier.UPSTREAM, sure(going()))
    outcome = await build(local, upstream, deadline_s=0.05).plan(ASK)
    assert outcome.plan.tier is Tier.UPSTREAM
    assert "no answer within 0.05 s" in outcome.attempts[0].problems[0]


@pytest.mark.parametrize(
    ("failure", "said"),
    [
        (UnreachableError("server is away", remedy="wait"), "server is away (wait)"),
        (RuntimeError("boom"), "internal error: RuntimeError('boom')"),
        (PlanError("looped", problems=("no end",)), "looped"),
    ],
)
async def test_failing_tier_is_left_for_the_next(build: Build, failure: Exception, said: str) -> None:
    """Whatever a tier raises, the next is asked, and the attempt keeps the reason."""
    outcome = await build(FakeTier(Tier.LOCAL, failure), FakeTier(Tier.RULES, sure(going()))).plan(ASK)
    assert outcome.plan.tier is Tier.RULES
    assert outcome.attempts[0].problems[0] == said


async def test_unsure_plan_is_kept_for_when_nothing_better_comes(build: Build) -> None:
    """A valid plan below the threshold escalates, and is taken in the end if no tier does better."""
    local = FakeTier(Tier.LOCAL, sure(going("dock 1"), 0.1))
    upstream = FakeTier(Tier.UPSTREAM, UnreachableError("away"))
    outcome = await build(local, upstream).plan(ASK)
    assert (outcome.plan.tier, outcome.plan.confidence) == (Tier.LOCAL, accounted(0.1))
    assert [attempt.ok for attempt in outcome.attempts] == [True, False]


@pytest.mark.parametrize(
    ("confidence", "tier", "held"),
    [
        pytest.param(0.04, Tier.LOCAL, True, id="the model's is likelier to be right"),
        pytest.param(0.1, Tier.RULES, True, id="the rules' is likelier, and unsure as well"),
        pytest.param(0.8, Tier.RULES, False, id="the rules' is sure"),
    ],
)
async def test_of_an_unsure_model_and_the_rules_the_likelier_is_taken(
    build: Build, confidence: float, tier: Tier, held: bool
) -> None:
    """All tiers are sure on one scale: the likelier plan is taken, and what is unsure never runs unasked."""
    local = FakeTier(Tier.LOCAL, sure(going("dock 1"), 0.05))
    outcome = await build(local, FakeTier(Tier.RULES, sure(going("dock 1"), confidence))).plan(ASK)
    assert outcome.plan.tier is tier
    assert outcome.plan.provenance is not None
    assert bool(outcome.plan.provenance.confirm) is held


async def test_no_threshold_is_low_enough_for_a_plan_that_a_check_holds(catalogue: Catalogue) -> None:
    """With a threshold of 0 any plan is sure enough but one that a check holds: then the next tier is asked."""
    for place, other, tier, asked, held in (
        ("dock 1", sure(going()), Tier.LOCAL, 0, False),
        ("dock 2", sure(going()), Tier.UPSTREAM, 1, False),
        ("dock 2", UnreachableError("gone"), Tier.LOCAL, 1, True),
    ):
        answer = Proposal(plan=going(place), confidence=0.4)
        local, upstream = FakeTier(Tier.LOCAL, answer), FakeTier(Tier.UPSTREAM, other)
        slots = [Slot(planner=each, deadline_s=60.0) for each in (local, upstream)]
        config = LlmConfig(run_confidence=0.0, show_confidence=0.0, repair=False)
        decomposer = Decomposer(config, catalogue, slots=slots, safety=SafetyConfig(grounded=False))
        outcome = await decomposer.plan(ASK)
        assert (outcome.plan.tier, len(upstream.asked)) == (tier, asked)
        assert outcome.plan.provenance is not None
        assert bool(outcome.plan.provenance.confirm) is held


@pytest.mark.parametrize(
    "instruction", ["stop", "STOP!", "Rover_1: stop", "emergency stop", "alto", "Rover_1 go to dock 1. STOP!"]
)
async def test_a_stop_reaches_no_planner(build: Build, instruction: str) -> None:
    """A text that says to stop is refused with the command, and no tier is asked."""
    local = FakeTier(Tier.LOCAL, sure(going()))
    with pytest.raises(RefusedError, match="this is a stop") as caught:
        await build(local).plan(PlanContext(instruction=instruction))
    assert "swiftbot stop" in caught.value.remedy
    assert local.asked == []


@pytest.mark.parametrize("tier", [Tier.LOCAL, Tier.PEER, Tier.UPSTREAM, Tier.RULES])
async def test_what_the_words_forbid_runs_from_no_tier(build: Build, tier: Tier) -> None:
    """The same review holds for each tier: a plan that does what the words forbid is refused from any of them."""
    with pytest.raises(PlanError, match="forbids this action"):
        await build(FakeTier(tier, sure(going(), 1.0), sure(going(), 1.0))).plan(
            PlanContext(instruction="do not go to dock 1")
        )


async def test_very_unsure_plan_is_not_taken(build: Build) -> None:
    """Below `llm.show_confidence` even a valid plan is refused: the words that it leaves out are named."""
    with pytest.raises(PlanError, match="does not account for"):
        await build(FakeTier(Tier.LOCAL, sure(going(), 0.05))).plan(PlanContext(instruction="go to dock 1 backwards"))


async def test_private_instruction_does_not_leave_the_machine(build: Build) -> None:
    """The upstream tier is not asked for a private instruction, and the attempt says so."""
    upstream = FakeTier(Tier.UPSTREAM)
    outcome = await build(upstream, FakeTier(Tier.RULES, sure(going()))).plan(
        PlanContext(instruction="go to dock 1", private=True)
    )
    assert upstream.asked == []
    assert "private" in outcome.attempts[0].problems[0]


async def test_long_instruction_skips_the_small_model(build: Build) -> None:
    """An instruction beyond what a tier is good at goes to the next one."""
    local, rules = FakeTier(Tier.LOCAL), FakeTier(Tier.UPSTREAM, sure(going()))
    outcome = await build(local, rules, max_words=3).plan(ASK)
    assert local.asked == []
    assert outcome.plan.tier is Tier.UPSTREAM


async def test_confidence_out_of_range_is_held(build: Build) -> None:
    """A confidence above 1 is no more than sure."""
    assert (await build(FakeTier(Tier.LOCAL, sure(going(), 7.0))).plan(ASK)).plan.confidence == 1.0


async def test_calls_at_the_same_time_do_not_mix(build: Build) -> None:
    """Two instructions planned at once each get their own attempts."""
    cascade = build(FakeTier(Tier.LOCAL, sure(going("dock 1")), sure(going("dock"))))
    first, second = await asyncio.gather(cascade.plan(ASK), cascade.plan(ASK))
    assert {first.plan.subtasks[0].params["place"], second.plan.subtasks[0].params["place"]} == {"dock 1", "dock"}
    assert (len(first.attempts), len(second.attempts)) == (1, 1)


async def test_start_and_close_survive_a_bad_tier(build: Build) -> None:
    """A tier that cannot start does not keep the others from starting, nor one that cannot close from closing."""
    bad, good = FakeTier(Tier.LOCAL), FakeTier(Tier.UPSTREAM)
    bad.fail_start = UnreachableError("not there")
    bad.fail_close = RuntimeError("stuck")
    cascade = build(bad, good)
    await cascade.start()
    await cascade.close()
    assert good.closed


async def test_without_models_the_rules_plan_alone(
    catalogue: Catalogue, robots: tuple[RobotInfo, ...], site: Site
) -> None:
    """With no model and no server configured, plain orders are planned by rules against roster and site."""
    assert Decomposer(LlmConfig(), catalogue).tiers == ("local", "rules")
    cascade = Decomposer(LlmConfig(local_model=""), catalogue)
    assert cascade.tiers == ("rules",)
    await cascade.start()
    try:
        outcome = await cascade.plan(
            PlanContext(instruction="Rover_1: go to the shelf and pick the box", robots=robots, site=site)
        )
        assert [each.skill for each in outcome.plan.subtasks] == ["goto", "pick"]
        for text, said in (
            ("Rover_7: go to the shelf", "there is no robot rover_7"),
            ("Rover_1: go to the moon", "there is no place moon"),
            ("Drone_1 take off to 90 m", "limit of 30 m"),
            ("colourless green ideas", "not understood"),
            ("asdf", "not understood"),
            ("If the door is open, go to the shelf", "does not wait for"),
        ):
            with pytest.raises(PlanError, match=said) as caught:
                await cascade.plan(PlanContext(instruction=text, robots=robots, site=site))
            assert caught.value.remedy
            assert caught.value.problems
    finally:
        await cascade.close()


async def test_rules_never_carry_out_half_an_order(catalogue: Catalogue) -> None:
    """A plan by rules below their threshold is refused even when nothing else answers."""
    slot = Slot(planner=RulesTier(catalogue), deadline_s=5)
    with pytest.raises(PlanError, match="not understood"):
        await Decomposer(LlmConfig(), catalogue, slots=[slot]).plan(
            PlanContext(instruction="Go to the shelf. Abracadabra simsalabim hocus pocus.")
        )


@pytest.mark.parametrize(
    "config",
    [
        {"tiers": ("oracle",)},
        {"tiers": ()},
        {"tiers": ("rules", "rules")},
        {"run_confidence": 2.0},
        {"upstream_deadline_s": 0.0},
        {"upstream_retries": 50},
        {"upstream_url": "ftp://x", "upstream_model": "m"},
        {"upstream_url": "http://x"},
        {"upstream_key_file": "/nowhere/key"},
        {"local_max_tokens": 1},
    ],
)
def test_wrong_configuration_is_named(config: dict[str, object], catalogue: Catalogue) -> None:
    """A wrong setting is a ConfigError that names the key and what to write instead."""
    with pytest.raises(ConfigError, match=r"llm") as caught:
        Decomposer(LlmConfig(**config), catalogue)  # type: ignore[arg-type]
    assert caught.value.remedy


def test_importing_the_room_is_cheap() -> None:
    """Neither the model library nor the HTTP client is loaded by importing the planner."""
    code = (
        "import sys, appliance.llm.cascade, appliance.llm.local, appliance.llm.upstream;"
        "print([name for name in ('onnxruntime_genai', 'onnxruntime', 'httpx', 'numpy') if name in sys.modules])"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert found.stdout.strip() == "[]"
