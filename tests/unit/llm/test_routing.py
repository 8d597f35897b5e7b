"""Cache, breaker, budget, privacy, thresholds: each decides by what it was told and the time that it is given."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.errors import ConfigError
from appliance.llm.plan_cache import PlanCache
from appliance.llm.routing import OUTCOME_HALF_LIFE_S, Breaker, Budget, Privacy, Spent, Thresholds
from appliance.llm.settings import PlanContext
from appliance.model import Plan, Provenance, RobotInfo, Subtask, Tier

PLAN = Plan(
    domain="navigation",
    subtasks=(Subtask(id="s1", skill="goto", robot="any", params={"place": "dock 1"}),),
    provenance=Provenance(tier=Tier.UPSTREAM, model="big", confidence=0.7),
)


class Clock:
    """A clock that is set by hand."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        """Return the time."""
        return self.now


# --- cache ----------------------------------------------------------------------------------------------------------


def test_only_success_brings_a_plan_in_and_failure_takes_it_out() -> None:
    """A plan is found after a task with it has succeeded, surer with each, and gone for good after a failure."""
    cache = PlanCache()
    assert cache.find("k") is None
    cache.succeeded("k", PLAN)
    first = cache.find("k")
    assert first is not None
    cache.succeeded("k", PLAN)
    again = cache.find("k")
    assert again is not None
    assert 0.7 < first.confidence < again.confidence < 1
    assert "planned by upstream (big)" in again.told
    assert "2 times" in again.told
    assert cache.failed("k")
    assert cache.find("k") is None
    assert (cache.figures.hits, cache.figures.misses, cache.figures.dropped) == (2, 2, 1)


def test_a_different_plan_for_the_same_key_begins_anew() -> None:
    """What another plan has earned does not count for this one."""
    cache = PlanCache()
    for _ in range(5):
        cache.succeeded("k", PLAN)
    other = replace(PLAN, subtasks=(replace(PLAN.subtasks[0], params={"place": "dock 2"}),))
    kept = cache.succeeded("k", other)
    assert kept is not None
    assert kept.good == 1


def test_the_cache_is_bounded_and_may_be_off() -> None:
    """The plan used longest ago goes first; with no room nothing is kept; no key, no plan."""
    cache = PlanCache(2)
    for key in ("a", "b"):
        cache.succeeded(key, PLAN)
    cache.find("a")
    cache.succeeded("c", PLAN)
    assert cache.surplus() == ["b"]
    assert cache.figures.entries == 2
    assert PlanCache(0).succeeded("a", PLAN) is None
    assert cache.succeeded("", PLAN) is None
    assert cache.find("") is None


# --- breaker --------------------------------------------------------------------------------------------------------


def test_the_breaker_opens_tries_one_and_closes() -> None:
    """Three failures in a row open it; after a while one question is let through, and its answer decides."""
    breaker = Breaker(failures=3, open_s=10, most_s=60)
    for at in range(3):
        assert breaker.take(at)
        breaker.failed(at)
    assert breaker.state(2) == "open"
    assert not breaker.take(5)
    assert breaker.retry_after_s(2) == 10.0
    assert breaker.take(13)
    assert not breaker.take(13)
    breaker.failed(13)
    assert breaker.state(30) == "open"
    assert breaker.take(34)
    breaker.succeeded()
    assert breaker.state(34) == "closed"


def test_one_success_between_failures_keeps_it_closed() -> None:
    """Only failures in a row count, and one that nobody waited for says nothing."""
    breaker = Breaker(failures=2)
    for at in range(20):
        breaker.failed(at)
        breaker.succeeded()
        breaker.gave_up()
    assert breaker.take(20)


@given(st.lists(st.sampled_from(["fail", "ok", "gave up", "wait"]), max_size=60))
def test_the_breaker_never_stays_open_for_good(events: list[str]) -> None:
    """Whatever happened, after the longest wait it may be tried again."""
    breaker, now = Breaker(failures=3, open_s=1, most_s=30), 0.0
    for event in events:
        if event == "wait":
            now += 3
        elif breaker.take(now):
            {"fail": lambda: breaker.failed(now), "ok": breaker.succeeded, "gave up": breaker.gave_up}[event]()  # noqa: B023
    assert breaker.take(now + 31)


# --- budget ---------------------------------------------------------------------------------------------------------


def test_the_budget_counts_by_day() -> None:
    """Requests and money are bounded a day, by prices; the next day begins again, and a restart forgets nothing."""
    budget = Budget(cost=1.0, requests=3, price_in=100_000, price_out=500_000)
    assert not budget.refuses("mon")
    budget.spend("mon", tokens_in=5, tokens_out=1)
    assert budget.on("mon").cost == 1.0
    assert "1.00 spent today of 1.00" in budget.refuses("mon")
    assert not budget.refuses("tue")
    for _ in range(3):
        budget.spend("tue")
    assert "no more than 3" in budget.refuses("tue")
    other = Budget(cost=0, requests=3, price_in=0, price_out=0)
    other.load(Spent(day="tue", requests=3))
    assert other.refuses("tue")
    assert not other.refuses("wed")


# --- privacy --------------------------------------------------------------------------------------------------------


def test_what_is_private_stays_here() -> None:
    """By tag, by pattern and by the robots named; the tag is taken out, other words are left."""
    privacy = Privacy(never=("patient|ward", r"\bvault\b"), robots=("nurse_*",), tag="#private")
    marked = privacy.marked(PlanContext(instruction="go to dock 1 #Private please"))
    assert (marked.instruction, marked.private) == ("go to dock 1 please", True)
    assert privacy.withholds(marked) == "the instruction is private"
    assert "upstream_never" in privacy.withholds(PlanContext(instruction="photograph the PATIENT"))
    roster = (RobotInfo(id="nurse_1", kind="zenoh"), RobotInfo(id="rover_1", kind="zenoh"))
    named = PlanContext(instruction="Nurse 1: go home", robots=roster)
    assert "names nurse_1" in privacy.withholds(named)
    plain = PlanContext(instruction="rover_1: go to #privateer's dock", robots=roster)
    assert privacy.marked(plain) == plain
    assert privacy.withholds(plain) == ""
    assert [each.id for each in privacy.trimmed(plain).robots or ()] == ["rover_1"]


def test_a_pattern_that_is_none_is_named() -> None:
    """A wrong expression is a ConfigError."""
    with pytest.raises(ConfigError, match="upstream_never"):
        Privacy(never=("(",), robots=(), tag="")


# --- thresholds -----------------------------------------------------------------------------------------------------


def test_a_threshold_rises_over_plans_that_fail_and_comes_back() -> None:
    """Plans that were sure enough and failed raise it above them; good ones and time bring it back, never below."""
    clock = Clock()
    thresholds = Thresholds({"local": 0.6, "rules": 0.8}, clock=clock)
    assert thresholds.of("local") == 0.6
    for _ in range(4):
        thresholds.add("local", 0.68, good=False)
    assert 0.68 < thresholds.of("local") < 0.8
    assert thresholds.of("rules") == 0.8
    for _ in range(30):
        thresholds.add("local", 0.7, good=True)
    assert thresholds.of("local") == 0.6
    clock.now += 20 * OUTCOME_HALF_LIFE_S
    assert thresholds.all == {"local": 0.6, "rules": 0.8}


def test_one_failure_is_chance() -> None:
    """Too few outcomes conclude nothing."""
    thresholds = Thresholds({"local": 0.6}, clock=Clock())
    thresholds.add("local", 0.9, good=False)
    assert thresholds.of("local") == 0.6
    for _ in range(20):
        thresholds.add("local", 0.9, good=False)
    assert thresholds.of("local") == 0.95


@given(st.lists(st.tuples(st.floats(0, 1), st.booleans()), max_size=100), st.floats(0, 1))
def test_experience_only_tightens(outcomes: list[tuple[float, bool]], base: float) -> None:
    """No history takes a threshold below what is configured, or above one; what is kept gives the same again."""
    clock = Clock()
    thresholds = Thresholds({"t": base}, clock=clock)
    for sure, good in outcomes:
        thresholds.add("t", sure, good=good)
    assert base - 1e-4 <= thresholds.of("t") <= max(base, 0.95)
    other = Thresholds({"t": base}, clock=clock)
    other.load(thresholds.rows())
    assert other.all == thresholds.all
