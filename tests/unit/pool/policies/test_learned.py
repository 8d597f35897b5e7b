"""The learned eviction policy: it learns, it beats its floor where there is something to learn, it knows when not."""

import random

import pytest

from appliance.pool.policies.eviction import ENOUGH_USES, MAX_PENDING, GreedyDual, Idle, Learned
from appliance.pool.policies.forecast import Demand


def container(image: str, since: float, *, memory_mb: int = 256, runs: int = 1) -> Idle:
    """An idle container of an image."""
    return Idle(id=f"of-{image}", image=image, memory_mb=memory_mb, runs=runs, cold_ms=500.0, since=since)


def learned(demand: Demand) -> Learned:
    """The policy with no hints and at noon."""
    return Learned(demand, next_hint_s=lambda _image, _now: None, hour=lambda _: 12.0)


def live(policy: Learned, demand: Demand, gaps_s: dict[str, float], until_s: float) -> list[Idle]:
    """Images come at their own rates; one idle container of each is shown to the policy now and then."""
    rng = random.Random(3)  # noqa: S311 - to repeat, not a secret
    since = dict.fromkeys(gaps_s, 0.0)
    arrivals = []
    for image, gap_s in gaps_s.items():
        at = rng.expovariate(1 / gap_s)
        while at < until_s:
            arrivals.append((at, image))
            at += rng.expovariate(1 / gap_s)
    before = 0.0
    for at, image in sorted(arrivals):
        # At any moment: just before an arrival, what mostly arrives would seem to return at once.
        policy.observed([container(each, since[each]) for each in gaps_s], rng.uniform(before, at))
        before = at
        demand.arrived(image, at)
        policy.arrived(image, at)
        demand.ended(image, 0.5, at + 0.5)
        since[image] = at + 0.5
    return [container(each, since[each]) for each in gaps_s]


def test_it_learns_who_returns_soon() -> None:
    """After some uses its predictions are in the order of the true rates, within a factor of five."""
    demand = Demand()
    policy = learned(demand)
    gaps_s = {"often": 10.0, "seldom": 100.0, "rare": 1000.0}
    idle, now = live(policy, demand, gaps_s, 8000.0), 8001.0
    assert policy.decides
    waits = [policy.wait_s(each, 1, now) for each in idle]
    for wait_s, gap_s in zip(waits, gaps_s.values(), strict=True):
        assert wait_s is not None
        assert gap_s / 5 < wait_s < 5 * gap_s
    often, seldom, rare = policy.worths(idle, now)
    assert often > seldom > rare


def test_memory_counts_against_it() -> None:
    """Of two that return alike the larger is worth less."""
    demand = Demand()
    policy = learned(demand)
    live(policy, demand, {"a": 10.0, "b": 10.0}, 2000.0)
    small, large = container("a", 1999.0), container("b", 1999.0, memory_mb=2048)
    worths = policy.worths([small, large], 2000.0)
    assert worths[0] > worths[1]


def test_it_leaves_it_to_greedy_dual_until_it_has_seen_enough() -> None:
    """Without experience its worths are Greedy-Dual's."""
    policy, greedy = learned(Demand()), GreedyDual()
    idle = [container("a", 1.0, runs=5), container("b", 2.0)]
    assert not policy.decides
    assert policy.worths(idle, 3.0) == greedy.worths(idle, 3.0)
    assert policy.wait_s(idle[0], 1, 3.0) is None


def test_it_steps_back_when_it_loses_and_comes_back_when_it_wins(monkeypatch: pytest.MonkeyPatch) -> None:
    """Evictions on which the two differ are duels: lost ones hand over to Greedy-Dual, won ones take back."""
    demand = Demand()
    policy = learned(demand)
    live(policy, demand, {"a": 10.0, "b": 1000.0}, 3000.0)
    assert policy.decides
    now = 3100.0

    def duel(*, wanted: str) -> None:
        # Greedy-Dual counts runs: it would give up `a`, which comes often but whose container is new.
        idle = [container("a", now, runs=0), container("b", now - 50.0, runs=90)]
        policy.worths(idle, now)
        policy.evicted(idle[1], now)
        demand.images[wanted].runs = 1  # nothing else of the demand changes, so both go on choosing as they did
        policy.arrived(wanted, now + 1)
        demand.images[wanted].runs = 0

    for _ in range(5):
        duel(wanted="a")
    assert policy.decides
    monkeypatch.setattr(policy, "_learn", lambda _x, _y: None)  # else it learns that it was wrong, and is not
    rounds = 0
    while policy.decides and rounds < 60:
        duel(wanted="b")
        rounds += 1
    assert not policy.decides
    while not policy.decides and rounds < 200:
        duel(wanted="a")
        rounds += 1
    assert policy.decides


def test_its_memory_is_bounded() -> None:
    """However many images come and never return, what it keeps does not grow."""
    demand = Demand()
    policy = learned(demand)
    for number in range(4 * MAX_PENDING):
        idle = [container(f"i{number}", float(number)), container("other", 0.0)]
        policy.worths(idle, number + 1.0)
        policy.evicted(idle[0], number + 1.0)
    assert len(policy._pending) <= MAX_PENDING
    assert len(policy._duels) <= MAX_PENDING
    assert policy.state().seen >= ENOUGH_USES
