"""The safety policy: what a site allows, whatever asked for it."""

import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.model import Box, Pose, Site
from appliance.robots.limits import breach, check_mission, check_orbit, check_points, check_way
from appliance.robots.verbs import GotoArgs, MissionArgs, MissionStep, OrbitArgs, RobotFailure, Waypoint

SITE = Site(
    fence=Box(name="the yard", x=(0.0, 40.0), y=(0.0, 30.0)),
    forbidden=(Box(name="the pit", x=(18.0, 22.0), y=(8.0, 12.0)),),
    altitude_limit_m=30.0,
    speed_limit_mps=6.0,
)
HERE = Pose(x=5.0, y=5.0)


def test_nobody_leaves_the_fence() -> None:
    """A point outside is refused by name, on the ground and in the air; one that is outside may come back in."""
    for flies in (True, False):
        with pytest.raises(RobotFailure, match=r"waypoint 2 at \(50, 5\) is outside the yard"):
            check_way(SITE, HERE, GotoArgs(waypoints=(Waypoint(10, 5), Waypoint(50, 5))), flies=flies)
        assert check_way(SITE, Pose(x=50.0, y=5.0), GotoArgs(waypoints=(Waypoint(10, 5),)), flies=flies)


@pytest.mark.parametrize(
    ("orbit", "why"),
    [
        (OrbitArgs(x=5, y=5, radius_m=20), "outside the yard"),
        (OrbitArgs(x=20, y=10, radius_m=1.5), "goes through the pit"),
        (OrbitArgs(x=10, y=15, radius_m=5, speed_mps=7), "above the site's limit"),
        (OrbitArgs(x=10, y=15, z=31, radius_m=5), "the site allows 30 m"),
        (OrbitArgs(x=10, y=15, radius_m=0.1), "radius"),
        (OrbitArgs(x=10, y=15, radius_m=math.nan), "radius"),
        (OrbitArgs(x=10, y=15, radius_m=5, laps=0), "laps"),
    ],
)
def test_circles_that_are_refused(orbit: OrbitArgs, why: str) -> None:
    """A circle is looked at all the way round, and at its speed and height."""
    with pytest.raises(RobotFailure, match=why):
        check_orbit(SITE, HERE, orbit, flies=True)


def test_a_circle_that_is_allowed() -> None:
    """Inside the fence, clear of the pit."""
    check_orbit(SITE, HERE, OrbitArgs(x=10, y=20, radius_m=5, laps=2, speed_mps=3), flies=True)


@pytest.mark.parametrize(
    ("mission", "why"),
    [
        (MissionArgs(steps=()), "0 waypoints"),
        (MissionArgs(steps=(MissionStep(10, 5, hold_s=-1),)), "stays -1 s"),
        (MissionArgs(steps=(MissionStep(10, 5, hold_s=math.inf),)), "stays inf s"),
        (MissionArgs(steps=(MissionStep(10, 10), MissionStep(30, 10))), "goes through the pit"),
        (MissionArgs(steps=(MissionStep(10, 5),), speed_mps=9), "above the site's limit"),
    ],
)
def test_missions_that_are_refused(mission: MissionArgs, why: str) -> None:
    """Each step and each leg counts."""
    with pytest.raises(RobotFailure, match=why):
        check_mission(SITE, HERE, mission, flies=True)


def test_the_rest_of_a_mission_is_looked_at_from_where_the_robot_is() -> None:
    """Without a place to begin at the points alone count; the leg to where it goes on is refused by its own number."""
    mission = MissionArgs(steps=(MissionStep(10, 10), MissionStep(30, 10), MissionStep(35, 10)))
    points = check_mission(SITE, None, mission, flies=True)
    check_points(SITE, Pose(x=30.0, y=15.0), points[1:], flies=True, behind=1)
    with pytest.raises(RobotFailure, match="the leg to waypoint 2 goes through the pit"):
        check_points(SITE, Pose(x=10.0, y=10.0), points[1:], flies=True, behind=1)
    with pytest.raises(RobotFailure, match=r"waypoint 1 at .* outside the yard"):
        check_mission(SITE, None, MissionArgs(steps=(MissionStep(50, 10),)), flies=True)


def test_a_circle_meets_what_lies_between_its_points() -> None:
    """A post on the circle counts wherever it stands, one beside it nowhere, and one that the robot stands in too."""
    for degrees in range(0, 360, 5):
        x, y = 50 * math.cos(math.radians(degrees)), 50 * math.sin(math.radians(degrees))
        post = Box(name="the post", x=(x - 0.02, x + 0.02), y=(y - 0.02, y + 0.02))
        site = Site(forbidden=(post,), altitude_limit_m=30.0)
        for start in (Pose(x=0.0, y=0.0), Pose(x=x, y=y), None):
            with pytest.raises(RobotFailure, match="the circle goes through the post"):
                check_orbit(site, start, OrbitArgs(x=0, y=0, radius_m=50), flies=True)
            check_orbit(site, start, OrbitArgs(x=0, y=0, radius_m=49.9), flies=True)


def test_a_thin_wall_stops_what_flies_and_what_drives() -> None:
    """A forbidden line of a centimetre stops both, an obstacle what drives; a way round is allowed."""
    line = Box(name="the line", x=(10.0, 10.01), y=(0.0, 20.0))
    through = GotoArgs(waypoints=(Waypoint(20, 5),))
    round_it = GotoArgs(waypoints=(Waypoint(5, 25), Waypoint(20, 25), Waypoint(20, 5)))
    for flies in (True, False):
        site = Site(forbidden=(line,)) if flies else Site(obstacles=(line,))
        with pytest.raises(RobotFailure, match="goes through the line"):
            check_way(site, HERE, through, flies=flies)
        assert check_way(site, HERE, round_it, flies=flies)
    assert check_way(Site(obstacles=(line,)), HERE, through, flies=True)


def test_what_leaves_a_forbidden_area_may_not_come_back() -> None:
    """It may leave the one that it stands in, and no leg after that goes through it again."""
    inside = Pose(x=20.0, y=10.0)
    assert check_way(SITE, inside, GotoArgs(waypoints=(Waypoint(21, 11), Waypoint(30, 10))), flies=True)
    with pytest.raises(RobotFailure, match="the leg to waypoint 2 goes through the pit"):
        check_way(SITE, inside, GotoArgs(waypoints=(Waypoint(30, 10), Waypoint(10, 10))), flies=True)


def test_a_narrow_area_is_left_by_nobody_unseen() -> None:
    """Where a robot was and where it is count, however thin what lies between them is."""
    site = Site(forbidden=(Box(name="the line", x=(10.0, 10.02), y=(0.0, 20.0)),))
    here, there = Pose(x=9.0, y=5.0), Pose(x=11.0, y=5.0)
    assert breach(site, there, flies=True) == ""
    assert breach(site, there, flies=True, before=here) == "it went through the line"
    assert breach(site, Pose(x=10.01, y=5.0), flies=True) == "it is in the line"
    assert breach(site, Pose(x=9.5, y=9.0), flies=True, before=here) == ""


HANGAR = Site(forbidden=(Box(name="the hangar", x=(0.0, 40.0), y=(0.0, 40.0)),))


def _round_the_corner(metres: float) -> Pose:
    """So far along the way (0, 30), (0, 0), (30, 0), which keeps to the hangar's edges."""
    return Pose(x=max(metres - 30.0, 0.0), y=max(30.0 - metres, 0.0))


@pytest.mark.parametrize("every_s", [0.1, 0.2, 0.4, 0.5, 0.8, 1.0, 3.0])
@pytest.mark.parametrize("speed_mps", [1.0, 5.0, 8.0, 15.0])
def test_a_corner_that_is_flown_round_is_not_flown_through(every_s: float, speed_mps: float) -> None:
    """However rare positions are, and wherever on the way: 0.2 s are 5 Hz, 0.8 s are three of those lost."""
    step = speed_mps * every_s
    for begun in range(20):
        at = [begun / 20 * step + number * step for number in range(math.ceil(60.0 / step))]
        for before, here in pairwise(_round_the_corner(metres) for metres in at):
            assert breach(HANGAR, here, flies=True, before=before, apart_s=every_s) == "", (before, here)


def test_a_line_counts_between_reports_that_follow_one_another() -> None:
    """Through a wall at 5 Hz, or at 2 Hz with times that vary, is noticed; in a longer gap it may have gone round."""
    for width in (0.01, 1.0):
        site = Site(forbidden=(Box(name="the line", x=(10.0, 10.0 + width), y=(0.0, 20.0)),))
        for half, apart_s in ((0.51, 0.2), (1.25, 0.5), (1.25, 0.52)):
            before, here = Pose(x=10.0 + width / 2 - half, y=5.0), Pose(x=10.0 + width / 2 + half, y=5.0)
            assert breach(site, here, flies=True, before=before, apart_s=apart_s) == "it went through the line"
            assert breach(site, here, flies=True, before=before, apart_s=0.8) == ""


def test_what_is_inside_is_noticed_after_any_gap() -> None:
    """The position alone says so, however long nothing was heard."""
    for apart_s in (0.2, 0.8, 3.0, math.inf):
        here = breach(HANGAR, Pose(x=5.0, y=10.0), flies=True, before=Pose(x=-5.0, y=10.0), apart_s=apart_s)
        assert here == "it is in the hangar"


def test_what_has_left_the_site() -> None:
    """Beyond the fence, above the ceiling or in a forbidden area; grazing the edge is not left."""
    assert breach(SITE, Pose(x=20, y=20, z=10), flies=True) == ""
    assert breach(SITE, Pose(x=41, y=20, z=10), flies=True) == ""
    assert "outside the yard" in breach(SITE, Pose(x=45, y=20), flies=False)
    assert "40 m up" in breach(SITE, Pose(x=20, y=20, z=40), flies=True)
    assert breach(SITE, Pose(x=20, y=20, z=40), flies=False) == ""
    assert "in the pit" in breach(SITE, Pose(x=20, y=10), flies=True)


@given(st.lists(st.tuples(st.floats(-60, 60), st.floats(-60, 60)), min_size=1, max_size=6))
def test_a_way_that_is_allowed_never_breaks_the_policy(points: list[tuple[float, float]]) -> None:
    """Every point along every leg of an allowed way is inside the fence and outside the pit."""
    goto = GotoArgs(waypoints=tuple(Waypoint(x, y) for x, y in points))
    try:
        check_way(SITE, HERE, goto, flies=True)
    except RobotFailure:
        return
    way = [(HERE.x, HERE.y), *points]
    for (x, y), (to_x, to_y) in pairwise(way):
        for step in range(51):
            at = Pose(x=x + (to_x - x) * step / 50, y=y + (to_y - y) * step / 50)
            assert breach(SITE, at, flies=True, margin_m=0.11) == ""
