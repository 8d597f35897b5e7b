"""Whom a gateway compares its records with: everybody who may hold what it must hold now, and in a large fleet few."""

from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.plane.anti_entropy import partners, sharing
from appliance.plane.ring import Ring

fleets = st.sets(st.integers(0, 30).map(lambda number: f"g{number}"), max_size=12)
keys = [f"key/{number}" for number in range(300)]


@settings(deadline=None)
@given(fleets, fleets, st.integers(1, 4), st.integers(1, 8))
def test_all_that_may_hold_what_is_new_are_compared_with(
    before: set[str], now: set[str], replicas: int, points: int
) -> None:
    """Of each key that a gateway newly holds or owns, it asks all present holders, old and new."""
    old, new = Ring(before, virtual_nodes=points), Ring(now | {"g0"}, virtual_nodes=points)
    found = partners(old, new, "g0", replicas)
    assert found <= new.members - {"g0"}
    for key in keys:
        holding = new.successors(key, replicas)
        held = old.successors(key, replicas) if old.members else ()
        if "g0" in holding and ("g0" not in held or (holding[0] == "g0" and held[0] != "g0")):
            assert {*holding, *held} & new.members - {"g0"} <= found


@settings(deadline=None)
@given(fleets, st.integers(1, 4), st.integers(1, 8))
def test_nothing_new_nobody_asked(fleet: set[str], replicas: int, points: int) -> None:
    """A ring that has not changed, or from which only the keys of others moved, asks for no comparison."""
    ring = Ring(fleet | {"g0"}, virtual_nodes=points)
    assert partners(ring, ring, "g0", replicas) == frozenset()
    assert partners(ring, ring.with_member("joiner"), "g0", replicas) == frozenset()


@settings(deadline=None)
@given(fleets, st.integers(1, 4), st.integers(1, 8))
def test_sharing_is_mutual(fleet: set[str], replicas: int, points: int) -> None:
    """Each gateway with copies of the same keys is found, by both."""
    ring = Ring(fleet | {"g0"}, virtual_nodes=points)
    for key in keys:
        holding = set(ring.successors(key, replicas))
        if "g0" in holding:
            assert holding - {"g0"} <= sharing(ring, "g0", replicas)
            for other in holding - {"g0"}:
                assert "g0" in sharing(ring, other, replicas)


def test_in_a_large_fleet_few_are_asked() -> None:
    """When one of 300 goes, the others ask a handful of members on average, most of them none."""
    names = [f"m{number}" for number in range(300)]
    ring = Ring(names, virtual_nodes=32)
    after = ring.without_member("m7")
    asked = [len(partners(ring, after, name, 3)) for name in after.members]
    assert sum(asked) / len(asked) < 4
    assert sum(not each for each in asked) > 100
