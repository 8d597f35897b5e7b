"""Upkeep: from joins alone the neighbours come out right, failures heal, and rest is quiet."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.plane.overlay import Around, Meet, MeetAsk, Pace, Seek, Upkeep, View, bound_for, successor_count
from appliance.plane.ring import Ring
from workshop.bench.dht.simulation import Fleet


def check_neighbours(fleet: Fleet) -> None:
    """Every gateway's nearest neighbours are those of the true ring."""
    line = fleet.ring.names
    for place, name in enumerate(line):
        view = fleet.members[name].view
        after = [line[(place + step) % len(line)] for step in range(1, min(4, len(line) - 1) + 1)]
        before = [line[place - step] for step in range(1, min(view.before_count, len(line) - 1) + 1)]
        assert view.after()[: len(after)] == after, name
        assert list(reversed(view.before()))[: len(before)] == before, name


def check_closed(fleet: Fleet) -> None:
    """Where a view says that it knows everybody, it does."""
    line = fleet.ring.names
    for name, upkeep in fleet.members.items():
        place = line.index(name)
        after = upkeep.view.after()
        assert after == [line[(place + step) % len(line)] for step in range(1, len(after) + 1)]


@settings(max_examples=8, deadline=None)
@given(st.integers(1, 30), st.sampled_from([8, 12, 64]), st.integers(0, 10**6))
def test_joins_alone_make_a_ring(size: int, bound: int, seed: int) -> None:
    """Gateways that join one after the other, each through any other, know their neighbours after a few rounds."""
    fleet = Fleet(bound=bound, seed=seed)
    for number in range(size):
        fleet.join(f"gw-{number}")
        fleet.rounds(1)
    fleet.rounds(12)
    check_neighbours(fleet)
    assert all(len(upkeep.view) <= bound for upkeep in fleet.members.values())


@pytest.mark.thorough
@settings(max_examples=6, deadline=None)
@given(st.integers(10, 60), st.floats(0, 0.4), st.integers(0, 10**6))
def test_failures_heal(size: int, share: float, seed: int) -> None:
    """After many gateways died at once the survivors' neighbours are right again, and lookups end at the owner."""
    fleet = Fleet(bound=24, seed=seed).settled(f"gw-{n}" for n in range(size))
    for name in fleet.rng.sample(sorted(fleet.members), int(share * size)):
        del fleet.members[name]
    # Whom to meet is drawn by lot: mostly whole after 30 rounds, of 150 fleets the last after 45, once seen after 50.
    fleet.rounds(100)
    check_neighbours(fleet)
    check_closed(fleet)
    for _ in range(20):
        target = fleet.rng.getrandbits(160)
        found = fleet.lookup(target, fleet.members[fleet.any()].view).result
        assert found is not None
        assert found.owner == fleet.ring.holders(target, 1)[0]


def test_coming_and_going_at_once() -> None:
    """While gateways join, leave and die all the time, the ring stays one, and settles once they stop."""
    fleet = Fleet(bound=bound_for(60), seed=3).settled(f"gw-{n}" for n in range(60))
    for number in range(60):
        fleet.join(f"new-{number}")
        gone = fleet.rng.choice(sorted(fleet.members))
        if number % 2:
            fleet.leave(gone)
        else:
            del fleet.members[gone]
        fleet.rounds(1)
    fleet.rounds(30)
    check_neighbours(fleet)
    check_closed(fleet)


def test_who_leaves_is_forgotten_at_once() -> None:
    """A gateway that says it goes is no neighbour any more, and hearsay does not bring it back."""
    fleet = Fleet(bound=24).settled(f"gw-{n}" for n in range(50))
    gone = "gw-7"
    near = fleet.members[gone].leaving()[1]
    fleet.leave(gone)
    assert near
    for name in near:
        upkeep = fleet.members[name]
        assert gone not in upkeep.view
        upkeep.met(near[0] if name != near[0] else near[1], Around(after=(gone,), others=(gone,)), fleet.now)
        assert gone not in upkeep.view
        upkeep.asked(MeetAsk(gone), fleet.now)  # it is back itself
        assert gone in upkeep.view


def test_rest_is_quiet_and_trouble_is_not() -> None:
    """While nothing changes rounds come at their slowest; a member found gone brings the next sooner."""
    fleet = Fleet(bound=24).settled(f"gw-{n}" for n in range(50))
    for _ in range(120):
        fleet.rounds(1)
    intervals = [upkeep.interval_s for upkeep in fleet.members.values()]
    assert min(intervals) == Pace().most_s
    name, upkeep = next(iter(fleet.members.items()))
    upkeep.unreachable(upkeep.view.names[3], fleet.now)
    assert fleet.members[name].interval_s == Pace().most_s * Pace().faster


def test_fingers_are_looked_up_in_turn() -> None:
    """In as many look-ups as there are fingers each has had its own; not all members begin with the same one."""
    fleet = Fleet(bound=24).settled(f"gw-{n}" for n in range(200))
    first: set[int] = set()
    for upkeep in fleet.members.values():
        targets = upkeep.view.targets()
        rounds = [upkeep.due(float(number)) for number in range(4 * len(targets))]
        sought = [each.target for each in rounds if isinstance(each, Seek)]
        assert sorted(sought) == sorted(targets)
        first.add(targets.index(sought[0]))
    assert len(first) > 1


@given(st.integers(1, 10**6), st.integers(1, 200))
def test_the_successor_list_grows_with_the_logarithm(size: int, bound: int) -> None:
    """It never shrinks as the ring grows, is 20 for 1,000 members, and leaves half the view to others."""
    assert 1 <= successor_count(size, bound) <= successor_count(2 * size, bound) <= max(1, bound // 2)
    assert successor_count(1000, 64) == 20


@pytest.mark.parametrize("size", [30, 300])
def test_the_size_of_the_ring_is_guessed(size: int) -> None:
    """From the density of its neighbours a gateway tells the size of the ring to a factor of three."""
    fleet = Fleet(bound=16).settled(f"gw-{n}" for n in range(size))
    guesses = sorted(upkeep.view.estimate() for upkeep in fleet.members.values())
    assert size / 3 < guesses[len(guesses) // 10] <= guesses[-len(guesses) // 10] < size * 3


def test_a_single_gateway_owns_everything() -> None:
    """The first gateway of a fleet knows the ring whole, has nobody to meet, and every position is its own."""
    upkeep = Upkeep(View.alone("gw-1", bound=16), rng=Fleet(bound=16).rng, now=0.0)
    assert upkeep.due(1.0) is None
    assert upkeep.view.step(123).mine
    assert upkeep.view.estimate() == 1


def test_views_stay_bounded() -> None:
    """However many members a view hears of, it keeps as many as its bound, its neighbours first."""
    names = [f"gw-{n}" for n in range(500)]
    ring = Ring([*names, "me"], virtual_nodes=1)
    view = View("me", bound=20)
    place = ring.names.index("me")
    view.merge("me", Around(after=ring.names[place + 1 : place + 30]))
    view.hear(names)
    view.trim(Fleet(bound=20).rng)
    assert len(view) == 20
    assert view.names[0] == ring.names[(place + 1) % 501]


def test_members_that_leave_each_other_out_are_not_met_in_circles() -> None:
    """Two members that are there but of which neither lists the other do not keep a third busy for ever."""
    fleet = Fleet(bound=24).settled(f"gw-{n}" for n in range(50))
    upkeep = fleet.members["gw-1"]
    one, other = upkeep.view.names[1:3]
    now, rounds = 100.0, 0
    while now < 160.0:
        match upkeep.due(now):
            case Meet(member) if member in (one, other):
                beyond = upkeep.view.names[3]
                upkeep.met(member, Around(before=("gw-1",), after=(beyond,)), now)
            case Meet(member):
                upkeep.met(member, fleet.members[member].asked(MeetAsk("gw-1"), now), now)
            case _:
                upkeep.found((), now)
        now = max(now, upkeep.next_at)
        rounds += 1
    assert {one, other} <= set(upkeep.view.names)
    assert rounds < 60


def test_two_halves_that_lost_each_other_grow_together() -> None:
    """After a cut both halves are rings of their own; once linked again they become one, though nobody tells them."""
    fleet = Fleet(bound=24, seed=5).settled(f"gw-{n}" for n in range(40))
    halves = [{f"gw-{n}" for n in range(start, 40, 2)} for start in (0, 1)]
    for half, other in (halves, reversed(halves)):
        for name in sorted(half):
            for gone in sorted(other):
                fleet.members[name].unreachable(gone, fleet.now)
    everybody = dict(fleet.members)
    for half in halves:
        fleet.members = {name: everybody[name] for name in half}
        fleet.rounds(20)
        check_neighbours(fleet)
    fleet.members = everybody
    fleet.rounds(200)
    check_neighbours(fleet)
    check_closed(fleet)


@pytest.mark.parametrize("size", [4, 60])
def test_two_rings_that_never_heard_of_each_other_become_one(size: int) -> None:
    """Each second one of all meets somebody it does not know, as it finds by tokens; the rest is gossip."""
    fleet = Fleet(bound=bound_for(size), seed=2)
    names = [f"gw-{number}" for number in range(size)]
    fleet.settled(names[::2]).settled(names[1::2])
    for _ in range(100):
        fleet.rounds(1)
        name = fleet.any()
        strangers = sorted(set(names) - {name, *fleet.members[name].view.names})
        if strangers:
            stranger = fleet.rng.choice(strangers)
            told = fleet.members[stranger].asked(MeetAsk(name), fleet.now)
            fleet.members[name].met(stranger, told, fleet.now)
    check_neighbours(fleet)
    check_closed(fleet)


def test_who_is_late_once_is_not_gone() -> None:
    """A member is dropped for questions that it left unanswered in a row, not for one; an answer in between counts."""
    fleet = Fleet(bound=16, seed=3).settled(f"gw-{n}" for n in range(12))
    upkeep = fleet.members[fleet.any()]
    member = upkeep.view.names[2]
    interval_s = upkeep.interval_s
    for _ in range(5):
        upkeep.late(member, fleet.now)
        upkeep.late(member, fleet.now, in_round=False)
        assert member in upkeep.view
        upkeep.met(member, fleet.members[member].asked(MeetAsk(upkeep.view.me), fleet.now), fleet.now)
    assert upkeep.interval_s >= interval_s
    for _ in range(3):
        assert member in upkeep.view
        upkeep.late(member, fleet.now)
    assert member not in upkeep.view
    upkeep.late("nobody", fleet.now)
    assert "nobody" not in upkeep.view


def test_who_is_doubted_is_met_next() -> None:
    """A member that shows no token is met in the next round, which comes at once; one that is not known is not."""
    fleet = Fleet(bound=16, seed=5).settled(f"gw-{n}" for n in range(12))
    upkeep = fleet.members[fleet.any()]
    upkeep.settle(fleet.now)
    upkeep.next_at = fleet.now + 10.0
    member = upkeep.view.names[4]
    upkeep.doubt("nobody", fleet.now)
    assert upkeep.next_at == fleet.now + 10.0
    upkeep.doubt(member, fleet.now)
    upkeep.doubt(member, fleet.now)
    assert upkeep.next_at <= fleet.now + 0.2
    assert upkeep.due(fleet.now) == Meet(member)
    assert upkeep.due(fleet.now) != Meet(member)


def test_rounds_that_take_long_come_seldom() -> None:
    """Where a round takes half a second the next comes after two at the soonest, and never later than it may."""
    fleet = Fleet(bound=16, seed=4).settled(f"gw-{n}" for n in range(12))
    upkeep = fleet.members[fleet.any()]
    upkeep.unreachable(upkeep.view.names[1], 100.0)
    for _ in range(20):
        upkeep._changed(True)
    upkeep.due(100.0)
    assert upkeep.next_at < 101.0
    upkeep.took(0.001, 100.0)
    assert upkeep.next_at < 101.0
    upkeep.took(0.5, 100.5)
    assert upkeep.next_at == 102.5
    upkeep.took(60.0, 160.0)
    assert upkeep.next_at == 170.0
