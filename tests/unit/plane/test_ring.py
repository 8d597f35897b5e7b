"""The ring: who owns a key, and how little moves when gateways come and go."""

from collections import Counter

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.errors import UnreachableError
from appliance.plane.ring import RING_BITS, Ring, position

names = st.from_regex(r"[a-z0-9][a-z0-9-]{0,9}", fullmatch=True)
members = st.sets(names, min_size=1, max_size=12)
keys = st.text(min_size=1, max_size=40)


@given(members, keys, st.integers(1, 20))
def test_successors_are_distinct_and_start_with_the_owner(fleet: set[str], key: str, n: int) -> None:
    """The n successors are different members, as many as there are, the owner first."""
    ring = Ring(fleet, virtual_nodes=8)
    found = ring.successors(key, n)
    assert len(found) == len(set(found)) == min(n, len(fleet))
    assert set(found) <= fleet
    assert found[0] == ring.owner(key)
    assert ring.successors(key, n + 1)[:n] == found


@given(members, names, keys)
def test_a_joiner_takes_keys_only_to_itself(fleet: set[str], joiner: str, key: str) -> None:
    """When a gateway joins, a key stays where it was or moves to the joiner; leaving is the reverse."""
    before, after = Ring(fleet - {joiner}, virtual_nodes=8), Ring(fleet | {joiner}, virtual_nodes=8)
    if before.members:
        assert after.owner(key) in (before.owner(key), joiner)
    assert before.with_member(joiner) == after


@given(members, keys)
def test_the_next_owner_is_the_next_successor(fleet: set[str], key: str) -> None:
    """When the owner leaves, the second successor owns the key: replicas are where takeover looks."""
    ring = Ring(fleet, virtual_nodes=8)
    owner, *rest = ring.successors(key, 3)
    if rest:
        assert Ring(fleet - {owner}, virtual_nodes=8).successors(key, len(rest)) == tuple(rest)


@given(members, keys)
def test_every_gateway_computes_the_same(fleet: set[str], key: str) -> None:
    """The order in which members became known makes no difference."""
    one, other = Ring(sorted(fleet), virtual_nodes=8), Ring(sorted(fleet, reverse=True), virtual_nodes=8)
    assert one == other
    assert hash(one) == hash(other)
    assert one.successors(key, 3) == other.successors(key, 3)


def test_shares_are_balanced() -> None:
    """With 32 points each, eight gateways hold between half and twice their fair share of the keys."""
    ring = Ring([f"gw{n}" for n in range(8)], virtual_nodes=32)
    shares = Counter(ring.owner(f"task/{n}") for n in range(8000))
    assert len(shares) == 8
    assert min(shares.values()) > 500
    assert max(shares.values()) < 2000


def test_about_a_share_of_the_keys_moves() -> None:
    """A ninth gateway takes about a ninth of the keys, and no key moves between the others."""
    before = Ring([f"gw{n}" for n in range(8)], virtual_nodes=32)
    after = before.with_member("gw8")
    moved = [key for key in (f"task/{n}" for n in range(9000)) if before.owner(key) != after.owner(key)]
    assert 500 < len(moved) < 2000
    assert all(after.owner(key) == "gw8" for key in moved)


def test_positions_lie_on_the_ring() -> None:
    """A position is the SHA-1 of the text, a number of 160 bits."""
    assert position("") == 0xDA39A3EE5E6B4B0D3255BFEF95601890AFD80709
    assert 0 <= Ring(["a"], virtual_nodes=1).position("key") < 2**RING_BITS


def test_a_point_owns_its_own_position() -> None:
    """A key that lies exactly on a gateway's point belongs to that gateway (Chord's successor)."""
    ring = Ring([f"gw{n}" for n in range(5)], virtual_nodes=4)
    assert ring.owner("gw3#2") == "gw3"


def test_an_empty_ring_says_so() -> None:
    """Asking a ring without gateways is an error with a remedy."""
    with pytest.raises(UnreachableError, match="no gateway"):
        Ring([], virtual_nodes=8).owner("key")


@settings(deadline=None)
@given(members, members, st.integers(1, 8))
def test_a_changed_ring_is_the_same_as_one_made_anew(before: set[str], after: set[str], points: int) -> None:
    """However many come and go, the points and whose they are do not depend on what the ring was made from."""
    changed = Ring(before, virtual_nodes=points).changed_to(frozenset(after))
    made = Ring(after, virtual_nodes=points)
    assert (changed.members, changed.points, changed.names) == (made.members, made.points, made.names)
