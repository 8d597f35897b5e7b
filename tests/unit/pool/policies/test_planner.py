"""Eviction, prewarming, cold costs and quarantine."""

from collections import Counter

from hypothesis import given
from hypothesis import strategies as st

from appliance.pool.policies import ColdCosts, Idle, Planner, Quarantine, View
from appliance.pool.policies.greedy_dual import GreedyDual
from appliance.pool.policies.planner import missing, victims
from appliance.pool.settings import PoolConfig

idles = st.lists(
    st.builds(
        Idle,
        id=st.uuids().map(str),
        image=st.sampled_from(("base", "vision")),
        memory_mb=st.integers(16, 2048),
        runs=st.integers(0, 100),
        cold_ms=st.floats(1, 5000),
        since=st.floats(0, 100),
    ),
    max_size=8,
    unique_by=lambda each: each.id,
)
floors = st.dictionaries(st.sampled_from(("base", "vision")), st.integers(0, 3))


@given(idles, st.integers(-3, 5), st.integers(-1000, 4000), floors, st.booleans())
def test_victims_free_enough_and_no_more(
    idle: list[Idle], slots: int, memory_mb: int, floor: dict[str, int], spare: bool
) -> None:
    """Those given up free what is needed, the last of them was needed, and floors are spared where asked."""
    worths = GreedyDual().worths(idle, 100.0)
    chosen = victims(idle, worths, slots=slots, memory_mb=memory_mb, spare=floor if spare else {})
    if chosen is None:
        assert spare or slots > len(idle) or memory_mb > sum(each.memory_mb for each in idle)
        return

    def enough(some: tuple[Idle, ...]) -> bool:
        return len(some) >= slots and sum(each.memory_mb for each in some) >= memory_mb

    assert enough(chosen)
    assert not chosen or not enough(chosen[:-1])
    worth = dict(zip((each.id for each in idle), worths, strict=True))
    assert [worth[each.id] for each in chosen] == sorted(worth[each.id] for each in chosen)
    if spare:
        before, taken = Counter(each.image for each in idle), Counter(each.image for each in chosen)
        assert all(before[image] - taken[image] >= min(before[image], floor.get(image, 0)) for image in before)


def test_the_least_valuable_goes_first() -> None:
    """Large, cheap to start and seldom used goes before small, dear and often used; age levels that out."""
    policy = GreedyDual()
    plain = {"image": "base", "memory_mb": 100, "runs": 1, "cold_ms": 100.0, "since": 0.0}
    used = Idle(id="used", **{**plain, "runs": 10})
    large = Idle(id="large", **{**plain, "memory_mb": 400})
    assert policy.worths([used, large], 1.0) == [11.0, 0.5]
    other = Idle(id="other", **{**plain, "runs": 50})
    policy.worths([used, large, other], 1.0)
    policy.evicted(other, 1.0)
    fresh = Idle(id="fresh", **{**plain, "since": 2.0})
    assert policy.worths([used, fresh, large], 3.0) == [11.0, 53.0, 0.5]


@given(floors, st.dictionaries(st.sampled_from(("base", "vision")), st.integers(0, 4)))
def test_missing_fills_the_floor_exactly(floor: dict[str, int], coming: dict[str, int]) -> None:
    """What is to be started brings every image to its floor, and none beyond."""
    counts = Counter(missing(floor, coming))
    assert all(counts[image] == max(0, floor[image] - coming.get(image, 0)) for image in floor)


def test_tend_fills_the_floor_and_lets_the_old_go() -> None:
    """A container beyond the floor that was idle for idle_s goes; what the floor lacks is started, some at a time."""
    settings = PoolConfig(floor={"base": 3, "vision": 1}, idle_s=100.0, starts_at_once=2)
    planner = Planner(settings, ColdCosts(500.0), lambda _: 256)
    old = tuple(
        Idle(id=name, image="vision", memory_mb=256, runs=1, cold_ms=500.0, since=at)
        for name, at in (("older", 0.0), ("old", 1.0), ("new", 90.0))
    )
    view = View(idle=old, memory_mb=768, containers=3, budget_mb=4096, capacity=8)
    starts, retired = planner.tend(view, 110.0)
    assert [each.image for each in starts] == ["base", "base"]
    assert [each.id for each in retired] == ["older", "old"]


def test_cold_costs_follow_what_is_measured() -> None:
    """Before the first measurement the configured figure, then the upper part of the recent ones."""
    costs = ColdCosts(500.0, window=4)
    assert costs.of("base") == 500.0
    for took in (100.0, 200.0, 300.0, 400.0):
        costs.add("base", took)
    assert costs.of("base") == 400.0
    for _ in range(4):
        costs.add("base", 50.0)
    assert costs.of("base") == 50.0
    assert costs.of("vision") == 500.0


def test_quarantine() -> None:
    """An image is left alone after so many failures in a row, for a while, and not after a success."""
    quarantine = Quarantine(after=3, for_s=60)
    for _ in range(2):
        quarantine.failed("base", "no such file", 10.0)
    assert quarantine.reason("base", 10.0) == ""
    quarantine.failed("base", "no such file", 11.0)
    assert "3 starts" in quarantine.reason("base", 12.0)
    assert "no such file" in quarantine.reasons(12.0)[0]
    assert quarantine.reason("vision", 12.0) == ""
    assert quarantine.reason("base", 71.0) == ""
    quarantine.failed("base", "again", 72.0)
    assert "again" in quarantine.reason("base", 73.0)
    quarantine.succeeded("base")
    assert quarantine.reasons(73.0) == ()
