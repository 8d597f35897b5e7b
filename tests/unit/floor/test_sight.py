"""What is seen of robots: freshness, standing, sizes, and whose former reservations are over."""

from typing import Any

import pytest

from appliance.errors import ConfigError
from appliance.floor.settings import FloorConfig, SizeConfig
from appliance.floor.sight import FRESH_S, STANDS_S, STATE_S, Sight
from appliance.floor.trips import goto_args, trip_of
from appliance.model import Pose, RobotCommand, RobotInfo, Site
from appliance.model.floor import FloorState


def info(robot: str, x: float, **fields: Any) -> RobotInfo:
    """Return a robot's word."""
    return RobotInfo(id=robot, kind="zenoh", pose=Pose(x=x), **fields)


def watch(sight: Sight, robot: str, xs: list[float], *, start: float = 0.0) -> float:
    """Hear a robot five times a second; returns when it was heard last."""
    now = start
    for number, x in enumerate(xs):
        now = start + 0.2 * number
        sight.observe(info(robot, x), now)
    return now


def test_moving_and_standing() -> None:
    """It stands when it has not moved for a while; its speed is what it was seen at."""
    sight = Sight(FloorConfig())
    now = watch(sight, "a", [0.3 * number for number in range(10)])
    body = sight.bodies(now)["a"]
    assert (body.stands, body.speed_mps) == (False, pytest.approx(1.5))
    assert sight.cleared(now) == frozenset()
    now = watch(sight, "a", [2.7] * 12, start=now)
    assert sight.bodies(now)["a"].stands
    assert sight.cleared(now) == {"a"}


def test_one_that_is_not_heard_keeps_its_ground_and_its_reservation() -> None:
    """It counts as standing where it was, and nobody may say that it has left what it had."""
    sight = Sight(FloorConfig())
    now = watch(sight, "a", [1.0] * 12)
    later = now + FRESH_S + 0.1
    body = sight.bodies(later)["a"]
    assert (body.fresh, body.stands, body.at[0]) == (False, True, 1.0)
    assert sight.cleared(later) == frozenset()
    sight.observe(info("a", 1.0, online=False), later)
    assert not sight.bodies(later)["a"].fresh
    sight.forget("a")
    assert sight.bodies(later) == {}
    assert sight.cleared(later) == {"a"}, "an operator has said that it is gone"


def test_what_a_gateway_says_is_over_when_it_is_not_said_again() -> None:
    """A robot under a reservation is not waited for as one without, until its gateway is silent."""
    sight = Sight(FloorConfig())
    now = watch(sight, "a", [0.3 * number for number in range(10)])
    sight.hear(FloorState(robot="a", state="moves"), now)
    assert sight.bodies(now)["a"].moved
    assert not sight.bodies(now + STATE_S + 0.1)["a"].moved
    sight.hear(FloorState(robot="a", state="waits", waits_for="b"), now)
    assert sight.bodies(now)["a"].stands, "its gateway says so, though it has moved just now"
    watch(sight, "a", [3.0, 3.3, 3.6, 3.9, 4.2, 4.5, 4.8, 5.1, 5.4, 5.7], start=now)
    assert not sight.bodies(now + STANDS_S + 0.1)["a"].stands, "it is seen to move all the same"


def test_sizes() -> None:
    """By the configuration, else by the robot's own word, else as most are; no position, no body."""
    sight = Sight(FloorConfig(robots={"b": SizeConfig(radius_m=2.0)}))
    assert sight.size(info("a", 0.0)).radius_m == 0.4
    assert sight.size(info("a", 0.0, radius_m=1.2)).radius_m == 1.2
    assert sight.size(info("b", 0.0, radius_m=1.2)).radius_m == 2.0
    assert sight.size(info("d", 0.0, flies=True)).margin_m == 0.5
    sight.observe(RobotInfo(id="c", kind="zenoh"), 0.0)
    assert sight.bodies(0.0) == {}


@pytest.mark.parametrize(
    "config",
    [
        FloorConfig(radius_m=0.0),
        FloorConfig(margin_m=-1.0),
        FloorConfig(wait_s=float("inf")),
        FloorConfig(robots={"a": SizeConfig(radius_m=99.0)}),
    ],
)
def test_sizes_that_cannot_be(config: FloorConfig) -> None:
    """They are refused at the start, by their key."""
    with pytest.raises(ConfigError, match="floor"):
        config.check()


COPTER = RobotInfo(id="d", kind="mavlink", flies=True, pose=Pose(x=1.0, y=2.0), home=Pose(x=0.0, y=0.0))


def order(verb: str, **args: Any) -> RobotCommand:
    """Return a command."""
    return RobotCommand(id="t/s1/1", verb=verb, args=args)


def test_where_commands_lead() -> None:
    """Up before there, along all points, round the circle, and home high enough; others move no base."""
    site = Site(altitude_limit_m=30.0)

    def points(command: RobotCommand, robot: RobotInfo = COPTER) -> tuple[tuple[float, float, float], ...]:
        found = trip_of(command, robot, site, task="t", takeoff_m=10.0)
        return found.points if found is not None else ()

    assert points(order("goto", waypoints=[{"x": 5.0, "y": 5.0}])) == ((1.0, 2.0, 10.0), (5.0, 5.0, 10.0))
    assert points(order("takeoff", altitude_m=4.0)) == ((1.0, 2.0, 4.0),)
    assert points(order("return_home")) == ((1.0, 2.0, 30.0), (0.0, 0.0, 30.0), (0.0, 0.0, 0.0))
    mission = order("mission", steps=[{"x": 3.0, "y": 3.0, "z": 8.0}], end="land")
    assert points(mission) == ((3.0, 3.0, 8.0), (3.0, 3.0, 0.0))
    assert len(points(order("orbit", x=9.0, y=9.0, radius_m=3.0))) == 13
    rover = info("r", 1.0, home=Pose(x=9.0))
    assert points(order("goto", waypoints=[{"x": 5.0, "y": 5.0, "z": 7.0}]), rover) == ((5.0, 5.0, 0.0),)
    assert points(order("return_home"), rover) == ((9.0, 0.0, 0.0),)
    for other in (order("capture", target="x"), order("goto", waypoints="nonsense"), order("no_such_verb")):
        assert points(other) == ()


def test_a_way_as_a_command() -> None:
    """The handler's own way is sent as it is; another one with its points, and the speed that was asked for."""
    command = order("goto", waypoints=[{"x": 5.0, "y": 0.0}], speed_mps=1.5)
    trip = trip_of(command, info("r", 0.0), Site(), task="t", takeoff_m=10.0)
    assert trip is not None
    assert goto_args(command, trip, ((0.0, 0.0, 0.0), (5.0, 0.0, 0.0))) is command.args
    round_it = goto_args(command, trip, ((0.0, 0.0, 0.0), (2.0, 2.0, 0.0), (5.0, 0.0, 0.0)))
    assert round_it == {"waypoints": [{"x": 2.0, "y": 2.0}, {"x": 5.0, "y": 0.0}], "speed_mps": 1.5}
