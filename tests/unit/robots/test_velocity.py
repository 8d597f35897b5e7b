"""Moving by hand: what the policy allows of it, and how the simulated robots move."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.model import Box, Pose, Site
from appliance.robots.limits import check_velocity
from appliance.robots.verbs import RobotFailure, VelocityArgs
from workshop.robots.driving import Driving

SITE = Site(obstacles=(Box(name="the wall", x=(2.0, 3.0), y=(-5.0, 5.0)),), speed_limit_mps=2.0)
speeds = st.floats(-2.0, 2.0)


@given(speeds, speeds, st.floats(0, 360))
def test_ahead_is_where_it_looks(forward: float, left: float, heading: float) -> None:
    """The speed stays the same in the site's directions; ahead at 90 degrees is east, and left of that is north."""
    args = VelocityArgs(forward_mps=forward / 2, left_mps=left / 2, for_s=0.05)
    east, north, up = check_velocity(Site(), Pose(heading_deg=heading), args, flies=False)
    assert math.isclose(math.hypot(east, north), math.hypot(forward, left) / 2, abs_tol=1e-9)
    assert up == 0.0
    east, north, _ = check_velocity(Site(), Pose(heading_deg=90.0), args, flies=False)
    assert math.isclose(east, forward / 2, abs_tol=1e-9)
    assert math.isclose(north, left / 2, abs_tol=1e-9)


@pytest.mark.parametrize(
    ("args", "flies", "match"),
    [
        (VelocityArgs(forward_mps=3.0), False, "above the site's limit"),
        (VelocityArgs(forward_mps=0.5, for_s=2.0), False, "for_s 2 is not in"),
        (VelocityArgs(forward_mps=math.nan), False, "no number"),
        (VelocityArgs(up_mps=0.5), False, "does not fly"),
        (VelocityArgs(turn_dps=500.0), False, "turn_dps 500"),
        (VelocityArgs(forward_mps=2.0, for_s=1.0), False, "goes through the wall"),
    ],
)
def test_what_is_not_allowed_is_refused_before_anything_moves(args: VelocityArgs, flies: bool, match: str) -> None:
    """Each with the reason: too fast, too long, no number, up on the ground, into an obstacle."""
    with pytest.raises(RobotFailure, match=match):
        check_velocity(SITE, Pose(x=1.0, heading_deg=90.0), args, flies=flies)


def test_a_turn_on_the_spot_is_allowed_beside_an_obstacle() -> None:
    """Nothing is in the way of what does not go anywhere."""
    assert check_velocity(SITE, Pose(x=1.9), VelocityArgs(turn_dps=30.0), flies=False) == (0.0, 0.0, 0.0)


def test_the_rover_moves_until_it_is_halted() -> None:
    """A metre a second for two seconds, turning meanwhile; halted it stands."""
    rover = Driving(0.0, 0.0)
    rover.by_hand(0.0, 1.0, 10.0)
    rover.step(2.0)
    assert (rover.pose.x, rover.pose.y, rover.pose.heading_deg) == (0.0, 2.0, 20.0)
    rover.halt()
    rover.step(1.0)
    assert rover.pose.y == 2.0
