"""What Foxglove is given: poses, frames and places of robots."""

import math

import msgspec
import pytest

from appliance.model import Pose, RobotInfo, Site, encode, keyspace
from appliance.model.keys import Keys
from appliance.record.models import LoggedMessage
from appliance.record.schemas import FRAME_TRANSFORM, LOCATION_FIX, SITE_FRAME, Foxglove, facing

KEYS = Keys("f1")
SITE = Site(latitude_deg=47.0, longitude_deg=8.0, altitude_m=400.0)


def _made(pose: Pose | None, *, site: Site | None = SITE) -> dict[str, dict[str, object]]:
    derive = Foxglove(KEYS, "rec", site=site).deriving(KEYS(keyspace.ROBOT, "r1"))
    assert derive is not None
    message = LoggedMessage(
        KEYS(keyspace.ROBOT, "r1"), 1_500_000_000, encode(RobotInfo(id="other", kind="zenoh", pose=pose))
    )
    return {each.topic.rsplit("/", 1)[-1]: msgspec.json.decode(each.payload) for each in derive(message)}


def test_a_robot_has_a_frame_and_a_place() -> None:
    """The two messages have exactly the fields of Foxglove's schemas, in its units, under the key's robot."""
    made = _made(Pose(x=10.0, y=20.0, z=5.0, heading_deg=90.0))
    for what, schema in (("transform", FRAME_TRANSFORM), ("location", LOCATION_FIX)):
        assert set(made[what]) == set(schema["properties"])
        assert made[what]["timestamp"] == {"sec": 1, "nsec": 500_000_000}
    assert made["transform"]["translation"] == {"x": 10.0, "y": 20.0, "z": 5.0}
    # A body that looks along x looks east.
    assert made["transform"]["rotation"] == {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
    assert (made["transform"]["parent_frame_id"], made["transform"]["child_frame_id"]) == (SITE_FRAME, "r1")
    latitude, longitude = made["location"]["latitude"], made["location"]["longitude"]
    assert isinstance(latitude, float)
    assert isinstance(longitude, float)
    assert (latitude - 47.0) * 111_200 == pytest.approx(20.0, rel=0.01)
    assert (longitude - 8.0) * 111_320 * math.cos(math.radians(47.0)) == pytest.approx(10.0, rel=0.01)
    assert made["location"]["altitude"] == 405.0


def test_without_a_site_there_are_no_places_and_without_a_pose_nothing() -> None:
    """What is not known is left out."""
    assert set(_made(Pose(), site=None)) == {"transform"}
    assert _made(None) == {}


@pytest.mark.parametrize("payload", [b"{", b"[]", b'{"id":"r","kind":"k","pose":{"x":1e999}}', b"\xff"])
def test_what_is_malformed_makes_nothing(payload: bytes) -> None:
    """Garbage on a robot's key is kept as it is, and no panel is led astray by it."""
    derive = Foxglove(KEYS, "rec", site=SITE).deriving(KEYS(keyspace.ROBOT, "r1"))
    assert derive is not None
    assert derive(LoggedMessage(KEYS(keyspace.ROBOT, "r1"), 5, payload)) == ()


def test_all_robots_are_on_one_channel_of_each_panel() -> None:
    """Sixty-four of them make no list that nobody can read; the frame's own name tells them apart."""
    views = Foxglove(KEYS, "rec", site=SITE)
    topics: set[str] = set()
    for number in range(64):
        key = KEYS(keyspace.ROBOT, f"r{number}")
        derive = views.deriving(key)
        assert derive is not None
        made = derive(LoggedMessage(key, 5, encode(RobotInfo(id=f"r{number}", kind="zenoh", pose=Pose()))))
        topics |= {each.topic for each in made}
        assert msgspec.json.decode(made[0].payload)["child_frame_id"] == f"r{number}"
    assert topics == {"swiftbot/f1/recorder/rec/robots/transform", "swiftbot/f1/recorder/rec/robots/location"}


def test_north_is_along_y() -> None:
    """Heading 0 turns a body that looks along x by a quarter to the left."""
    rotation = facing(0.0)
    assert (rotation.z, rotation.w) == (pytest.approx(math.sqrt(0.5)), pytest.approx(math.sqrt(0.5)))
