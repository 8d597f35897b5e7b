"""Forecasts: plan hints, idle-time histograms, rate times service time."""

import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.model import PoolHint
from appliance.pool.policies.forecast import (
    BUCKETS,
    LONGEST_S,
    MAX_HINTS,
    MAX_IMAGES,
    OPERATOR,
    Demand,
    Histogram,
    IdleTimes,
    Level,
    PlanHints,
    Rate,
    bucket,
    containers_for,
    lower_s,
    until_level_s,
)


def level(number: int = 1, *, busy: int = 0, image: str = "base") -> Level:
    """A level of an image whose containers take a second."""
    return Level(image, number, busy, 1.0)


def periodic(period_s: float, count: int, *, service_s: float = 1.0) -> tuple[Demand, float]:
    """A demand of one run a period; returns it and the end of the last run."""
    demand = Demand()
    for number in range(count):
        demand.arrived("base", number * period_s)
        demand.ended("base", service_s, number * period_s + service_s)
    return demand, (count - 1) * period_s + service_s


@given(st.floats(0, 200_000))
def test_every_idle_time_has_its_bucket(gap_s: float) -> None:
    """A time lies between the ends of its bucket, but for the last, which has no end."""
    index = bucket(gap_s)
    assert lower_s(index) <= gap_s * 1.000001
    assert index == BUCKETS - 1 or gap_s <= lower_s(index + 1) * 1.000001


def test_a_timer_is_told_from_chance() -> None:
    """The window of a timer is narrow; that of a Poisson process is none, however few or many were seen."""
    timer, chance = IdleTimes(), IdleTimes()
    rng = random.Random(1)  # noqa: S311 - to repeat, not a secret
    for seen in range(200):
        timer.add(rng.gauss(60.0, 0.6))
        chance.add(rng.expovariate(1 / 60.0))
        window = timer.window()
        assert (window is None) == (seen < 7)
        assert window is None or 50.0 < window[0] < 60.0 < window[1] < 70.0
        assert chance.window() is None


def test_old_idle_times_fade() -> None:
    """After a change of period the window follows; the counts stay bounded."""
    times = IdleTimes()
    for period_s in [10.0] * 1000 + [100.0] * 1000:
        times.add(period_s)
        assert times.total < 256
    window = times.window()
    assert window is not None
    assert window[0] > 50.0


def test_the_price_of_being_kept() -> None:
    """For a timer what is left of its period, for chance about the mean, after a burst more the longer it lasts."""
    timer, chance, bursts = IdleTimes(), IdleTimes(), IdleTimes()
    rng = random.Random(2)  # noqa: S311 - to repeat, not a secret
    for _ in range(250):
        timer.add(60.0)
        chance.add(rng.expovariate(1 / 60.0))
        bursts.add(1.0 if rng.random() < 0.9 else 600.0)
    assert timer.price_s(0.0) == pytest.approx(60.0, rel=0.15)
    assert timer.price_s(40.0) == pytest.approx(20.0, rel=0.3)
    assert chance.price_s(0.0) == pytest.approx(60.0, rel=0.4)
    assert chance.price_s(60.0) == pytest.approx(60.0, rel=0.7)
    assert bursts.price_s(0.0) < 2.0
    assert bursts.price_s(10.0) > 300.0
    assert IdleTimes().price_s(1.0) > 86_400.0


def test_histogram_prewarms_shortly_before_and_keeps_shortly_after() -> None:
    """What comes each minute rests after its run, is wanted from about 50 s on, and not for ever."""
    demand, end = periodic(60.0, 20)
    histogram = Histogram(demand)
    assert histogram.wants(level(), end + 5) == ""
    assert histogram.rests(level(), end, end + 5) == "not due for a while"
    assert histogram.wants(level(), end + 57)
    assert histogram.rests(level(), end, end + 57) == ""
    assert histogram.rests(level(), end, end + 90) == "it was due and nobody came"
    assert histogram.wants(level(2), end + 57) is None  # never two at a time: no opinion


def test_histogram_does_not_send_away_what_is_back_in_seconds() -> None:
    """A period of a few seconds is kept through."""
    demand, end = periodic(4.0, 20)
    assert Histogram(demand).rests(level(), end, end + 0.5) == ""


def test_what_came_within_milliseconds_is_not_given_up_within_them() -> None:
    """After a load under which each idle time was milliseconds a container is kept for ten cold starts all the same."""
    demand, end = periodic(0.05, 60, service_s=0.01)
    histogram = Histogram(demand)
    assert histogram.rests(level(), end, end + 9.9) == ""
    assert histogram.rests(level(), end + 9.0, end + 12.0) == ""  # new, or used for another level
    assert histogram.rests(level(), end, end + 10.1) == "it was due and nobody came"
    assert histogram.wants(level(), end + 5.0) == ""  # no reason to start another


def test_levels_are_learned_apart() -> None:
    """Two at a time each hour: the second is due by its own idle times, though the first is wanted each minute."""
    demand = Demand()
    at = 0.0
    for minute in range(1, 1200):
        at = minute * 60.0
        demand.arrived("base", at)
        if minute % 60 == 0:
            demand.arrived("base", at)
            demand.ended("base", 1.0, at + 1)
        demand.ended("base", 1.0, at + 1)
    histogram = Histogram(demand)
    last = 1140 * 60.0
    assert histogram.wants(level(2, busy=1), last + 1800) == ""
    assert histogram.wants(level(2, busy=1), last + 3590)


@given(st.floats(0.001, 150.0), st.floats(0.5, 0.999), st.floats(0.0, 20.0))
def test_more_load_or_a_higher_target_takes_no_fewer(load: float, target: float, more: float) -> None:
    """Containers for a load grow with it and with the target, and at least one is there."""
    count = containers_for(load, target)
    assert 1 <= count <= containers_for(load + more, target) or load > 95.0
    assert count <= containers_for(load, min(0.9999, target + more / 100)) or load > 95.0


def test_containers_for_a_load() -> None:
    """The documented example: mean 2; five give 94.7 %, six 98.3 %."""
    assert containers_for(2.0, 0.947) == 5
    assert containers_for(2.0, 0.98) == 6
    assert containers_for(1e9, 0.9) == 256
    hits = sum(math.exp(-2.0) * 2.0**k / math.factorial(k) for k in range(5))
    assert hits == pytest.approx(0.947, abs=0.001)


def test_rate_grows_and_shrinks_with_demand() -> None:
    """Two a second of 2 s each want several; a minute's silence later one; after long silence it has no opinion."""
    demand, end = periodic(0.5, 100, service_s=2.0)
    rate = Rate(demand, hit_target=0.95, horizon_s=600.0)
    assert rate.wants(level(6), end)
    assert rate.wants(level(30), end) == ""
    assert rate.wants(level(1), end + 60)
    assert rate.wants(level(4), end + 60) == ""
    assert rate.wants(level(1), end + 4000) is None


def test_hints_are_wanted_in_time_and_met_by_runs() -> None:
    """What a plan announces is wanted a cold start ahead, until it comes or its time is over."""
    hints = PlanHints()
    hints.hinted(PoolHint(image="base", count=2, in_s=30.0, keep_s=60.0, task="t1"), 100.0)
    assert hints.wants(level(), 110.0) is None
    assert hints.wants(level(2), 129.5)
    assert hints.wants(level(3), 129.5) is None
    assert hints.wants(level(3, busy=1), 129.5)  # the busy one may be another's
    assert hints.next_s("base", 110.0) == 20.0
    hints.arrived("base", 131.0)
    assert hints.wants(level(2), 131.0) is None
    hints.arrived("base", 132.0)
    assert list(hints.images(132.0)) == []


def test_hints_replace_expire_and_are_bounded() -> None:
    """A later hint of the same task counts, a count of 0 withdraws, time ends it, and there are not too many."""
    hints = PlanHints()
    hints.hinted(PoolHint(image="base", count=3, task="t1"), 0.0)
    hints.hinted(PoolHint(image="base", count=1, task="t1"), 0.0)
    assert hints.wants(level(2), 1.0) is None
    hints.hinted(PoolHint(image="base", count=0, task="t1"), 1.0)
    assert hints.wants(level(1), 1.0) is None
    for number in range(2 * MAX_HINTS):
        hints.hinted(PoolHint(image="base", task=f"t{number}", keep_s=10.0), 2.0)
    assert hints.wants(level(MAX_HINTS), 3.0)
    assert hints.wants(level(MAX_HINTS + 1), 3.0) is None
    assert list(hints.images(20.0)) == []


def test_an_operators_wish_is_not_used_up() -> None:
    """Containers an operator asked for stay wanted while runs come and go."""
    hints = PlanHints()
    hints.hinted(PoolHint(image="base", count=1, task=OPERATOR), 0.0)
    hints.arrived("base", 1.0)
    assert hints.wants(level(), 2.0)


def test_demand_forgets_the_oldest_image_and_lost_runs() -> None:
    """Images are bounded; a run whose end was never told does not stay on the books."""
    demand = Demand()
    for number in range(2 * MAX_IMAGES):
        demand.arrived(f"i{number}", float(number))
    assert len(demand.images) == MAX_IMAGES
    assert "i0" not in demand.images
    demand.settle({"i511"}, 1000.0)
    assert demand.images["i511"].runs == 1
    assert demand.images["i510"].runs == 0


def test_when_the_next_level_is_wanted() -> None:
    """The worked example: the first after a gap, the second after many, sooner while one is in use."""
    assert until_level_s(0.1, 1.0, 0, 1) == pytest.approx(10.0)
    assert until_level_s(0.1, 1.0, 0, 2) == pytest.approx(120.0)
    assert until_level_s(0.1, 1.0, 1, 2) == pytest.approx(110.0)


@given(st.floats(1e-6, 100.0), st.floats(0.0, 1000.0), st.integers(0, 15), st.integers(1, 15))
def test_a_higher_level_is_wanted_later(rate: float, service_s: float, runs: int, more: int) -> None:
    """It takes a gap at least, longer for a higher level, and is bounded whatever the numbers are."""
    times = [until_level_s(rate, service_s, runs, runs + each) for each in range(1, more + 1)]
    assert times == sorted(times)
    assert min(1.0 / rate, LONGEST_S) <= times[0] * (1 + 1e-9)
    assert times[-1] <= LONGEST_S


def test_the_slow_rate_forgets_slowly() -> None:
    """A new image is taken for one of a run a minute; what came steadily for hours is known; a silence lowers it."""
    demand = Demand()
    demand.arrived("a", 0.0)
    assert demand.images["a"].slow_rate(0.0) == pytest.approx(1 / 60)
    for number in range(1, 2000):
        demand.arrived("a", 10.0 * number)
    known = demand.images["a"].slow_rate(19_990.0)
    assert known == pytest.approx(0.1, rel=0.02)
    assert 0.3 * known < demand.images["a"].slow_rate(19_990.0 + 3600.0) < 0.4 * known
