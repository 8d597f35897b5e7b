"""Soft stops as a set: whatever order gateways hear of things in, they agree, and none is lost that nobody lifted."""

from hypothesis import given
from hypothesis import strategies as st

from appliance.model import Lifted, SoftStop
from appliance.robots.authority.soft_stop import MOST, MOST_OPERATORS, RESERVE, Stops

ROBOTS = ("r1", "r2", "r3")
some = st.sets(st.sampled_from(ROBOTS), max_size=2).map(lambda found: tuple(sorted(found)))
stops = st.builds(SoftStop, id=st.sampled_from([f"s{number}" for number in range(6)]), robots=some)
lifts = st.builds(
    Lifted,
    id=st.sampled_from([f"l{number}" for number in range(6)]),
    stops=st.lists(st.sampled_from([f"s{number}" for number in range(6)]), max_size=3).map(tuple),
    robots=some,
)


def unique(found: list[SoftStop | Lifted]) -> list[SoftStop | Lifted]:
    """One of each id, as ids are drawn at random in life."""
    return list({each.id: each for each in found}.values())


def filled(facts: list[SoftStop | Lifted]) -> Stops:
    """What a gateway knows that has heard these, in this order."""
    it = Stops()
    for each in facts:
        it.add(each) if isinstance(each, SoftStop) else it.lift(each)
    return it


def seen(it: Stops) -> list[tuple[str, bool]]:
    """Which robots are stopped, one that nobody named among them."""
    return [(robot, it.of(robot) is not None) for robot in (*ROBOTS, "new")]


@given(st.lists(st.one_of(stops, lifts), max_size=10).map(unique), st.randoms())
def test_the_order_does_not_matter(facts: list[SoftStop | Lifted], chance: object) -> None:
    """Two gateways that have heard the same, each in an order of its own and some of it twice, see the same."""
    other = list(facts)
    chance.shuffle(other)  # type: ignore[attr-defined]
    one, two = filled(facts), filled([*other, *facts])
    assert seen(one) == seen(two)
    assert (one.stops, one.lifted, one.active) == (two.stops, two.lifted, two.active)


@given(
    st.lists(st.one_of(stops, lifts), max_size=8).map(unique),
    st.lists(st.one_of(stops, lifts), max_size=8).map(unique),
)
def test_merging_is_what_both_know(one: list[SoftStop | Lifted], two: list[SoftStop | Lifted]) -> None:
    """Merged either way it is the same, and merging once more changes nothing."""
    known = {each.id: each for each in one}
    two = [known.get(each.id, each) for each in two]
    left, right = filled(one), filled(two)
    left.merge(right.stops, right.lifted)
    right.merge(left.stops, left.lifted)
    assert seen(left) == seen(right)
    assert not left.merge(right.stops, right.lifted)


@given(st.lists(stops, min_size=1, max_size=6).map(unique), some)
def test_only_what_was_seen_is_lifted(facts: list[SoftStop], robots: tuple[str, ...]) -> None:
    """A lifting frees the robots it names of every stop known where it was given; one given elsewhere holds on."""
    *known, unseen = facts
    here = filled(list(known))
    here.lift(Lifted(id="l", stops=here.to_lift(robots), robots=robots))
    assert all(here.of(robot) is None for robot in (robots or (*ROBOTS, "new")))
    here.add(unseen)
    for robot in unseen.robots or ("new",):
        assert here.of(robot) is not None


@given(st.lists(stops, max_size=6).map(unique), st.sampled_from(ROBOTS))
def test_a_stop_ends_for_a_task_when_none_of_its_robots_is_held(facts: list[SoftStop], robot: str) -> None:
    """`ended` is true of a stop that is known and lifted for them, and never of one that was not heard of."""
    it = filled(list(facts))
    for each in facts:
        assert it.ended(each.id, [robot]) is not it.holds(each, robot)
    assert not it.ended("never heard of", [robot])
    it.lift(Lifted(id="l", stops=tuple(each.id for each in facts)))
    assert all(it.ended(each.id, [robot]) for each in facts)


def test_a_stop_of_the_fleet_holds_robots_that_come_later_and_one_may_be_freed() -> None:
    """Freed of it is the one that was named; the others and newcomers stay stopped."""
    it = filled([SoftStop(id="s", by="ann")])
    assert it.of("never seen") is not None
    it.lift(Lifted(id="l", stops=("s",), robots=("r1",)))
    assert it.of("r1") is None
    assert it.of("r2") is not None


def test_what_is_remembered_is_bounded_and_nothing_in_force_is_forgotten() -> None:
    """Liftings and lifted stops go first; a stop in force stays."""
    it = Stops()
    it.add(SoftStop(id="kept", robots=("r1",)))
    for number in range(MOST + 50):
        it.add(SoftStop(id=f"s{number}", robots=("r2",)))
        it.lift(Lifted(id=f"l{number}", stops=(f"s{number}",)))
        it.forget()
    assert len(it.stops) <= MOST
    assert len(it.lifted) <= MOST
    assert it.of("r1") is not None
    assert it.of("r2") is None


def test_there_is_room_for_another_stop_however_many_were_lifted() -> None:
    """What was lifted makes room for it, for robots and for the fleet, and what is in force stays."""
    it = Stops()
    it.add(SoftStop(id="kept", robots=("r1",)))
    for number in range(2 * MOST):
        stop = SoftStop(id=f"s{number}", robots=("r2",) if number % 2 else ())
        assert it.room(stop), f"no room for stop {number}"
        it.add(stop)
        it.lift(Lifted(id=f"l{number}", stops=(stop.id,)))
        assert len(it.lifted) <= MOST
        assert len(it.stops) <= MOST
    assert [each.id for each in it.active] == ["kept"]


def test_the_fleet_can_be_stopped_however_many_robots_are() -> None:
    """As many stops of robots as are kept leave room for those of the whole fleet; none in force is forgotten."""
    it = Stops()
    number = 0
    while it.room(stop := SoftStop(id=f"s{number}", robots=(f"r{number}",))):
        it.add(stop)
        number += 1
    assert number == MOST - RESERVE
    fleet = SoftStop(id="fleet")
    assert it.room(fleet)
    it.add(fleet)
    assert it.whole == fleet
    assert len(it.active) == number + 1


def test_each_operator_has_room_for_one_more_stop_of_the_fleet() -> None:
    """Beyond what is kept one of each operator is, for a bounded number of them; none in force is forgotten."""
    it = Stops()
    for number in range(MOST):
        it.add(SoftStop(id=f"s{number}", by="ann"))
    assert not it.room(SoftStop(id="again", by="ann"))
    for number in range(MOST_OPERATORS):
        stop = SoftStop(id=f"o{number}", by=f"operator {number}")
        assert it.room(stop)
        it.add(stop)
        assert not it.room(SoftStop(id=f"p{number}", by=f"operator {number}"))
    assert not it.room(SoftStop(id="one more", by="one more"))
    assert len(it.active) == MOST + MOST_OPERATORS


@given(st.lists(st.one_of(stops, lifts), max_size=10).map(unique))
def test_a_stop_that_was_lifted_is_never_kept_without_its_lifting(facts: list[SoftStop | Lifted]) -> None:
    """What is forgotten of liftings takes their stops with it, so that a restart brings none back."""
    it = filled(facts)
    for number in range(MOST + 5):
        it.lift(Lifted(id=f"x{number}", stops=(f"y{number}",)))
    again = Stops()
    again.merge(it.stops, it.lifted)
    whole = {name for each in facts if isinstance(each, Lifted) and not each.robots for name in each.stops}
    assert not whole & {each.id for each in again.active}
