"""Lookups through bounded views: they end, at the owner, in few hops."""

import math
import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.plane.overlay import MOST_ASKED, Around, Lookup, Step, View, bound_for
from appliance.plane.ring import RING_SIZE, Ring, point
from workshop.bench.dht.simulation import Fleet

fleets = st.sets(st.from_regex(r"[a-z][a-z0-9]{0,4}", fullmatch=True), min_size=1, max_size=60)
positions = st.integers(0, RING_SIZE - 1)


def consistent(names: set[str], rng: random.Random) -> dict[str, View]:
    """Views that know at least their neighbours, and for the rest whatever chance gives them."""
    ring = Ring(names, virtual_nodes=1)
    line = ring.names
    views: dict[str, View] = {}
    for place, name in enumerate(line):
        view = views[name] = View(name, bound=rng.randint(1, 20))
        if len(line) == 1:
            view = views[name] = View.alone(name, bound=4)
            continue
        reach = rng.randint(1, min(6, len(line) - 1))
        view.merge(name, Around(after=tuple(line[(place + step) % len(line)] for step in range(1, reach + 1))))
        if rng.random() < 0.9:
            view.merge(name, Around(before=(line[place - 1],)))
        view.hear(rng.sample(line, rng.randint(0, min(6, len(line)))))
    return views


@settings(max_examples=40, deadline=None)
@given(fleets, positions, st.randoms(use_true_random=False))
def test_a_lookup_ends_at_the_owner(names: set[str], target: int, rng: random.Random) -> None:
    """Whatever else the views hold, with true successors a lookup finds the owner and asks nobody twice."""
    views = consistent(names, rng)
    owner = Ring(names, virtual_nodes=1).holders(target, 1)[0]
    lookup = Lookup(target, views[rng.choice(sorted(names))])
    asked: list[str] = []
    while (name := lookup.next()) is not None:
        asked.append(name)
        lookup.answered(name, views[name].step(target, named=lookup.named(name)))
    assert len(asked) == len(set(asked)) <= MOST_ASKED
    if len(names) <= MOST_ASKED:
        assert lookup.result is not None
        assert lookup.result.owner == owner


@settings(max_examples=60, deadline=None)
@given(fleets, positions, st.integers(1, 70))
def test_the_nearest_known_come_before_a_position(names: set[str], target: int, most: int) -> None:
    """As many as are asked for, by their distance on to the position; the one that stands at it is the first."""
    me, *others = sorted(names)
    view = View(me, bound=100)
    view.hear(others)
    ranked = sorted(others, key=lambda name: (target - point(name)) % RING_SIZE)
    assert view.nearest(target, most) == ranked[:most]
    for place in (me, *others):
        at = point(place)
        assert view.nearest(at, most) == sorted(others, key=lambda name: (at - point(name)) % RING_SIZE)[:most]


@settings(max_examples=40, deadline=None)
@given(fleets, positions, st.randoms(use_true_random=False))
def test_under_failures_a_lookup_ends_at_a_survivor(names: set[str], target: int, rng: random.Random) -> None:
    """With any members gone a lookup asks nobody twice, ends, and never names one that is gone or that it made up."""
    views = consistent(names, rng)
    gone = {name for name in names if rng.random() < 0.5}
    start = rng.choice(sorted(names))
    lookup = Lookup(target, views[start])
    asked: list[str] = []
    while (name := lookup.next()) is not None:
        asked.append(name)
        if name in gone:
            lookup.failed(name)
        else:
            lookup.answered(name, views[name].step(target, named=lookup.named(name)))
    assert len(asked) == len(set(asked)) <= min(MOST_ASKED + 1, len(names))
    if lookup.result is not None:
        assert lookup.result.owner not in gone - {start}


names_told = st.lists(st.sampled_from([f"gw{n}" for n in range(40)]), max_size=8).map(tuple)


@settings(max_examples=40, deadline=None)
@given(positions, st.lists(st.tuples(st.booleans(), st.booleans(), names_told, names_told), min_size=1, max_size=9))
def test_arbitrary_answers_end_a_lookup(
    target: int, answers: list[tuple[bool, bool, tuple[str, ...], tuple[str, ...]]]
) -> None:
    """Members that answer anything at all cannot keep a lookup going in circles."""
    view = View("me", bound=16)
    view.hear(["gw1", "gw2", "gw3"])
    lookup = Lookup(target, view)
    for alive, mine, owners, closer in 20 * answers + 120 * answers[:1]:
        name = lookup.next()
        if name is None:
            break
        if alive:
            lookup.answered(name, Step(mine=mine, owners=owners, closer=closer))
        else:
            lookup.failed(name)
    assert lookup.next() is None


@pytest.mark.parametrize("size", [2, 16, 200, 1000])
def test_hops_stay_within_half_the_logarithm(size: int) -> None:
    """With views of 4·log2 N members the mean is at most ½·log2 N hops; one while all are known."""
    fleet = Fleet(bound=bound_for(size)).settled(f"gw-{n}" for n in range(size))
    names = fleet.ring.names
    hops: list[int] = []
    for _ in range(400):
        target = fleet.rng.getrandbits(160)
        lookup = fleet.lookup(target, fleet.members[fleet.rng.choice(names)].view)
        found = lookup.result
        assert found is not None
        assert found.owner == fleet.ring.holders(target, 1)[0]
        hops.append(lookup.hops)
    assert sum(hops) / len(hops) <= max(1.0, 0.5 * math.log2(size))
    if size <= 16:
        assert max(hops) <= 1


def test_replicas_come_with_the_owner() -> None:
    """What a lookup returns beside the owner are the members after it, in ring order: the replicas."""
    fleet = Fleet(bound=32).settled(f"gw-{n}" for n in range(200))
    for _ in range(50):
        target = fleet.rng.getrandbits(160)
        found = fleet.lookup(target, fleet.members["gw-7"].view).result
        assert found is not None
        assert (found.owner, *found.replicas)[:3] == fleet.ring.holders(target, 3)


def test_a_dead_owner_is_passed_over() -> None:
    """When the owner and the next are gone, the lookup ends at the third, which has the last replica."""
    fleet = Fleet(bound=32).settled(f"gw-{n}" for n in range(200))
    target = point("some key")
    first, second, third = fleet.ring.holders(target, 3)
    del fleet.members[first], fleet.members[second]
    asker = next(name for name in fleet.members if first not in fleet.members[name].view)
    lookup = fleet.lookup(target, fleet.members[asker].view)
    found = lookup.result
    assert found is not None
    assert found.owner == third
    assert {first, second} <= lookup.gone.keys()
