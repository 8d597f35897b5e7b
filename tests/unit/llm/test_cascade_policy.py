"""The cascade's policy: cache, provenance, thresholds that move, peers, what is private, what waits for an operator."""

import asyncio
from collections.abc import Callable
from typing import Any

import pytest
from msgspec.structs import replace

from appliance.errors import ConfigError, PlanError, RefusedError, UnreachableError
from appliance.llm.cascade import Decomposer, Slot
from appliance.llm.peers import PeerTier, candidates
from appliance.llm.settings import LlmConfig, PlanContext, SafetyConfig
from appliance.llm.tier import Proposal
from appliance.model import (
    GatewayStatus,
    Plan,
    PlannerStatus,
    RobotInfo,
    SlotStatus,
    Subtask,
    SubtaskRecord,
    SubtaskState,
    TaskRecord,
    TaskState,
    Tier,
    plan_hash,
)
from appliance.model.planner_api import ProposeAsk, Proposed
from appliance.skills.catalogue import Catalogue

from .test_cascade import FakeTier, going, sure

pytestmark = pytest.mark.anyio

ASK = PlanContext(instruction="go to dock 1")
Build = Callable[..., Decomposer]


@pytest.fixture
def build(catalogue: Catalogue) -> Build:
    """Return a function that makes a cascade of these tiers, each sure from 0.6 on."""

    def make(*tiers: Any, safety: SafetyConfig | None = None, **config: Any) -> Decomposer:
        slots = [
            Slot(
                planner=tier,
                deadline_s=5.0,
                leaves_machine=tier.name in (Tier.UPSTREAM, Tier.PEER),
                instead_of=Tier.LOCAL if tier.name is Tier.PEER else None,
            )
            for tier in tiers
        ]
        return Decomposer(LlmConfig(**config), catalogue, slots=slots, safety=safety, gateway="gw-1")

    return make


def ended(plan: Plan, *, good: bool = True, task: str = "t-1") -> TaskRecord:
    """Return the end of a task with a plan."""
    state = SubtaskState.SUCCEEDED if good else SubtaskState.FAILED
    subtasks = tuple(SubtaskRecord(subtask=each, state=state) for each in plan.subtasks)
    final = TaskState.SUCCEEDED if good else TaskState.FAILED
    return TaskRecord(id=task, instruction="go to dock 1", state=final, plan=plan, subtasks=subtasks)


async def test_provenance_goes_with_the_plan(build: Build) -> None:
    """Tier, gateway, attempts, hash and latency: all that is needed to see why a plan came from where it did."""
    local = FakeTier(Tier.LOCAL, UnreachableError("away"))
    upstream = FakeTier(Tier.UPSTREAM, replace(sure(going(), 0.8), model="big"))
    plan = (await build(local, upstream).plan(ASK)).plan
    first = plan.provenance
    assert first is not None
    assert (first.tier, first.model, first.gateway, first.confidence) == (Tier.UPSTREAM, "big", "gw-1", 0.91)
    assert [each.tier for each in first.attempts] == ["local", "upstream"]
    assert first.hash == plan_hash(plan)
    assert first.latency_ms > 0
    assert first.key
    assert first.confirm == ()


async def test_what_succeeded_is_not_asked_for_again(build: Build) -> None:
    """After a success the same words, however written, get the same plan from the cache; after a failure not."""
    local = FakeTier(Tier.LOCAL, sure(going(), 0.7), sure(going(), 0.7))
    cascade = build(local)
    plan = (await cascade.plan(ASK)).plan
    assert (await cascade.plan(ASK)).plan.tier is Tier.LOCAL
    assert local.answers == []
    cascade.memory.learn(ended(plan))
    again = (await cascade.plan(PlanContext(instruction="Please go  to Dock 1."))).plan
    assert again.tier is Tier.CACHE
    assert again.subtasks == plan.subtasks
    assert again.confidence > plan.confidence
    assert again.provenance is not None
    assert "carried out with success once" in again.provenance.cache
    cascade.memory.learn(ended(again, good=False, task="t-2"))
    with pytest.raises(PlanError):
        await cascade.plan(ASK)


async def test_another_roster_or_policy_finds_nothing_in_the_cache(build: Build, robots: tuple[RobotInfo, ...]) -> None:
    """A plan for another fleet is no plan for this one, whatever became of it."""
    local = FakeTier(Tier.LOCAL, sure(going()), sure(going("dock 2")), repairs=False)
    cascade = build(local)
    cascade.memory.learn(ended((await cascade.plan(ASK)).plan))
    with pytest.raises(PlanError):
        await cascade.plan(replace(ASK, robots=robots))
    assert len(local.asked) == 2


async def test_a_plan_of_the_cache_is_checked_as_any(build: Build) -> None:
    """What has come into the cache by whatever way is refused and forgotten when it does not hold."""
    local = FakeTier(Tier.LOCAL, sure(going()), sure(going()))
    cascade = build(local)
    plan = (await cascade.plan(ASK)).plan
    assert plan.provenance is not None
    bad = replace(plan, subtasks=(Subtask(id="s1", skill="dance", robot="any"),))
    cascade.memory.cache.succeeded(plan.provenance.key, bad)
    assert (await cascade.plan(ASK)).plan.tier is Tier.LOCAL
    assert cascade.memory.cache.figures.dropped == 1


async def test_thresholds_move_with_what_becomes_of_plans(build: Build) -> None:
    """Plans of a confidence that keep being turned down are not taken any more: the next tier is asked."""
    answers = [sure(going(), 0.65) for _ in range(6)]
    local = FakeTier(Tier.LOCAL, *answers)
    upstream = FakeTier(Tier.UPSTREAM, sure(going(), 0.9))
    cascade = build(local, upstream, cache=0)
    for number in range(3):
        plan = (await cascade.plan(ASK)).plan
        assert plan.tier is Tier.LOCAL
        replanned = replace(ended(plan, task=f"t-{number}"), replans=1, revised=1)
        cascade.memory.learn(replanned)
    assert cascade.status.thresholds["local"] > 0.65
    outcome = await cascade.plan(ASK)
    assert outcome.plan.tier is Tier.UPSTREAM
    assert "run unasked from 0.85" in outcome.attempts[0].problems[0]
    assert cascade.status.escalated == 1


async def test_an_unsure_plan_has_the_reason_why_it_should_wait(build: Build) -> None:
    """Below `llm.run_confidence`, which failures raise for a tier, a plan is shown and does not run."""
    cascade = build(FakeTier(Tier.LOCAL, sure(going(), 0.05)), cache=0)
    plan = (await cascade.plan(ASK)).plan
    assert plan.provenance is not None
    assert plan.provenance.confirm == ("the planner is 0.57 sure, and plans run unasked from 0.60",)
    low = build(FakeTier(Tier.LOCAL, sure(going(), 0.05)), cache=0, run_confidence=0.5)
    plan = (await low.plan(ASK)).plan
    assert plan.provenance is not None
    assert plan.provenance.confirm == ()


async def test_the_policy_holds_for_every_tier_and_for_plans_handed_in(build: Build) -> None:
    """A forbidden place is refused from any planner, and in a plan of somebody's own."""
    safety = SafetyConfig(places_never=("dock 1",))
    cascade = build(FakeTier(Tier.LOCAL, sure(going()), sure(going())), safety=safety)
    with pytest.raises(PlanError, match="places_never"):
        await cascade.plan(ASK)
    assert any("places_never" in each for each in cascade.review(going(), PlanContext(instruction="")).problems)


async def test_an_invention_is_refused(build: Build) -> None:
    """A model's plan that names what was not said is asked for again, then passed over."""
    local = FakeTier(Tier.LOCAL, sure(going("vault")), sure(going("vault")))
    upstream = FakeTier(Tier.UPSTREAM, sure(going()))
    outcome = await build(local, upstream).plan(ASK)
    assert outcome.plan.tier is Tier.UPSTREAM
    assert "is not in the instruction" in outcome.attempts[0].problems[0]
    assert len(local.asked) == 2


@pytest.mark.parametrize(
    ("config", "instruction"),
    [
        ({}, "go to dock 1 #private"),
        ({"upstream_never": ("DOCK",)}, "go to dock 1"),
    ],
)
async def test_what_must_stay_here_stays(build: Build, config: dict[str, Any], instruction: str) -> None:
    """By tag or pattern no other machine is asked, the attempt says why, and it is counted."""
    upstream, peer = FakeTier(Tier.UPSTREAM), FakeTier(Tier.PEER)
    rules = FakeTier(Tier.RULES, sure(going()))
    cascade = build(peer, upstream, rules, **config)
    outcome = await cascade.plan(PlanContext(instruction=instruction))
    assert upstream.asked == peer.asked == []
    assert all("not asked" in each.problems[0] for each in outcome.attempts[:2])
    assert outcome.plan.tier is Tier.RULES


async def test_the_queue_is_bounded(build: Build) -> None:
    """What finds it full is refused at once with a time; what waits is planned; nothing is lost."""
    release = asyncio.Event()

    class Slow(FakeTier):
        async def propose(self, context: PlanContext, **_: Any) -> Proposal:
            del context
            await release.wait()
            return sure(going())

    cascade = build(Slow(Tier.LOCAL), at_once=1, waiting=2, cache=0)
    asking = [asyncio.create_task(cascade.plan(ASK)) for _ in range(3)]
    while cascade.status.waiting < 2:
        await asyncio.sleep(0)
    with pytest.raises(RefusedError) as caught:
        await cascade.plan(ASK)
    assert caught.value.retry_after_s > 0
    release.set()
    assert len(await asyncio.gather(*asking)) == 3
    assert cascade.status.refused == 1
    assert cascade.status.planned == 3


# --- peers ----------------------------------------------------------------------------------------------------------


def having(name: str, *, state: str = "ready", queue: int = 0, load: float = 0.0) -> GatewayStatus:
    """Return the status of a gateway with a model."""
    planner = PlannerStatus(slot=SlotStatus(model="m", state=state, queue=queue))
    return GatewayStatus(id=name, fleet="f", load=load, planner=planner)


def test_who_is_asked_first() -> None:
    """Those whose model is ready, the shortest queue and least load first; never this gateway, nor one that drains."""
    statuses = {
        "a": having("a", queue=2),
        "b": having("b", load=0.5),
        "c": having("c", load=0.1),
        "d": having("d", state="down"),
        "e": replace(having("e"), draining=True),
        "f": GatewayStatus(id="f", fleet="f"),
        "me": having("me"),
    }
    assert candidates(statuses, here="me") == ["c", "b", "a"]


async def test_peers_are_asked_in_turn_and_left_alone_when_they_fail() -> None:
    """The next is asked when one does not answer; one that failed twice is skipped for a while."""
    asked: list[str] = []

    async def ask(gateway: str, question: ProposeAsk, timeout_s: float) -> Proposed:
        asked.append(gateway)
        if gateway == "a":
            raise UnreachableError("gone")
        return Proposed(plan=going(), confidence=0.9, model="m")

    statuses = {"a": having("a"), "b": having("b", load=0.9)}
    tier = PeerTier(LlmConfig(), gateways=lambda: statuses, ask=ask, here="me")
    assert tier.present
    for _ in range(3):
        proposal = await tier.propose(ASK)
        assert (proposal.gateway, proposal.model) == ("b", "m")
    assert asked == ["a", "b", "a", "b", "b"]
    statuses.pop("b")
    with pytest.raises(UnreachableError, match="no other gateway's model answered"):
        await tier.propose(ASK)
    statuses.clear()
    assert not tier.present


async def test_a_peer_is_asked_only_when_the_own_model_said_nothing(build: Build) -> None:
    """An own model that was unsure is as good as the other's; one that is down is not."""
    unsure, down = FakeTier(Tier.LOCAL, sure(going(), 0.2)), FakeTier(Tier.LOCAL, UnreachableError("down"))
    for local, times in ((unsure, 0), (down, 1)):
        peer = FakeTier(Tier.PEER, sure(going()))
        rules = FakeTier(Tier.RULES, sure(going()))
        await build(local, peer, rules).plan(ASK)
        assert len(peer.asked) == times


async def test_what_a_gateway_answers_to_others(build: Build) -> None:
    """The local model's proposal unchecked, the refusal of what is no instruction, or that there is no model."""
    cascade = build(FakeTier(Tier.LOCAL, replace(sure(going(), 0.3), model="m")))
    answer = await cascade.propose(ProposeAsk(instruction="go to dock 1"))
    assert (answer.confidence, answer.model) == (0.3, "m")
    with pytest.raises(PlanError, match="empty"):
        await cascade.propose(ProposeAsk(instruction=" "))
    with pytest.raises(ConfigError, match="gw-1 has no local model"):
        await build(FakeTier(Tier.RULES)).propose(ProposeAsk(instruction="go to dock 1"))
