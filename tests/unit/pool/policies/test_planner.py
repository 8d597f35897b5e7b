"""The planner: what it orders is within bounds, spares what it must, and does not contradict itself."""

from collections import Counter
from typing import get_args, get_type_hints

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.model import PoolHint
from appliance.pool.policies import ColdCosts, Idle, Planner, View
from appliance.pool.policies.eviction import EVICTION, KEEPING, GreedyDual
from appliance.pool.policies.forecast import OPERATOR
from appliance.pool.policies.planner import PlannerState, missing, victims
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
    config = PoolConfig(floor={"base": 3, "vision": 1}, keep="fixed", idle_s=100.0, starts_at_once=2)
    planner = Planner(config, ColdCosts(500.0), lambda _: 256)
    old = tuple(
        Idle(id=name, image="vision", memory_mb=256, runs=1, cold_ms=500.0, since=at)
        for name, at in (("older", 0.0), ("old", 1.0), ("new", 90.0))
    )
    view = View(idle=old, memory_mb=768, containers=3, budget_mb=4096, capacity=8)
    starts, retired = planner.tend(view, 110.0)
    assert [each.image for each in starts] == ["base", "base"]
    assert [each.id for each in retired] == ["older", "old"]


def busy_view(idle: int, busy: int) -> View:
    """Return a view of a roomy gateway with so many containers of one image; the idle ones were used at 0 s."""
    kept = tuple(
        Idle(id=f"c{number}", image="base", memory_mb=256, runs=1, cold_ms=500.0, since=0.0) for number in range(idle)
    )
    both = idle + busy
    return View(
        idle=kept, busy={"base": busy}, memory_mb=256 * both, containers=both, budget_mb=4096, capacity=8
    )  # fmt: skip


@pytest.mark.parametrize(
    ("gap_s", "service_s", "busy", "starts"),
    [
        (0.5, 0.003, 1, 0),  # over before a new one could be there
        (0.5, 2.0, 1, 1),  # longer than a start: the floor is to be ready beside it
        (0.2, 0.15, 1, 1),  # three quarters of one are busy at any time, so one more is wanted
        (0.2, 0.15, 4, 0),  # more than that load needs: some of them are free soon
    ],
)
def test_the_floor_counts_what_is_free_soon(gap_s: float, service_s: float, busy: int, starts: int) -> None:
    """A run that is over before a new container could be ready is no reason to start one, unless many keep coming."""
    planner = Planner(PoolConfig(floor={"base": 1}, prewarm=()), ColdCosts(500.0), lambda _: 256)
    at = 0.0
    for number in range(40):
        at = number * gap_s
        planner.arrived("base", at)
        planner.ended("base", service_s, at + min(service_s, gap_s))
    assert len(planner.tend(busy_view(0, busy), at + gap_s)[0]) == starts
    # Those that have taken longer than a start already are not expected to be free soon, however short the others were.
    assert len(planner.tend(replace(busy_view(0, busy), lasting={"base": busy}), at + gap_s)[0]) == 1
    # With nothing busy the floor is what is ready.
    assert len(planner.tend(busy_view(0, 0), at + gap_s)[0]) == 1


def test_after_a_load_nothing_is_started_and_given_up_in_turns() -> None:
    """When short runs come seldom after having come often, no container is started for the floor and given up again."""
    planner = Planner(PoolConfig(floor={"base": 1}), ColdCosts(200.0), lambda _: 256)
    at = 0.0
    for _ in range(100):  # four at a time, 20 ms apart
        for step in range(4):
            planner.arrived("base", at + step * 1e-3)
        for step in range(4):
            planner.ended("base", 0.004, at + 0.004 + step * 1e-3)
        at += 0.02
    held, started, given_up = 4, 0, 0
    for number in range(120):  # one a second, looked at while it runs and just after
        now = at + number
        planner.arrived("base", now)
        for view in (busy_view(held - 1, 1), busy_view(held, 0)):
            idle = tuple(replace(each, since=now - 0.5) for each in view.idle)
            starts, retired = planner.tend(replace(view, idle=idle), now + 0.002)
            started, given_up = started + len(starts), given_up + len(retired)
            held += len(starts) - len(retired)
        planner.ended("base", 0.003, now + 0.003)
    assert started == 0
    assert given_up <= 3


IMAGES = ("base", "vision", "speech")
SIZES = {"base": 128, "vision": 512, "speech": 300}


@st.composite
def situations(draw: st.DrawFn) -> tuple[PoolConfig, Planner, View]:
    """Some settings, a planner with some history, and what there is after it, at 1000 s; within the budget."""
    config = PoolConfig(
        floor=draw(st.dictionaries(st.sampled_from(IMAGES), st.integers(0, 2))),
        eviction=draw(st.sampled_from(("greedy-dual", "lru", "learned"))),
        prewarm=tuple(draw(st.sets(st.sampled_from(("hints", "histogram", "rate"))))),
        keep=draw(st.sampled_from(("fixed", "histogram", "worth"))),
        idle_s=draw(st.sampled_from((5.0, 600.0))),
        starts_at_once=draw(st.integers(1, 4)),
    )
    planner = Planner(config, ColdCosts(500.0), SIZES.__getitem__)
    at = 0.0
    for image, gap_s in draw(st.lists(st.tuples(st.sampled_from(IMAGES), st.sampled_from((1.0, 20.0))), max_size=40)):
        at += gap_s
        planner.arrived(image, at)
        planner.ended(image, 0.5, at + 0.5)
    for image in draw(st.lists(st.sampled_from(IMAGES), max_size=2)):
        planner.hinted(PoolHint(image=image, count=draw(st.integers(0, 3)), task=draw(st.sampled_from("ab"))), 999.0)
    idle = tuple(
        Idle(
            id=f"c{number}",
            image=image,
            memory_mb=SIZES[image],
            runs=draw(st.integers(0, 3)),
            cold_ms=draw(st.sampled_from((100.0, 900.0))),
            since=draw(st.floats(0, 1000)),
        )
        for number, image in enumerate(draw(st.lists(st.sampled_from(IMAGES), max_size=8)))
    )
    busy = {image: draw(st.integers(0, 2)) for image in IMAGES}
    lasting = {image: draw(st.integers(0, busy[image])) for image in IMAGES}
    starting = {image: draw(st.integers(0, 1)) for image in IMAGES}
    others = [image for counts in (busy, starting) for image in counts for _ in range(counts[image])]
    memory_mb = sum(each.memory_mb for each in idle) + sum(SIZES[image] for image in others)
    containers = len(idle) + len(others)
    view = View(
        idle=idle,
        busy=busy,
        lasting=lasting,
        starting=starting,
        memory_mb=memory_mb,
        containers=containers,
        budget_mb=memory_mb + draw(st.integers(0, 1200)),
        capacity=max(1, containers + draw(st.integers(0, 3))),
        blocked=frozenset(draw(st.sets(st.sampled_from(IMAGES), max_size=1))),
    )
    return config, planner, view


@settings(max_examples=150)
@given(situations())
def test_what_is_ordered_stays_within_bounds(situation: tuple[PoolConfig, Planner, View]) -> None:
    """Never beyond memory, places or starts at once, never below a floor, nothing new or blocked is touched."""
    config, planner, view = situation
    starts, retired = planner.tend(view, 1000.0)
    gone = {each.id: each for each in retired}
    facts = {each.id: each for each in view.idle}
    assert len(gone) == len(retired)
    assert len(starts) <= max(0, config.starts_at_once - sum(view.starting.values()))
    freed_mb = sum(facts[each].memory_mb for each in gone)
    assert view.memory_mb - freed_mb + sum(SIZES[each.image] for each in starts) <= view.budget_mb
    assert view.containers - len(gone) + len(starts) <= view.capacity
    assert all(each.why for each in (*starts, *retired))
    assert not {each.image for each in starts} & view.blocked
    before = Counter(each.image for each in view.idle)
    after = before - Counter(facts[each].image for each in gone)
    for image in IMAGES:
        coming = view.starting.get(image, 0)
        assert after[image] + coming >= min(before[image] + coming, config.floor.get(image, 0))
    # One that was started ahead and had no run yet is given up neither for another nor at once.
    assert not [each for each in gone if not facts[each].runs and 1000.0 - facts[each].since < 5.0]
    for each in retired:
        if each.why == "its place is needed":
            assert facts[each.id].runs or 1000.0 - facts[each.id].since >= 60.0


@settings(max_examples=80)
@given(situations(), st.integers(0, 1500), st.integers(0, 1500))
def test_more_room_costs_no_less(situation: tuple[PoolConfig, Planner, View], one_mb: int, more_mb: int) -> None:
    """Who has to go for a small container goes for a larger one too; a run gets room wherever a prewarm does."""
    config, planner, view = situation
    small = planner.room(view, one_mb, 1000.0, for_run=True)
    large = planner.room(view, one_mb + more_mb, 1000.0, for_run=True)
    ahead = planner.room(view, one_mb, 1000.0, for_run=False)
    if large is not None:
        assert small is not None
        assert {each.id for each in small} <= {each.id for each in large}
    if ahead is not None:
        assert small is not None
        taken = Counter(each.image for each in view.idle if each.id in {gone.id for gone in ahead})
        idle = Counter(each.image for each in view.idle)
        assert all(idle[image] - taken[image] >= min(idle[image], config.floor.get(image, 0)) for image in taken)


def test_a_shrunken_budget_is_kept_floors_last() -> None:
    """When memory is short the pool shrinks to what it may have, and takes from floors only what it must."""
    planner = Planner(PoolConfig(floor={"base": 2}), ColdCosts(500.0), SIZES.__getitem__)
    names = [("base", 0.0), ("base", 1.0), ("vision", 900.0), ("vision", 950.0)]
    idle = tuple(
        Idle(id=f"{image}{at:.0f}", image=image, memory_mb=SIZES[image], runs=9, cold_ms=100.0, since=at)
        for image, at in names
    )
    view = View(idle=idle, memory_mb=1280, containers=4, budget_mb=300, capacity=8)
    starts, retired = planner.tend(view, 1000.0)
    assert not starts
    assert {each.id for each in retired} == {"vision900", "vision950"}
    starts, retired = planner.tend(replace(view, budget_mb=200), 1000.0)
    assert not starts
    assert len(retired) == 3


def test_what_was_learned_survives_a_restart() -> None:
    """The state of one planner goes on in another; one of another shape is ignored."""
    planner = Planner(PoolConfig(floor={}), ColdCosts(500.0), SIZES.__getitem__)
    idle = (Idle(id="a", image="base", memory_mb=128, runs=1, cold_ms=500.0, since=0.0),)
    for at in range(100):
        planner.tend(View(idle=idle, memory_mb=128, containers=1, budget_mb=1024, capacity=4), at * 10.0)
        planner.arrived("base", at * 10.0 + 5)
        planner.ended("base", 1.0, at * 10.0 + 6)
    state = planner.state()
    assert state.learned is not None
    assert state.learned.seen > 50
    again = Planner(PoolConfig(floor={}), ColdCosts(500.0), SIZES.__getitem__)
    again.restore(msgspec.json.decode(msgspec.json.encode(state), type=PlannerState), 1000.0)
    assert again.state() == state
    again.restore(PlannerState(learned=msgspec.structs.replace(state.learned, weights=(1.0,))), 1000.0)
    assert again.state() == state


def test_the_papers_baseline() -> None:
    """Mode `local` keeps for ten minutes, gives up the longest idle, and starts nothing ahead, whatever else is set."""
    config = PoolConfig(mode="local", floor={}, idle_s=5.0).baseline()
    planner = Planner(config, ColdCosts(500.0), SIZES.__getitem__)
    planner.hinted(PoolHint(image="base", count=2), 0.0)
    idle = tuple(Idle(id=f"i{age}", image="base", memory_mb=128, runs=1, cold_ms=500.0, since=age) for age in (0, 50))
    view = View(idle=idle, memory_mb=256, containers=2, budget_mb=256, capacity=2)
    assert planner.tend(view, 599.0) == ((), ())
    starts, retirements = planner.tend(view, 601.0)
    assert not starts
    assert [each.id for each in retirements] == ["i0"]
    room = planner.room(view, 128, 100.0, for_run=True)
    assert room is not None
    assert [each.id for each in room] == ["i0"]
    assert PoolConfig(idle_s=5.0).baseline() == PoolConfig(idle_s=5.0)


def test_an_operators_wish_is_met_whatever_is_set() -> None:
    """What an operator wants warm is started and kept until its time, also where nothing is started ahead."""
    planner = Planner(PoolConfig(floor={}, prewarm=()), ColdCosts(500.0), SIZES.__getitem__)
    planner.hinted(PoolHint(image="base", count=1, keep_s=60.0, task=OPERATOR), 0.0)
    empty = View(idle=(), memory_mb=0, containers=0, budget_mb=1024, capacity=4)
    (start,), _ = planner.tend(empty, 1.0)
    assert start.image == "base"
    assert planner.tend(empty, 61.0) == ((), ())


def test_the_tables_of_policies_have_what_the_settings_name() -> None:
    """Each name in `pool.eviction` and `pool.keep` has its policy, and there is no other."""
    hints = get_type_hints(PoolConfig)
    assert set(EVICTION) == set(get_args(hints["eviction"]))
    assert set(KEEPING) == set(get_args(hints["keep"]))
