"""A small fleet and site for the planner's tests."""

import pytest

from appliance.model import Box, Place, RobotInfo, Site
from appliance.skills.catalogue import Catalogue, load_catalogue


@pytest.fixture(scope="session")
def catalogue() -> Catalogue:
    """Return the built-in catalogue."""
    return load_catalogue()


@pytest.fixture
def robots() -> tuple[RobotInfo, ...]:
    """Return a drone with a camera and a rover with an arm."""
    drone = RobotInfo(
        id="drone_1",
        kind="mavlink",
        uses=("base", "camera"),
        verbs=("goto", "state", "takeoff", "land", "hold", "return_home", "capture", "record"),
        flies=True,
    )
    rover = RobotInfo(
        id="rover_1",
        kind="zenoh",
        uses=("base", "arm", "camera"),
        verbs=("goto", "state", "hold", "return_home", "pick", "place", "capture", "record"),
    )
    return (drone, rover)


@pytest.fixture
def site() -> Site:
    """Return a site with a few places, a pit and a rack."""
    return Site(
        places={
            "dock 1": Place(x=1, y=1),
            "dock 2": Place(x=2, y=9),
            "goal 2": Place(x=5, y=5, aliases=("goal two",)),
            "shelf": Place(x=9, y=1),
            "pit edge": Place(x=20.5, y=20.5),
        },
        forbidden=(Box(name="pit", x=(20, 22), y=(20, 22)),),
        obstacles=(Box(name="rack", x=(30, 32), y=(0, 5)),),
        altitude_limit_m=30,
        speed_limit_mps=6,
    )
