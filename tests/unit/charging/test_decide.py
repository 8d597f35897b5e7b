"""Which robots go to charge: those with least charge first, no more than a charger takes, and none that is busy."""

from collections import Counter

from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.charging.decide import Seen, Trip, decide
from appliance.model import Place, Pose, RobotInfo
from appliance.tasks.settings import BatteryConfig

BATTERY = BatteryConfig(reserve_percent=20.0, charged_percent=80.0, auto_charge=True)
CHARGERS = {"charger 1": (Place(x=0.0, y=0.0), 1), "charger 2": (Place(x=50.0, y=0.0), 2)}
YARD = {"yard": Place(x=10.0, y=10.0), "gate": Place(x=60.0, y=0.0)}


def rover(name: str, percent: float | None, *, x: float = 5.0) -> RobotInfo:
    """Return a robot on the ground."""
    return RobotInfo(id=name, kind="zenoh", verbs=("goto",), pose=Pose(x=x), battery_percent=percent)


def sent(*robots: Seen, chargers: dict[str, tuple[Place, int]] | None = None) -> list[tuple[str, str]]:
    """Return who is sent where."""
    trips = decide(robots, chargers=CHARGERS if chargers is None else chargers, others=YARD, battery=BATTERY)
    return [(each.robot, each.place) for each in trips]


def test_the_emptiest_goes_to_the_nearest_free_charger() -> None:
    """Each to the nearest that is left; one with enough charge stays."""
    robots = [Seen(info=rover(name, percent)) for name, percent in (("a", 15.0), ("b", 5.0), ("c", 25.0))]
    assert sent(*robots) == [("b", "charger 1"), ("a", "charger 2")]


def test_who_may_not_be_moved_is_not_sent() -> None:
    """One that is busy or stopped, flies, tells no charge or place, cannot go, charges, or is on its way already."""
    low = Seen(info=rover("a", 5.0))
    assert sent(low) == [("a", "charger 1")]
    assert sent(replace(low, idle=False)) == []
    assert sent(replace(low, at="charger 1")) == []
    assert sent(replace(low, bound_for="charger 2")) == []
    for change in ({"flies": True}, {"battery_percent": None}, {"pose": None}, {"verbs": ()}):
        assert sent(Seen(info=replace(low.info, **change))) == []
    assert sent(low, chargers={}) == []


def test_one_that_has_charged_makes_room_for_one_that_waits() -> None:
    """It goes to the nearest place; one that still charges stays, and all stay when nobody waits."""
    one = {"charger 1": CHARGERS["charger 1"]}
    low, full = Seen(info=rover("a", 5.0)), Seen(info=rover("b", 80.0, x=0.0), at="charger 1")
    assert sent(low, full, chargers=one) == [("b", "yard")]
    assert sent(full, chargers=one) == []
    assert sent(low, replace(full, info=rover("b", 79.0, x=0.0)), chargers=one) == []
    assert sent(low, replace(full, idle=False), chargers=one) == []
    trips = decide([low, full], chargers=one, others=YARD, battery=BATTERY)
    assert trips == [
        Trip(robot="b", place="yard", why="has 80 % of its battery, and another waits for charger 1", charges=False)
    ]


SEEN = st.builds(
    Seen,
    info=st.builds(
        rover,
        st.sampled_from([f"r{number}" for number in range(8)]),
        st.none() | st.floats(0, 100),
        x=st.floats(-99, 99),
    ),
    idle=st.booleans(),
    at=st.sampled_from(["", "", *CHARGERS]),
    bound_for=st.sampled_from(["", "", *CHARGERS]),
)


@given(st.lists(SEEN, max_size=8, unique_by=lambda each: each.info.id), st.permutations(range(8)))
def test_no_charger_is_given_to_more_than_it_takes(robots: list[Seen], order: list[int]) -> None:
    """Over any fleet, in any order of it: only idle robots move, each once, and nobody waits beside a free charger."""
    trips = decide(robots, chargers=CHARGERS, others=YARD, battery=BATTERY)
    mixed = [robots[number] for number in order if number < len(robots)]
    assert decide(mixed, chargers=CHARGERS, others=YARD, battery=BATTERY) == trips
    known = {each.info.id: each for each in robots}
    assert all(known[each.robot].idle for each in trips)
    assert len({each.robot for each in trips}) == len(trips)
    before = Counter(place for each in robots for place in {each.at, each.bound_for} - {""})
    given_now = Counter(each.place for each in trips if each.charges)
    assert all(before[name] + count <= CHARGERS[name][1] for name, count in given_now.items())
    left = [
        each for each in robots
        if each.idle and not each.at and not each.bound_for
        and each.info.battery_percent is not None and each.info.battery_percent < BATTERY.reserve_percent
        and each.info.id not in {trip.robot for trip in trips}
    ]  # fmt: skip
    if left:
        assert all(before[name] + given_now[name] >= takes for name, (_, takes) in CHARGERS.items())
    away = [each for each in trips if not each.charges]
    assert len(away) <= len(left)
    assert all((known[each.robot].info.battery_percent or 0.0) >= BATTERY.charged_percent for each in away)
