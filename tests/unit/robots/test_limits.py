"""What an order may ask of a robot, before it is sent: limits that it registered, of the configuration, of the site."""

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import PayloadError, RefusedError, SwiftbotError
from appliance.model import Box, Pose, RobotCommand, RobotInfo, RobotLimits, Site
from appliance.robots.limits import CHOSEN, Bounds, Orders, Usual

SITE = Site(
    fence=Box(name="the yard", x=(0.0, 40.0), y=(0.0, 30.0)),
    forbidden=(Box(name="the pit", x=(18.0, 22.0), y=(8.0, 12.0)),),
    obstacles=(Box(name="rack", x=(5.0, 15.0), y=(20.0, 24.0)),),
    altitude_limit_m=30.0,
    speed_limit_mps=6.0,
)


def orders(*robots: RobotInfo, **configured: float) -> Orders:
    """Return what holds orders to these robots."""
    return Orders(
        SITE,
        roster=lambda: {each.id: each for each in robots},
        configured=lambda robot: Bounds(whose=f"the limits of {robot} in [safety]", **configured),
        vehicles=lambda flies: Usual(speed_mps=5.0 if flies else 2.0, takeoff_m=10.0),
    )


def rover(**changes: Any) -> RobotInfo:
    """Return a robot that speaks Zenoh itself."""
    usual = {"id": "rover_1", "kind": "zenoh", "pose": Pose(x=2.0, y=10.0)}
    return RobotInfo(**(usual | changes))


def drone(**changes: Any) -> RobotInfo:
    """Return a vehicle that a gateway commands."""
    usual = {"id": "drone_1", "kind": "mavlink", "gateway": "gw-1", "flies": True, "pose": Pose(x=2.0, y=10.0)}
    return RobotInfo(**(usual | changes))


def order(verb: str, **args: Any) -> RobotCommand:
    """Return an order."""
    return RobotCommand(id="1", verb=verb, args=args)


def goto(*points: tuple[float, ...], **args: Any) -> RobotCommand:
    """Return an order to go through points."""
    waypoints = [dict(zip("xyz", each, strict=False)) for each in points]
    return order("goto", waypoints=waypoints, **args)


SLOW = RobotLimits(speed_mps=1.5, range_m=50.0)


@pytest.mark.parametrize(
    ("command", "why"),
    [
        (goto((10, 10), speed_mps=2.0), r"2 m/s is above 1.5 m/s, by the limits that rover_1 registered"),
        (order("velocity", forward_mps=1.2, left_mps=1.2), "above 1.5 m/s"),
        (goto((10, 2), (38, 2), (10, 2)), "longer than 50 m, by the limits that rover_1 registered"),
        (goto((50, 10)), r"waypoint 1 at \(50, 10\) is outside the yard"),
        (goto((30, 10)), "the leg to waypoint 1 goes through the pit"),
        (goto((2, 28), (18, 22)), "the leg to waypoint 2 goes through rack"),
        (goto((20, 10)), "waypoint 1 is in the pit"),
        (goto((10, 10, 31)), "the site allows 30 m"),
        (
            order("mission", steps=[{"x": 10, "y": 10}, {"x": 30, "y": 10}]),
            "the leg to waypoint 2 goes through the pit",
        ),
        (order("orbit", x=24, y=10, radius_m=3), "goes through the pit"),
        (order("orbit", x=15, y=10, radius_m=5), "the circle goes through the pit"),
        (order("orbit", x=3, y=10, radius_m=5), "outside the yard"),
        (goto((10, 10), speed_mps=-1.0), "gets nowhere"),
        (goto((math.nan, 10)), "longer than 50 m"),
    ],
)
def test_what_is_not_sent_to_a_robot_that_speaks_for_itself(command: RobotCommand, why: str) -> None:
    """Each is refused with the reason, and whose limit it is."""
    with pytest.raises(SwiftbotError, match=why) as caught:
        orders(rover(limits=SLOW)).held("rover_1", command)
    assert isinstance(caught.value, RefusedError | PayloadError)
    assert "not sent to rover_1" in caught.value.message


def test_what_is_allowed_is_sent_as_it_is() -> None:
    """Below every limit nothing is changed; verbs that go nowhere are not looked at."""
    held = orders(rover(limits=SLOW))
    for command in (
        goto((10, 10), speed_mps=1.5),
        order("velocity", forward_mps=1.0),
        order("orbit", x=20, y=10, radius_m=5, speed_mps=1.0),
        order("pick", object="box"),
        order("hold"),
        order("return_home"),
        order("of_its_own", speed_mps=99),
    ):
        assert held.held("rover_1", command) is command


def test_a_skills_usual_speed_is_lowered() -> None:
    """What nobody asked for is no reason to refuse: it goes as fast as it may; what a plan asked for is refused."""
    held = orders(rover(limits=SLOW), speed_mps=4.0)
    fast = goto((10, 10), speed_mps=6.0)
    assert held.held("rover_1", fast, CHOSEN).args == fast.args | {"speed_mps": 1.5}
    with pytest.raises(RefusedError):
        held.held("rover_1", fast, CHOSEN - {"speed_mps"})
    assert held.held("rover_1", goto((10, 10))).args["speed_mps"] == 1.5  # what it would choose nobody knows


def test_the_configurations_limits_hold_for_vehicles_too() -> None:
    """Their site is looked at elsewhere; speeds and heights of [safety] here. Their own usual ones stand below it."""
    held = orders(drone(), speed_mps=4.0, altitude_m=8.0)
    with pytest.raises(RefusedError, match=r"5 m/s is above 4 m/s, by the limits of drone_1 in \[safety\]"):
        held.held("drone_1", goto((10, 10), speed_mps=5.0))
    with pytest.raises(RefusedError, match="9 m up is above 8 m up"):
        held.held("drone_1", goto((10, 10, 9)))
    assert held.held("drone_1", goto((10, 10), (12, 10, 5))).args == {
        "waypoints": [{"x": 10, "y": 10, "z": 8.0}, {"x": 12, "y": 10, "z": 5}],
        "speed_mps": 4.0,
    }
    outside = goto((500, 10, 5), speed_mps=4.0)
    assert held.held("drone_1", outside) is outside
    slower = orders(drone(), speed_mps=7.0, altitude_m=20.0)
    assert slower.held("drone_1", goto((10, 10))).args == goto((10, 10)).args


def test_take_offs() -> None:
    """A usual height is lowered, one that was asked for refused; none is only given where the usual one is too high."""
    held = orders(drone(), altitude_m=3.0)
    assert held.held("drone_1", order("takeoff", altitude_m=5.0), CHOSEN).args == {"altitude_m": 3.0}
    with pytest.raises(RefusedError, match="at most 3 m"):
        held.held("drone_1", order("takeoff", altitude_m=5.0))
    assert held.held("drone_1", order("takeoff")).args == {"altitude_m": 3.0}
    assert orders(drone(), altitude_m=15.0).held("drone_1", order("takeoff")).args == {}
    own = orders(rover(flies=True, limits=RobotLimits(altitude_m=40.0)))
    with pytest.raises(RefusedError, match="the site's limit"):
        own.held("rover_1", order("takeoff", altitude_m=35.0))


@pytest.mark.parametrize(
    ("changes", "z"),
    [
        ({"pose": Pose(x=2.0, y=10.0, z=20.0)}, 28.0),
        ({"pose": Pose(x=2.0, y=10.0, z=20.3), "home": Pose(x=0.0, y=0.0, z=20.0)}, 28.0),
        ({"pose": Pose(x=2.0, y=10.0, z=20.3), "home": Pose(x=0.0, y=0.0, z=20.0), "armed": True}, 28.0),
        ({"pose": Pose(x=2.0, y=10.0, z=23.0), "home": Pose(x=0.0, y=0.0, z=20.0), "armed": True}, None),
        ({"pose": Pose(x=2.0, y=10.0, z=-3.0), "home": Pose(x=0.0, y=0.0, z=-5.0), "armed": True}, None),
        ({"pose": Pose(x=2.0, y=10.0, z=-5.0), "home": Pose(x=0.0, y=0.0, z=-5.0)}, 3.0),
        ({"pose": Pose(x=2.0, y=10.0, z=3.0), "armed": True}, 3.0),
        ({"pose": Pose(x=2.0, y=10.0, z=12.0), "armed": True}, 8.0),
        ({"pose": Pose(x=2.0, y=10.0), "armed": True}, 8.0),
        ({"pose": None, "armed": True}, 8.0),
        ({"pose": None}, 8.0),
    ],
)
def test_heights_from_the_ground_on_a_hill(changes: dict[str, Any], z: float | None) -> None:
    """The bound counts from where it takes off, whatever the site's origin; who flies keeps the height that it has."""
    held = orders(drone(**changes), altitude_m=8.0)
    sent = held.held("drone_1", goto((10, 10), (12, 10, 5.0)))
    assert sent.args["waypoints"][0].get("z") == z
    assert sent.args["waypoints"][1]["z"] == 5.0
    orbit = held.held("drone_1", order("orbit", x=20, y=10, radius_m=5))
    assert orbit.args.get("z") == z


def test_a_height_that_an_order_cannot_say_is_refused() -> None:
    """Deep below the site's origin a height near its ground would mean the usual one, above the bound."""
    held = orders(drone(pose=Pose(x=2.0, y=10.0, z=-20.0)), altitude_m=8.0)
    with pytest.raises(RefusedError, match="20 m below the site's origin"):
        held.held("drone_1", goto((10, 10)))
    assert held.held("drone_1", order("takeoff")).args == {"altitude_m": 8.0}
    high = goto((10, 10, 5.0))
    assert held.held("drone_1", high) is high


def test_whatever_stands_in_an_area_may_leave_it() -> None:
    """A robot in the pit is let out; where nobody knows where a robot is, its first leg is not looked at."""
    held = orders(rover(pose=Pose(x=20.0, y=10.0)))
    assert held.held("rover_1", goto((21, 10), (30, 10)))
    assert orders(rover(pose=None)).held("rover_1", goto((30, 10)))
    with pytest.raises(RefusedError, match="waypoint 1 is in the pit"):
        orders(rover(pose=None)).held("rover_1", goto((20, 10)))


def test_a_place_that_is_some_tenths_of_a_second_old_is_no_reason_to_refuse() -> None:
    """A robot that stands at the edge of an obstacle, and is a little further than the roster has it, may go on."""
    assert orders(rover(pose=Pose(x=4.8, y=20.2))).held("rover_1", goto((5.2, 19.8)))


def walled(width_m: float, **changes: Any) -> Orders:
    """Return what holds a rover to a site with a wall across it, which begins at x = 20."""
    wall = Box(name="wall", x=(20.0, 20.0 + width_m), y=(0.0, 30.0))
    robot = rover(**changes)
    return Orders(
        Site(forbidden=(wall,)),
        roster=lambda: {robot.id: robot},
        configured=lambda robot: Bounds(whose=robot),
        vehicles=lambda _: Usual(),
    )


@given(st.floats(0.15, 5.0), st.floats(0.0, 19.99))
def test_a_wall_is_in_the_way_from_wherever_it_is_begun(width_m: float, x: float) -> None:
    """Narrow or wide, far from it or at it: the first leg does not go through, and the way back from it is free."""
    held = walled(width_m, pose=Pose(x=x, y=10.0))
    with pytest.raises(RefusedError, match="the leg to waypoint 1 goes through wall"):
        held.held("rover_1", goto((30, 10)))
    assert held.held("rover_1", goto((1, 12)))


def test_a_robot_that_is_said_to_be_in_a_narrow_wall_may_go_back() -> None:
    """Its place is old: a little into the wall it is let out by where it came from."""
    assert walled(0.4, pose=Pose(x=20.1, y=10.0)).held("rover_1", goto((1, 10)))


def test_an_order_that_is_under_way_is_not_held_to_where_its_robot_is_now() -> None:
    """Leg and range from there are not the order's; its points, its own legs, heights and speeds still are."""
    held = orders(rover(pose=Pose(x=16.0, y=10.0), limits=RobotLimits(range_m=15.0)))
    way = goto((24, 10), (30, 10))
    with pytest.raises(RefusedError, match="the leg to waypoint 1 goes through the pit"):
        orders(rover(pose=Pose(x=16.0, y=10.0))).held("rover_1", way)
    assert held.held("rover_1", way, begun=True) is way
    far = goto((2, 2), (10, 2))
    with pytest.raises(RefusedError, match="longer than 15 m"):
        held.held("rover_1", far)
    assert held.held("rover_1", far, begun=True) is far
    for refused, why in (
        (goto((10, 10), speed_mps=7.0), "the site's limit of 6 m/s"),
        (goto((10, 10, 31)), "the site allows 30 m"),
        (goto((50, 10)), "outside the yard"),
        (goto((20, 10)), "waypoint 1 is in the pit"),
        (goto((16, 10), (24, 10)), "the leg to waypoint 2 goes through the pit"),
        (goto((2, 2), (20, 2)), "longer than 15 m"),
    ):
        with pytest.raises(RefusedError, match=why):
            held.held("rover_1", refused, begun=True)


def test_arguments_that_cannot_be_read_are_not_sent() -> None:
    """An unknown argument would be a way round the limits."""
    for command in (goto((10, 10), pace=9), order("goto"), order("velocity", forward_mps="fast")):
        with pytest.raises(PayloadError, match="not sent to rover_1"):
            orders(rover()).held("rover_1", command)


def test_a_robot_that_is_not_in_the_roster_has_the_configurations_limits() -> None:
    """Nothing else is known of it."""
    with pytest.raises(RefusedError):
        orders(speed_mps=1.0).held("rover_9", goto((10, 10), speed_mps=2.0))
    command = goto((500, 10), speed_mps=1.0)
    assert orders(speed_mps=1.0).held("rover_9", command) is command


_NUMBER = st.floats(-60, 60)


@given(
    st.lists(st.tuples(_NUMBER, _NUMBER), min_size=1, max_size=5),
    st.one_of(st.none(), st.floats()),
    st.floats(0.1, 10.0),
    st.floats(0.1, 10.0),
    st.booleans(),
)
def test_no_order_is_sent_above_a_limit(
    points: list[tuple[float, float]], speed: float | None, registered: float, configured: float, chosen: bool
) -> None:
    """Whatever is asked of whom: what is sent is within both limits, inside the fence and of the same points."""
    held = orders(rover(limits=RobotLimits(speed_mps=registered)), speed_mps=configured)
    command = goto(*points, **({} if speed is None else {"speed_mps": speed}))
    try:
        sent = held.held("rover_1", command, CHOSEN if chosen else frozenset())
    except (RefusedError, PayloadError):
        return
    assert 0.0 < sent.args["speed_mps"] <= min(registered, configured, SITE.speed_limit_mps)
    assert sent.args["waypoints"] == command.args["waypoints"]
    assert all(-1e-5 < x < 40.00001 and -1e-5 < y < 30.00001 for x, y in points)
