"""What Foxglove is given: poses, frames and places of robots."""

import math

import msgspec
import pytest

from appliance.model import Pose, RobotInfo, Site, encode, keyspace
from appliance.model.keys import Keys
from appliance.record.models import LoggedMessage
from appliance.record.schemas import FRAME_TRANSFORM, LOCATION_FIX, POSE_IN_FRAME, SITE_FRAME, Foxglove, facing

KEYS = Keys("f1")
SITE = Site(latitude_deg=47.0, longitude_deg=8.0, altitude_m=400.0)


def _made(pose: Pose | None, *, site: Site | None = SITE) -> dict[str, dict[str, object]]:
    derive = Foxglove(KEYS, "rec", site=site).deriving(KEYS(keyspace.ROBOT, "r1"))
    assert derive is not None
    message = LoggedMessage(
        KEYS(keyspace.ROBOT, "r1"), 1_500_000_000, encode(RobotInfo(id="other", kind="zenoh", pose=pose))
    )
    return {each.topic.rsplit("/", 1)[-1]: msgspec.json.decode(each.payload) for each in derive(message)}


def test_a_robot_has_pose_frame_and_place() -> None:
    """The three messages have exactly the fields of Foxglove's schemas, in its units, under the key's robot."""
    made = _made(Pose(x=10.0, y=20.0, z=5.0, heading_deg=90.0))
    for what, schema in (("pose", POSE_IN_FRAME), ("transform", FRAME_TRANSFORM), ("location", LOCATION_FIX)):
        assert set(made[what]) == set(schema["properties"])
        assert made[what]["timestamp"] == {"sec": 1, "nsec": 500_000_000}
    assert made["pose"]["frame_id"] == SITE_FRAME
    assert made["pose"]["pose"] == {
        "position": {"x": 10.0, "y": 20.0, "z": 5.0},
        "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},  # a body that looks along x looks east
    }
    assert (made["transform"]["parent_frame_id"], made["transform"]["child_frame_id"]) == (SITE_FRAME, "r1")
    latitude, longitude = made["location"]["latitude"], made["location"]["longitude"]
    assert isinstance(latitude, float)
    assert isinstance(longitude, float)
    assert (latitude - 47.0) * 111_200 == pytest.approx(20.0, rel=0.01)
    assert (longitude - 8.0) * 111_320 * math.cos(math.radians(47.0)) == pytest.approx(10.0, rel=0.01)
    assert made["location"]["altitude"] == 405.0


def test_without_a_site_there_are_no_places_and_without_a_pose_nothing() -> None:
    """What is not known is left out."""
    assert set(_made(Pose(), site=None)) == {"pose", "transform"}
    assert _made(None) == {}


@pytest.mark.parametrize("payload", [b"{", b"[]", b'{"id":"r","kind":"k","pose":{"x":1e999}}', b"\xff"])
def test_what_is_malformed_makes_nothing(payload: bytes) -> None:
    """Garbage on a robot's key is kept as it is, and no panel is led astray by it."""
    derive = Foxglove(KEYS, "rec", site=SITE).deriving(KEYS(keyspace.ROBOT, "r1"))
    assert derive is not None
    assert derive(LoggedMessage(KEYS(keyspace.ROBOT, "r1"), 5, payload)) == ()


@pytest.mark.parametrize("name", ["a$*b", "a\nb", "\x7f"])
def test_a_name_that_cannot_be_in_a_key_makes_nothing(name: str) -> None:
    """A stranger may put under any key that Zenoh takes: it is recorded, and the recorder goes on."""
    key = f"swiftbot/f1/robot/{name}/state"
    derive = Foxglove(KEYS, "rec", site=SITE).deriving(key)
    assert derive is not None
    assert derive(LoggedMessage(key, 5, encode(RobotInfo(id="r1", kind="zenoh", pose=Pose())))) == ()


def test_north_is_along_y() -> None:
    """Heading 0 turns a body that looks along x by a quarter to the left."""
    rotation = facing(0.0)
    assert (rotation.z, rotation.w) == (pytest.approx(math.sqrt(0.5)), pytest.approx(math.sqrt(0.5)))
