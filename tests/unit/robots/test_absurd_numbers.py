"""Numbers that cannot be, in telemetry and in a Zenoh robot's state: left out and counted, and the rest is kept."""

import json
import math
from collections import Counter
from collections.abc import Callable
from typing import Any, cast

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.model import Pose, RobotInfo, Site, encode
from appliance.model.robots import MAX_VERBS, plausible, read_robot
from appliance.plane.registry import Roster
from appliance.plane.session import Message as Put
from appliance.robots.mavlink.dialect import Codec, Frame, make
from appliance.robots.mavlink.vehicle import Vehicle
from tests.unit.robots.links import BEAT

GOOD = RobotInfo(
    id="cart_1", kind="zenoh", verbs=("goto", "state"), uses=("base",), pose=Pose(x=1.0, y=2.0, heading_deg=90.0),
    battery_percent=55.0, speed_mps=-0.5, mode="AUTO", mission_item=2, mission_items=5, note="well",
)  # fmt: skip


@pytest.mark.parametrize(
    ("field", "absurd", "instead"),
    [
        ("battery_percent", 1e9, None),
        ("battery_percent", -500.0, None),
        ("battery_percent", math.nan, None),
        ("speed_mps", -1e30, None),
        ("speed_mps", math.inf, None),
        ("verbs", tuple(f"v{number}" for number in range(20_000)), ()),
        ("verbs", ("x" * 100_000,), ()),
        ("uses", ("base",) * 1000, ()),
        ("warnings", ("battery low",) * 1000, ()),
        ("estimator", ("x" * 10_000,), ()),
        ("pose", Pose(x=1e30), None),
        ("pose", Pose(y=math.nan), None),
        ("pose", Pose(z=-1e6), None),
        ("home", Pose(x=-math.inf), None),
        ("mission_item", -1, 0),
        ("mission_items", 2**40, 0),
        ("mode", "x" * 1000, ""),
        ("note", "x" * 100_000, ""),
    ],
)
def test_what_a_robot_cannot_be_is_left_out(field: str, absurd: Any, instead: Any) -> None:
    """That field alone, and it is named."""
    given_, dropped = plausible(msgspec.structs.replace(GOOD, **{field: absurd}))
    assert dropped == (field,)
    assert given_ == msgspec.structs.replace(GOOD, **{field: instead})


def test_a_heading_and_limits_that_cannot_be() -> None:
    """The pose stays, and the other limits."""
    limits: dict[str, Any] = {"speed_mps": -1e30, "altitude_m": 50.0, "payload_kg": math.nan, "range_m": 1e9}
    payload = json.dumps({"id": "r", "kind": "zenoh", "pose": {"x": 1.0, "heading_deg": 1e9}, "limits": limits})
    info, dropped = plausible(read_robot(payload.encode()))
    assert set(dropped) == {"pose.heading_deg", "limits.speed_mps", "limits.payload_kg", "limits.range_m"}
    assert info.pose == Pose(x=1.0)
    assert info.limits is not None
    assert (info.limits.altitude_m, info.limits.speed_mps, info.limits.payload_kg) == (50.0, None, None)


def test_what_can_be_is_not_touched() -> None:
    """At the ends of each range, too: the very same object comes back."""
    for info in (
        GOOD,
        msgspec.structs.replace(GOOD, battery_percent=0.0, speed_mps=1000.0, verbs=("v",) * MAX_VERBS),
        msgspec.structs.replace(GOOD, battery_percent=100.0, pose=Pose(x=-2e7, z=-11_000.0, heading_deg=-180.0)),
    ):
        assert plausible(info) == (info, ())
        assert plausible(info)[0] is info


class Ears:
    """A session that counts what is refused."""

    def __init__(self) -> None:
        self.refused: Counter[str] = Counter()

    def refuse(self, what: str, **_: Any) -> None:
        """Count bad input."""
        self.refused[what] += 1


def put(roster: Roster, payload: bytes) -> None:
    """Put a state, as it comes from the plane."""
    cast("Any", roster)._heard(Put("swiftbot/test/robot/cart_1/state", payload, False, 0, ""))


@pytest.mark.parametrize("absurd", ["NaN", "Infinity", "-Infinity", "1e400", "1" * 5000, "-500", "1e9"])
def test_a_state_that_is_no_json_for_its_numbers_is_kept(absurd: str) -> None:
    """Python writes NaN and Infinity: the robot is in the roster, with all that can be."""
    ears = Ears()
    roster = Roster(cast("Any", ears), on_change=lambda: None)
    payload = '{"id": "cart_1", "kind": "zenoh", "battery_percent": %s, "mode": "AUTO", "pose": {"x": %s}}'
    put(roster, (payload % (absurd, absurd)).encode())
    info = roster.robots["cart_1"]
    assert (info.mode, info.battery_percent) == ("AUTO", None)
    assert ears.refused == {"implausible robot/*/state": 1}


@pytest.mark.parametrize("payload", [b"", b"{", b"[1]", b'{"id": 5}', b"[" * 100_000, b"\xff\xfe", b'{"id": NaN}'])
def test_what_is_no_state_is_refused_as_ever(payload: bytes) -> None:
    """And nothing of it is in the roster."""
    ears = Ears()
    roster = Roster(cast("Any", ears), on_change=lambda: None)
    put(roster, payload)
    assert (roster.robots, ears.refused) == ({}, {"malformed robot/*/state": 1})


def test_what_other_gateways_know_is_looked_at_as_well() -> None:
    """One of an older version may hand nonsense on."""
    ears = Ears()
    roster = Roster(cast("Any", ears), on_change=lambda: None)
    roster.take([msgspec.structs.replace(GOOD, battery_percent=1e9)])
    assert roster.robots["cart_1"].battery_percent is None
    assert ears.refused.total() == 1


@given(st.floats() | st.integers(-(2**70), 2**70), st.lists(st.text(max_size=100), max_size=300))
def test_no_state_shows_what_cannot_be(number: float, verbs: list[str]) -> None:
    """Whatever numbers and names it has: what is believed can be encoded and is in range."""
    fields = {"battery_percent": number, "speed_mps": number, "pose": {"x": number, "heading_deg": number}}
    info, _ = plausible(read_robot(json.dumps({"id": "r", "kind": "zenoh", "verbs": verbs, **fields}).encode()))
    assert msgspec.json.decode(encode(info), type=RobotInfo) == info
    assert info.battery_percent is None or 0 <= info.battery_percent <= 100
    assert info.speed_mps is None or abs(info.speed_mps) <= 1000
    assert info.pose is None or abs(info.pose.x) <= 2.1e7
    assert len(info.verbs) <= MAX_VERBS


# --- MAVLink -----------------------------------------------------------------------------------------------------


class Heard:
    """A vehicle, and what of it could not be."""

    def __init__(self) -> None:
        self.vehicle = Vehicle("drone_1", site=Site(), send=lambda _: None)
        self._codec = Codec(1, 1)
        self.hear("HEARTBEAT", **BEAT)
        self.hear("GLOBAL_POSITION_INT", **POSITION)
        self.hear("SYS_STATUS", **STATUS)
        self.hear("MISSION_CURRENT", **MISSION)

    def hear(self, name: str, **fields: Any) -> None:
        """Hear a message."""
        (frame,) = Codec(9, 9).read(self._codec.pack(make(name, **fields)))
        assert isinstance(frame, Frame)
        self.vehicle.hear(frame, 1.0)


POSITION: dict[str, Any] = {
    "time_boot_ms": 1, "lat": 473977420, "lon": 85455940, "alt": 500_000, "relative_alt": 5_000, "vx": 100, "vy": 0,
    "vz": 0, "hdg": 9000,
}  # fmt: skip
STATUS: dict[str, Any] = dict.fromkeys(
    (
        "onboard_control_sensors_present", "onboard_control_sensors_enabled", "onboard_control_sensors_health", "load",
        "voltage_battery", "current_battery", "drop_rate_comm", "errors_comm", "errors_count1", "errors_count2",
        "errors_count3", "errors_count4",
    ), 0,
) | {"battery_remaining": 77}  # fmt: skip
MISSION: dict[str, Any] = {"seq": 3, "total": 9, "mission_state": 3}


@pytest.mark.parametrize(
    ("name", "fields", "counted"),
    [
        ("GLOBAL_POSITION_INT", POSITION | {"lat": 2_000_000_000}, "position"),
        ("GLOBAL_POSITION_INT", POSITION | {"lon": -2_100_000_000}, "position"),
        ("GLOBAL_POSITION_INT", POSITION | {"alt": -(2**31)}, "position"),
        ("GLOBAL_POSITION_INT", POSITION | {"relative_alt": 2**31 - 1}, "position"),
        ("GLOBAL_POSITION_INT", POSITION | {"hdg": 40_000}, "heading"),
        ("SYS_STATUS", STATUS | {"battery_remaining": 120}, "battery"),
        ("SYS_STATUS", STATUS | {"battery_remaining": -50}, "battery"),
        ("HOME_POSITION", {"latitude": 2_000_000_000, "longitude": 0, "altitude": 0}, "home"),
        ("HOME_POSITION", {"latitude": 0, "longitude": 0, "altitude": 2**31 - 1}, "home"),
        ("MISSION_CURRENT", MISSION | {"seq": 65_535}, "mission item"),
        ("MISSION_CURRENT", MISSION | {"total": 60_000}, "mission items"),
    ],
)
def test_telemetry_that_cannot_be_changes_nothing(name: str, fields: dict[str, Any], counted: str) -> None:
    """What was known before stays, and it is counted by its field."""
    it = Heard()
    if name == "HOME_POSITION":
        fields = (
            fields | dict.fromkeys(("x", "y", "z", "approach_x", "approach_y", "approach_z"), 0.0) | {"q": [0.0] * 4}
        )
    before = it.vehicle.info("gw-1", ())
    it.hear(name, **fields)
    assert it.vehicle.info("gw-1", ()) == before
    assert it.vehicle.implausible == {counted: 1}
    assert plausible(before) == (before, ())


def test_the_rest_of_a_message_is_kept() -> None:
    """A position that cannot be does not cost the speed, a heading not the position, an item not the total."""
    it = Heard()
    it.hear("GLOBAL_POSITION_INT", **(POSITION | {"lat": 2_000_000_000, "vx": 300, "hdg": 18_000}))
    it.hear("MISSION_CURRENT", **(MISSION | {"seq": 65_535, "total": 12}))
    info = it.vehicle.info("gw-1", ())
    assert info.pose is not None
    assert (info.speed_mps, info.pose.heading_deg, info.mission_item, info.mission_items) == (3.0, 180.0, 3, 12)
    it.hear("GLOBAL_POSITION_INT", **(POSITION | {"hdg": 60_000, "lat": 473978420}))
    moved = it.vehicle.pose
    assert moved is not None
    assert moved.y != info.pose.y


_ANY: dict[str, Callable[[], st.SearchStrategy[int]]] = {
    "lat": lambda: st.integers(-(2**31), 2**31 - 1),
    "lon": lambda: st.integers(-(2**31), 2**31 - 1),
    "alt": lambda: st.integers(-(2**31), 2**31 - 1),
    "relative_alt": lambda: st.integers(-(2**31), 2**31 - 1),
    "vx": lambda: st.integers(-(2**15), 2**15 - 1),
    "hdg": lambda: st.integers(0, 2**16 - 1),
}


@given(st.fixed_dictionaries({name: make_() for name, make_ in _ANY.items()}), st.integers(-128, 127))
def test_whatever_a_vehicle_tells_its_row_can_be(fields: dict[str, int], battery: int) -> None:
    """Any numbers that the wire has room for."""
    it = Heard()
    it.hear("GLOBAL_POSITION_INT", **(POSITION | fields))
    it.hear("SYS_STATUS", **(STATUS | {"battery_remaining": battery}))
    info = it.vehicle.info("gw-1", ())
    assert plausible(info) == (info, ())
