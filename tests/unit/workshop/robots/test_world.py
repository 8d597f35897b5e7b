"""The small world: reach, hands, and copies that end equal."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.model import Box, Device, Door, Person, Place, Pose, Site, SiteObject
from appliance.model.site import inside
from appliance.robots.verbs import RobotFailure
from workshop.robots.world import REACH_M, World, aim, answer

SITE = Site(
    places={
        "dock 3": Place(x=30.0, y=10.0, aliases=("bay 3",)),
        "table": Place(x=2.0, y=2.0),
    },
    obstacles=(Box(name="rack a", x=(29.0, 31.0), y=(10.5, 12.0)),),
    objects=(
        SiteObject(name="red box", colour="red", at="dock 3"),
        SiteObject(name="blue box", colour="blue", at="table"),
        SiteObject(name="green crate", colour="green", at="table"),
    ),
)
AT_DOCK, AT_TABLE = Pose(x=30.0, y=10.0), Pose(x=2.0, y=2.0)


def test_things_stand_beside_their_place_within_reach() -> None:
    """Things are in no obstacle, apart from each other, and within the arm's reach of where robots stop."""
    world = World(SITE)
    for thing, pose in zip(world.things, (AT_DOCK, AT_TABLE, AT_TABLE), strict=True):
        assert math.hypot(thing.x - pose.x, thing.y - pose.y) < REACH_M
        assert not inside(SITE.obstacles[0], thing.x, thing.y)
    _, blue, green = world.things
    assert math.hypot(blue.x - green.x, blue.y - green.y) > 0.5


def test_what_is_too_far_cannot_be_picked() -> None:
    """The refusal says how far it is and where to drive."""
    with pytest.raises(RobotFailure, match=r"red box is \d\d\.\d m away") as caught:
        World(SITE).check_pick("r", "red box", AT_TABLE)
    assert caught.value.failure.remedy == "drive to dock 3 first"


def test_pick_carry_place() -> None:
    """A picked thing moves with its robot and stands at the new place afterwards."""
    world = World(SITE)
    world.pick("r", world.check_pick("r", "The Red Box", AT_DOCK))
    held = world.held_by("r")
    assert held is not None
    world.carry("r", AT_TABLE)
    thing, x, y = world.check_place("r", "red box", "table", AT_TABLE)
    world.place("r", thing, x, y)
    assert world.held_by("r") is None
    assert world.find("red box", 0, 0) is not None
    assert math.hypot(x - 2.0, y - 2.0) < REACH_M


def test_one_hand_one_thing() -> None:
    """A second pick is refused, so is placing what is not held, and picking what another holds."""
    world = World(SITE)
    world.pick("r", world.check_pick("r", "blue box", AT_TABLE))
    with pytest.raises(RobotFailure, match="already holds the blue box"):
        world.check_pick("r", "green crate", AT_TABLE)
    with pytest.raises(RobotFailure, match="holds the blue box, not the green crate"):
        world.check_place("r", "green crate", "table", AT_TABLE)
    with pytest.raises(RobotFailure, match="held by r"):
        world.check_pick("other", "blue box", AT_TABLE)
    with pytest.raises(RobotFailure, match="holds nothing"):
        world.check_place("other", "blue box", "table", AT_TABLE)


@pytest.mark.parametrize(("at", "why"), [("dock 3", "drive to dock 3 first"), ("the moon", "places: dock 3, table")])
def test_where_nothing_can_be_put(at: str, why: str) -> None:
    """A place out of reach and one that does not exist are refused with the remedy."""
    world = World(SITE)
    world.pick("r", world.check_pick("r", "blue box", AT_TABLE))
    with pytest.raises(RobotFailure) as caught:
        world.check_place("r", "blue box", at, AT_TABLE)
    assert caught.value.failure.remedy == why


def test_unknown_things_and_loose_names() -> None:
    """An unknown thing is refused with what there is; "box" is the nearest box."""
    world = World(SITE)
    with pytest.raises(RobotFailure, match="there is no 'teapot'") as caught:
        world.check_pick("r", "teapot", AT_TABLE)
    assert "red box" in caught.value.failure.remedy
    assert world.check_pick("r", "box", AT_TABLE).name == "blue box"
    assert world.check_pick("r", "box", AT_DOCK).name == "red box"


@given(st.lists(st.tuples(st.sampled_from(["a", "b"]), st.sampled_from(["red box", "blue box"])), max_size=12))
def test_copies_that_hear_all_changes_in_any_order_end_equal(actions: list[tuple[str, str]]) -> None:
    """Two robots that act on their own copies and then exchange all changes see the same world."""
    worlds = {"a": World(SITE), "b": World(SITE)}
    changes = []
    for robot, name in actions:
        world = worlds[robot]
        thing = world.find(name, 0, 0)
        assert thing is not None
        changed = world.place(robot, thing, 1.0, 1.0) if thing.holder == robot else world.pick(robot, thing)
        changes.append(changed)
    for change in changes:
        worlds["a"].take_in(change)
    for change in reversed(changes):
        worlds["b"].take_in(change)
    assert worlds["a"].things == worlds["b"].things


LIVELY = Site(
    places={"hall": Place(x=0.0, y=0.0), "office": Place(x=20.0, y=0.0)},
    objects=(SiteObject(name="red box", colour="red", at="hall"),),
    doors=(Door(name="office door", x=(10.0, 10.2), y=(-1.0, 1.0)),),
    devices=(Device(name="hall light", at="hall"),),
    people=(
        Person(name="Ann", at="hall", answers={"": "I am busy", "key": "on the shelf", "red key": "with Bob"}),
        Person(name="Bob", at="office"),
    ),
)
IN_HALL, AT_DOOR = Pose(x=0.0, y=0.0), Pose(x=9.0, y=0.0)


def test_a_shut_door_is_in_the_way_until_somebody_opens_it() -> None:
    """It is turned from within reach, from both sides; other copies follow; it cannot be picked."""
    world, other = World(LIVELY), World(LIVELY)
    assert [box.name for box in world.shut] == ["the shut office door"]
    with pytest.raises(RobotFailure, match=r"office door is 10\.0 m away"):
        world.check_switch("office door", IN_HALL, states=("open", "closed"))
    for pose in (AT_DOOR, Pose(x=11.0, y=0.0)):
        assert world.check_switch("the door", pose, states=("open", "closed")).name == "office door"
    assert other.take_in(world.switch("r", world.check_switch("door", AT_DOOR, states=("open", "closed")), "open"))
    assert world.shut == other.shut == ()
    with pytest.raises(RobotFailure, match="to be picked"):
        world.check_pick("r", "office door", AT_DOOR)


def test_devices_are_switched_and_doors_are_not() -> None:
    """A light has another pair of states than a door: the wrong order names what there is."""
    world = World(LIVELY)
    light = world.check_switch("light", IN_HALL, states=("on", "off"))
    assert world.switch("r", light, "on").state == "on"
    with pytest.raises(RobotFailure, match="no 'office door' here for that") as caught:
        world.check_switch("office door", AT_DOOR, states=("on", "off"))
    assert caught.value.failure.remedy == "there are: hall light"


def test_people_near_enough_are_found_and_answer() -> None:
    """The nearest, or the one named; too far and unknown people are named; the fullest match of a question counts."""
    world = World(LIVELY)
    ann = world.person("", IN_HALL)
    assert ann.name == "Ann"
    assert answer(ann, "Where is the key?") == "on the shelf"
    assert answer(ann, "Where is the RED key, please?") == "with Bob"
    assert answer(ann, "What time is it?") == "I am busy"
    assert answer(world.person("bob", Pose(x=18.0, y=0.0)), "Well?") == ""
    with pytest.raises(RobotFailure, match=r"Bob is 20\.0 m away"):
        world.person("Bob", IN_HALL)
    with pytest.raises(RobotFailure, match="no 'Cleo' about"):
        world.person("Cleo", IN_HALL)


def test_giving_needs_the_thing_and_the_person() -> None:
    """What is given is the person's, and cannot be picked any more."""
    world = World(LIVELY)
    with pytest.raises(RobotFailure, match="holds nothing"):
        world.check_give("r", "red box", "Ann", IN_HALL)
    world.pick("r", world.check_pick("r", "red box", IN_HALL))
    world.give("r", *world.check_give("r", "red box", "Ann", IN_HALL))
    assert world.held_by("r") is None
    with pytest.raises(RobotFailure, match="held by Ann"):
        world.check_pick("r", "red box", IN_HALL)


def test_where_the_camera_looks() -> None:
    """Things and obstacles are looked at; at a place, what stands there; unknown targets straight ahead."""
    world = World(SITE)
    assert aim(world, "red box", AT_TABLE, 1.0).bearing_deg == pytest.approx(74, abs=3)
    assert aim(world, "rack a", AT_TABLE, 1.0).known
    there = aim(world, "bay 3", AT_DOCK, 1.0)
    assert there.known
    assert there.elevation_deg < -20
    assert aim(world, "nonsense", Pose(heading_deg=33.0), 1.0) == aim(world, "", Pose(heading_deg=33.0), 1.0)
    assert not aim(world, "nonsense", AT_TABLE, 1.0).known
