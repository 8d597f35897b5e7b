"""What makes a way allowed."""

import math
from typing import Any

import pytest

from appliance.model import Box, Pose, Site
from appliance.robots.limits import check_way
from appliance.robots.verbs import GotoArgs, RobotFailure, Waypoint, cruise, parse_args

SITE = Site(
    obstacles=(Box(name="rack", x=(4.0, 6.0), y=(-1.0, 1.0)),),
    forbidden=(Box(name="pit", x=(4.0, 6.0), y=(9.0, 11.0)),),
    altitude_limit_m=30.0,
    speed_limit_mps=6.0,
)


def way(*points: tuple[float, float], speed: float | None = None, z: float | None = None) -> GotoArgs:
    """Make a goto."""
    return GotoArgs(waypoints=tuple(Waypoint(x, y, z) for x, y in points), speed_mps=speed)


def test_obstacles_bind_the_ground_and_pits_everybody() -> None:
    """A rack stops a rover and not a drone; a forbidden area stops both; the leg and the area are named."""
    with pytest.raises(RobotFailure, match="leg to waypoint 1 goes through rack"):
        check_way(SITE, Pose(), way((10, 0)), flies=False)
    assert check_way(SITE, Pose(), way((10, 0)), flies=True)
    for flies in (False, True):
        with pytest.raises(RobotFailure, match="leg to waypoint 2 goes through pit"):
            check_way(SITE, Pose(), way((0, 10), (10, 10)), flies=flies)


@pytest.mark.parametrize(
    "goto",
    [
        GotoArgs(waypoints=()),
        way(*[(0.0, float(n)) for n in range(101)]),
        way((math.nan, 0)),
        way((math.inf, 0)),
        way((20_000, 0)),
        way((0, 1), z=31.0),
        way((0, 1), speed=0.0),
        way((0, 1), speed=-1.0),
        way((0, 1), speed=7.0),
        way((0, 1), speed=math.nan),
    ],
)
def test_ways_that_are_refused(goto: GotoArgs) -> None:
    """No or too many points, points off the site, too high, too fast, standing still: each a RobotFailure."""
    with pytest.raises(RobotFailure):
        check_way(SITE, Pose(), goto, flies=True)


def test_ground_points_are_flown_over() -> None:
    """A waypoint on the ground or without height keeps the altitude of the one before."""
    points = (Waypoint(0, 0), Waypoint(1, 0, 12.0), Waypoint(2, 0, 0.0))
    assert [z for _, _, z in cruise(points, 5.0)] == [5.0, 12.0, 12.0]


@pytest.mark.parametrize("args", [{}, {"waypoints": [{"x": "1", "y": 2}]}, {"waypoints": [{"x": 1}]}])
def test_wrong_arguments_name_the_field(args: dict[str, Any]) -> None:
    """The message says which argument of which verb is wrong and what the verb takes."""
    with pytest.raises(RobotFailure, match="goto: ") as caught:
        parse_args("goto", args, GotoArgs)
    assert "waypoints, speed_mps" in caught.value.failure.remedy
