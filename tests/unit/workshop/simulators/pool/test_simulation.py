"""The simulator: it counts right on traces worked out by hand, and shows what the policies are for."""

import pytest
from msgspec.structs import replace

from appliance.pool.settings import PoolConfig
from workshop.bench.policy import policies
from workshop.simulators.pool import Arrival, Image, Outcome, Trace, simulate
from workshop.simulators.pool.clairvoyant import Belady, cold_with_foresight, least_cold, least_cold_within
from workshop.simulators.pool.simulation import REMOTE_MS, WARM_MS
from workshop.simulators.pool.traces import plain

pytestmark = pytest.mark.thorough

BARE = PoolConfig(floor={}, capacity=64, memory_mb=8192, mode="local", eviction="lru", prewarm=(), keep="fixed")


def trace_of(*arrivals: tuple[float, str], duration_s: float = 1000.0, gateways: int = 1) -> Trace:
    """Runs of a second each, the n-th at gateway n modulo their number; containers of 1 GB that take 500 ms."""
    names = {image for _, image in arrivals}
    return Trace(
        name="by hand",
        duration_s=duration_s,
        images={name: Image(name=name, memory_mb=1024, cold_ms=500.0) for name in names},
        arrivals=tuple(
            Arrival(at_s=at, image=image, service_s=1.0, gateway=number % gateways)
            for number, (at, image) in enumerate(arrivals)
        ),
        gateways=gateways,
    )


def test_a_second_run_is_warm_and_waste_is_counted() -> None:
    """Cold, then warm; idle from 1.5 s to 11.5 s and then to the end of the trace: 1 GB each."""
    outcome = simulate(trace_of((0.0, "a"), (11.5, "a"), duration_s=100.0), BARE)
    assert (outcome.cold, outcome.local, outcome.remote) == (1, 1, 0)
    assert outcome.wasted_gb_s == 10.0 + 87.5
    assert outcome.used_gb_s == 2.5
    assert outcome.p50_ms == WARM_MS
    assert outcome.p99_ms == 500.0
    assert outcome.cold_rate == 0.5


def test_keep_alive_ends() -> None:
    """Kept for 60 s and no longer, to within a tick."""
    outcome = simulate(trace_of((0.0, "a"), (100.0, "a")), replace(BARE, idle_s=60.0))
    assert outcome.cold == 2
    assert 120.0 <= outcome.wasted_gb_s <= 2 * 65.1
    assert outcome.retired == 2


def test_the_three_modes() -> None:
    """Cold never reuses; local reuses here; federated also what another gateway has."""
    trace = trace_of((0.0, "a"), (10.0, "a"), (20.0, "a"), (30.0, "a"), gateways=2)
    cold = simulate(trace, BARE, mode="cold")
    assert (cold.cold, cold.wasted_gb_s) == (4, 0.0)
    assert simulate(trace, BARE, mode="local").cold == 2
    federated = simulate(trace, BARE, mode="federated")
    assert (federated.cold, federated.remote, federated.local) == (1, 2, 1)
    assert federated.p99_ms == 500.0
    assert federated.p50_ms in {WARM_MS, REMOTE_MS}


def test_runs_wait_when_everything_is_busy() -> None:
    """Room for one container: the second run waits for the first and then has it."""
    outcome = simulate(trace_of((0.0, "a"), (0.1, "a")), replace(BARE, memory_mb=1024))
    assert (outcome.cold, outcome.local, outcome.waited, outcome.lost) == (1, 1, 1, 0)
    assert outcome.p99_ms == 1400.0 + WARM_MS
    # One of another image waits for room and is started then: its wait is its own, its cold start is half a second.
    other = simulate(trace_of((0.0, "a"), (0.1, "b")), replace(BARE, memory_mb=1024))
    assert (other.cold, other.cold_s, other.waited) == (2, 1.0, 1)
    assert other.p99_ms == 1400.0 + 500.0


def test_a_run_takes_what_comes_free_before_its_own() -> None:
    """The first ends at 1.5 s, 0.2 s before the second's own would be there; bound to that, the second waits for it."""
    trace = trace_of((0.0, "a"), (1.2, "a"), duration_s=100.0)
    outcome = simulate(trace, BARE)
    assert (outcome.cold, outcome.local, outcome.sooner, outcome.lost) == (1, 1, 1, 0)
    assert outcome.p50_ms == 300.0 + WARM_MS
    assert outcome.used_gb_s == 0.5 + 1.0 + 0.5 + 1.0  # a start for a run is no waste, whatever runs in it
    assert outcome.wasted_gb_s == 97.5 + 98.3
    bound = simulate(trace, BARE, binds=True)
    assert (bound.cold, bound.local, bound.sooner) == (2, 0, 0)
    assert bound.p50_ms == 500.0


def test_what_is_expected_when_the_trace_ends_is_lost() -> None:
    """A run whose container is not there by the end is accounted for."""
    outcome = simulate(trace_of((0.0, "a"), (99.9, "a"), duration_s=100.0), replace(BARE, idle_s=1.0))
    assert (outcome.cold, outcome.lost) == (1, 1)


def test_the_same_trace_gives_the_same_figures() -> None:
    """Nothing depends on the clock or on chance that is not the trace's."""
    settings = replace(PoolConfig(floor={}), memory_mb=1024, mode="federated")
    outcomes = [simulate(plain("poisson", duration_s=1800.0, gateways=3), settings) for _ in range(2)]
    assert outcomes[0] == outcomes[1]
    assert outcomes[0].runs == outcomes[0].local + outcomes[0].remote + outcomes[0].cold + outcomes[0].lost


def _accounted(outcome: Outcome, memory_gb: float, duration_s: float) -> bool:
    return outcome.used_gb_s + outcome.wasted_gb_s <= memory_gb * duration_s * 1.001


def test_timers_are_prewarmed() -> None:
    """On timers the default policies have a fraction of keep-alive's cold starts, with less idle memory."""
    trace = plain("timer", rate=0.3, images=16, duration_s=2 * 3600.0)
    plain_ = simulate(trace, replace(BARE, memory_mb=2048, capacity=256))
    default = simulate(trace, replace(PoolConfig(floor={}), mode="local", memory_mb=2048, capacity=256))
    assert default.cold < 0.5 * plain_.cold
    assert default.wasted_gb_s < plain_.wasted_gb_s
    assert _accounted(default, 2.0, trace.duration_s)
    assert _accounted(plain_, 2.0, trace.duration_s)


def test_no_policy_on_demand_beats_the_bound() -> None:
    """The bound by knapsack holds for all that start on demand, Bélády's crystal ball included, and is 0 waste cold."""
    trace = plain("bursts", images=8, duration_s=3600.0, rate=0.3)
    for budget_mb in (512, 1024, 4096):
        for eviction in ("lru", "greedy-dual"):
            settings = replace(BARE, memory_mb=budget_mb, eviction=eviction, idle_s=1e6)
            for make in (lambda _: None, lambda gateway: Belady(trace, gateway)):
                outcome = simulate(trace, settings, make_evictor=make, binds=True)
                [bound] = least_cold(trace, [outcome.wasted_gb_s * 1024])
                assert bound <= outcome.cold
    first = least_cold(trace, [0.0, 1e18])
    assert first[0] >= first[1] > 0


def test_the_bound_within_a_budget_by_hand() -> None:
    """Room for one: while `b` runs `a` cannot be kept, so every start is cold; room for two: the first of each."""
    trace = trace_of((0.0, "a"), (10.0, "b"), (20.0, "a"), (30.0, "b"), duration_s=60.0)
    assert least_cold_within(trace, [1024, 2048, 1e9]) == [4, 2, 2]
    assert cold_with_foresight(trace, [1024, 2048, 1e9]) == [4, 2, 2]


@pytest.mark.parametrize("kind", ["poisson", "bursts", "timer"])
def test_no_policy_on_demand_beats_the_bound_within_its_budget(kind: str) -> None:
    """It holds for all that start on demand, crystal balls included, whatever the prices were moved to."""
    trace = plain(kind, images=8, duration_s=3600.0, rate=0.3)
    budgets = (1024, 2048, 4096)
    for bound, rough, planned, budget_mb in zip(
        least_cold_within(trace, budgets),
        least_cold_within(trace, budgets, rounds=3),
        cold_with_foresight(trace, budgets),
        budgets,
        strict=True,
    ):
        assert rough <= bound <= planned
        for eviction in ("lru", "greedy-dual"):
            settings = replace(BARE, memory_mb=budget_mb, eviction=eviction, idle_s=1e6)
            for make in (
                lambda _: None,
                lambda gateway: Belady(trace, gateway),
                lambda gateway: Belady(trace, gateway, by_number=True),
            ):
                assert bound <= simulate(trace, settings, make_evictor=make, binds=True).cold


def test_the_bound_falls_with_the_budget() -> None:
    """More memory allows no more cold starts, down to the first on each level; without any, every run is one."""
    trace = plain("poisson", images=6, duration_s=3600.0, rate=0.2)
    bounds = least_cold_within(trace, [0, 512, 1024, 4096, 1e9])
    assert bounds == sorted(bounds, reverse=True)
    assert bounds[-1] == least_cold(trace, [1e18])[0]
    assert bounds[0] >= 0.95 * len(trace.arrivals)


@pytest.mark.parametrize("name", list(policies()))
@pytest.mark.parametrize("kind", ["poisson", "bursts", "diurnal", "timer"])
def test_each_policy_on_each_kind_of_arrivals(kind: str, name: str) -> None:
    """No run is unaccounted for, no memory beyond the budget is held, and all have far fewer cold starts than none."""
    trace = plain(kind, seed=7, images=12, duration_s=1800.0, rate=0.3)
    budget_mb = 2048
    outcome = simulate(trace, replace(policies()[name], memory_mb=budget_mb), tick_s=5.0)
    assert outcome.runs == len(trace.arrivals) == outcome.local + outcome.cold + outcome.lost
    assert outcome.remote == 0
    assert _accounted(outcome, budget_mb / 1024, trace.duration_s)
    assert 0 < outcome.cold < 0.7 * outcome.runs
    assert outcome.cold_rate == outcome.cold / outcome.runs


def test_a_thousand_gateways() -> None:
    """The same deciders at a thousand gateways: every run is accounted for, and what others have spares cold starts."""
    trace = plain("poisson", seed=3, images=24, rate=50.0, duration_s=60.0, gateways=1000)
    assert len({each.gateway for each in trace.arrivals}) > 700
    settings = replace(PoolConfig(floor={}), memory_mb=2048, capacity=64)
    alone = simulate(trace, replace(settings, mode="local"), tick_s=10.0)
    together = simulate(trace, replace(settings, mode="federated"), tick_s=10.0)
    for outcome in (alone, together):
        assert outcome.runs == len(trace.arrivals)
        assert outcome.runs == outcome.local + outcome.remote + outcome.cold + outcome.lost
    assert together.cold < 0.5 * alone.cold
