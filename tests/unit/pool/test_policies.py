"""Eviction, prewarming, cold costs and quarantine."""

from collections import Counter

from hypothesis import given
from hypothesis import strategies as st

from appliance.pool.policies import ColdCosts, Idle, Quarantine, priority, victims, wanted

idles = st.lists(
    st.builds(
        Idle,
        id=st.uuids().map(str),
        image=st.sampled_from(("base", "vision")),
        memory_mb=st.integers(16, 2048),
        runs=st.integers(0, 100),
        cold_ms=st.floats(1, 5000),
        clock=st.floats(0, 100),
    ),
    max_size=8,
)
floors = st.dictionaries(st.sampled_from(("base", "vision")), st.integers(0, 3))


@given(idles, st.integers(-3, 5), st.integers(-1000, 4000), floors, st.booleans())
def test_victims_free_enough_and_no_more(
    idle: list[Idle], slots: int, memory_mb: int, floor: dict[str, int], spare: bool
) -> None:
    """Those given up free what is needed, the last of them was needed, and floors are spared where asked."""
    chosen = victims(idle, slots=slots, memory_mb=memory_mb, floor=floor, spare_floor=spare)
    if chosen is None:
        allowed = victims(idle, slots=len(idle) + 1, memory_mb=0, floor={}, spare_floor=False)
        assert allowed is None
        return

    def enough(some: tuple[Idle, ...]) -> bool:
        return len(some) >= slots and sum(each.memory_mb for each in some) >= memory_mb

    assert enough(chosen)
    assert not chosen or not enough(chosen[:-1])
    assert [priority(each) for each in chosen] == sorted(priority(each) for each in chosen)
    if spare:
        before, taken = Counter(each.image for each in idle), Counter(each.image for each in chosen)
        assert all(before[image] - taken[image] >= min(before[image], floor.get(image, 0)) for image in before)


def test_the_least_valuable_goes_first() -> None:
    """Large, cheap to start and seldom used goes before small, dear and often used; age levels that out."""
    plain = {"image": "base", "memory_mb": 100, "runs": 1, "cold_ms": 100.0, "clock": 0.0}
    used = Idle(id="used", **{**plain, "runs": 10})
    large = Idle(id="large", **{**plain, "memory_mb": 400})
    fresh = Idle(id="fresh", **{**plain, "clock": 50.0})
    chosen = victims([used, fresh, large], slots=2, memory_mb=0, floor={}, spare_floor=False)
    assert chosen is not None
    assert [each.id for each in chosen] == ["large", "used"]


@given(floors, st.dictionaries(st.sampled_from(("base", "vision")), st.integers(0, 4)))
def test_wanted_fills_the_floor_exactly(floor: dict[str, int], coming: dict[str, int]) -> None:
    """What is to be started brings every image to its floor, and none beyond."""
    counts = Counter(wanted(floor, coming))
    assert all(counts[image] == max(0, floor[image] - coming.get(image, 0)) for image in floor)


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
