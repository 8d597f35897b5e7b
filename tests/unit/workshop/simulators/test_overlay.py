"""Which keys move: exactly those whose holders change, each stretch once, and about K/N of them."""

from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.plane.ring import RING_SIZE, Ring, position
from workshop.simulators.overlay import Stretch, moves, partners, stretches

names = st.from_regex(r"[a-z][a-z0-9]{0,5}", fullmatch=True)
rings = st.sets(names, min_size=1, max_size=12).map(lambda members: Ring(members, virtual_nodes=3))
keys = st.lists(st.text(min_size=1, max_size=10), min_size=1, max_size=20)


@given(rings, rings, keys)
def test_stretches_partition_the_ring(one: Ring, other: Ring, some: list[str]) -> None:
    """Every key lies in exactly one stretch, their sizes add up to the ring, and in each the holders are the same."""
    found = list(stretches(one, other))
    assert sum(each.size for each in found) == RING_SIZE
    for key in some:
        holding = [each for each in found if position(key) in each]
        assert len(holding) == 1
        for ring in (one, other):
            assert ring.holders(holding[0].upto, 3) == ring.successors(key, 3)


@settings(max_examples=60, deadline=None)
@given(rings, rings, keys, st.integers(1, 4))
def test_what_moves_is_what_changes(before: Ring, after: Ring, some: list[str], replicas: int) -> None:
    """A key is copied to a member if and only if that holds it now and did not; likewise dropped."""
    copied, dropped = moves(before, after, replicas=replicas)
    for key in some:
        old, new = before.successors(key, replicas), after.successors(key, replicas)
        to = [move for move in copied if position(key) in move.stretch]
        assert sorted(move.to for move in to) == sorted(set(new) - set(old))
        assert all(set(move.sources) == set(old) & after.members for move in to)
        assert [move.to for move in to if move.owner] == [new[0]] * (new[0] not in old)
        by = [drop.by for drop in dropped if position(key) in drop.stretch]
        assert sorted(by) == sorted((set(old) & after.members) - set(new))


@settings(max_examples=60, deadline=None)
@given(rings, names, st.integers(1, 4))
def test_a_join_moves_keys_to_the_joiner_only(ring: Ring, joiner: str, replicas: int) -> None:
    """A joiner takes stretches from neighbours and nobody else gains one; leaving gives back the same stretches."""
    ring = ring.without_member(joiner)
    if not ring.members:
        return
    copied, dropped = moves(ring, ring.with_member(joiner), replicas=replicas)
    assert {move.to for move in copied} <= {joiner}
    back, gone = moves(ring.with_member(joiner), ring, replicas=replicas)
    assert sorted((drop.by, drop.stretch) for drop in dropped) == sorted((move.to, move.stretch) for move in back)
    assert not gone


@given(rings, st.integers(1, 4))
def test_nothing_moves_when_nothing_changes(ring: Ring, replicas: int) -> None:
    """The same ring has nothing to move, and only those that hold keys together are partners."""
    assert moves(ring, ring, replicas=replicas) == ([], [])
    for name in ring.members:
        found = partners(ring, name, replicas=replicas)
        assert name not in found
        assert all(name in partners(ring, each, replicas=replicas) for each in found)


def test_a_share_of_the_keys_moves() -> None:
    """The 101st gateway takes r/101 of the copies of all keys, give or take half."""
    ring = Ring([f"gw-{n}" for n in range(100)], virtual_nodes=32)
    copied, dropped = moves(ring, ring.with_member("gw-100"), replicas=3)
    share = sum(move.stretch.size for move in copied) / RING_SIZE
    assert 0.5 * 3 / 101 < share < 1.5 * 3 / 101
    assert abs(sum(drop.stretch.size for drop in dropped) / RING_SIZE - share) < 1e-9


def test_a_stretch_may_be_the_whole_ring() -> None:
    """The only point of a ring owns all of it."""
    assert Stretch(5, 5).size == RING_SIZE
    assert 4 in Stretch(5, 5)
    assert 5 in Stretch(4, 5)
    assert 4 not in Stretch(4, 5)
    assert 0 in Stretch(RING_SIZE - 1, 3)
