"""The simulated vehicles beyond the copter's basics: rover, failsafes, parameters, missions back, what is on board."""

import math
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import ConfigError
from appliance.model import Place, Site
from appliance.robots.mavlink import dialect
from appliance.robots.mavlink.dialect import Codec, Frame, Message, make
from appliance.robots.mavlink.vehicle import ROVER, estimator
from workshop.robots.autopilot import AnyAutopilot
from workshop.robots.components import PITCH_DEG, Component, SimCamera, SimGimbal
from workshop.robots.copter import SimCopter
from workshop.robots.flight import Point
from workshop.robots.ground import ACCELERATION, BRAKE, TOP_MPS, Ground
from workshop.robots.mavlink import VehicleSettings, make_vehicle, read_parameters
from workshop.robots.rover import SimRover
from workshop.robots.telemetry import telemetry

_CODEC = Codec(245, 191)
SITE = Site(places={"home": Place(x=0.0, y=0.0)})


class Pilot:
    """Speaks to a vehicle in frames, without a network."""

    def __init__(self, vehicle: AnyAutopilot) -> None:
        self.vehicle = vehicle
        self.now = 0.0
        self.heard: list[Message] = []

    def frame(self, name: str, *, source: tuple[int, int] = (245, 191), **fields: Any) -> Frame:
        """Make a frame."""
        (frame,) = _CODEC.read(Codec(*source).pack(make(name, **fields)))
        assert isinstance(frame, Frame)
        return frame

    def send(self, name: str, **fields: Any) -> list[Message]:
        """Send a message; returns the answers."""
        return self.vehicle.handle(self.frame(name, **fields), self.now)

    def command(self, number: int, *values: float, to: Component | None = None, sender: int = 245) -> int:
        """Send COMMAND_LONG; returns the result."""
        padded = (*values, *([0.0] * 7))[:7]
        frame = self.frame(
            "COMMAND_LONG",
            source=(sender, 191),
            target_system=1,
            target_component=1 if to is None else to.number,
            command=number,
            confirmation=0,
            **{f"param{index + 1}": value for index, value in enumerate(padded)},
        )
        answers = self.vehicle.handle(frame, self.now) if to is None else to.handle(frame)
        self.heard += answers
        (ack,) = [each for each in answers if each.get_type() == "COMMAND_ACK"]
        return int(ack.result)

    def set(self, name: str, value: float) -> None:
        """Write a parameter, as a station does."""
        (answer,) = self.send(
            "PARAM_SET", target_system=1, target_component=1, param_id=name.encode(), param_value=value, param_type=9
        )
        assert answer.param_value == pytest.approx(value)

    def fly(self, seconds: float) -> list[str]:
        """Let time pass; returns the texts that were said."""
        said: list[Message] = []
        for _ in range(round(seconds * 10)):
            self.now += 0.1
            said += self.vehicle.step(0.1, self.now)
        return [str(each.text) for each in said if each.get_type() == "STATUSTEXT"]

    def up(self, height: float = 10.0) -> None:
        """Take a copter up."""
        self.command(dialect.SET_MODE, 1, 4)
        assert self.command(dialect.ARM, 1) == dialect.ACCEPTED
        self.command(dialect.TAKEOFF, 0, 0, 0, 0, 0, 0, height)
        self.fly(8)

    @property
    def mode(self) -> str:
        """Mode by name."""
        return self.vehicle.modes.name(self.vehicle.mode)

    @property
    def critical(self) -> bool:
        """Whether the heartbeat tells of a failsafe."""
        return self.vehicle.heartbeat().system_status == dialect.STATE_CRITICAL


def copter() -> Pilot:
    """A copter on the ground."""
    return Pilot(SimCopter(system=1, site=SITE, home=(0.0, 0.0)))


def rover() -> Pilot:
    """A rover at home."""
    return Pilot(SimRover(system=1, site=SITE, home=(0.0, 0.0)))


@pytest.mark.parametrize(
    ("parameters", "mode", "words"),
    [
        ({"SIM_GPS_DISABLE": 1}, "LAND", "EKF failsafe: landing"),
        ({"SIM_RC_FAIL": 1}, "RTL", "radio failsafe: returning"),
        ({"FENCE_ENABLE": 1, "FENCE_ALT_MAX": 5}, "RTL", "fence breached: returning"),
    ],
)
def test_failsafes_change_the_mode_and_tell(parameters: dict[str, float], mode: str, words: str) -> None:
    """Each failsafe changes the mode once, says so, shows in the heartbeat, and is over with its cause."""
    pilot = copter()
    pilot.up()
    for name, value in parameters.items():
        pilot.set(name, value)
    assert words in pilot.fly(0.5)
    assert (pilot.mode, pilot.critical) == (mode, True)
    assert words not in pilot.fly(0.5)
    for name in parameters:
        pilot.set(name, 0)
    pilot.fly(0.5)
    assert not pilot.critical


def test_a_lost_ground_station() -> None:
    """Only where it is enabled, only after the station was heard, and its return is seen."""
    pilot = copter()
    beat = {"type": 6, "autopilot": 8, "base_mode": 0, "custom_mode": 0, "system_status": 4, "mavlink_version": 3}
    pilot.up()
    pilot.set("FS_GCS_ENABLE", 1)
    pilot.fly(7)
    assert pilot.mode == "GUIDED"
    pilot.send("HEARTBEAT", source=(255, 190), **beat)
    assert pilot.fly(4) == []
    assert "GCS failsafe: returning" in pilot.fly(2)
    pilot.send("HEARTBEAT", source=(255, 190), **beat)
    assert "GCS failsafe cleared" in pilot.fly(0.5)


def test_arming_checks_have_their_words() -> None:
    """What speaks against arming is said as PreArm texts, by the check alone and by the attempt."""
    pilot = copter()
    pilot.command(dialect.SET_MODE, 1, 4)
    pilot.set("SIM_GPS_DISABLE", 1)
    pilot.set("SIM_RC_FAIL", 1)
    pilot.fly(0.2)
    for number, wanted in ((dialect.RUN_PREARM, dialect.ACCEPTED), (dialect.ARM, dialect.FAILED)):
        pilot.heard.clear()
        assert pilot.command(number, 1) == wanted
        texts = [str(each.text) for each in pilot.heard if each.get_type() == "STATUSTEXT"]
        assert texts == ["PreArm: Need Position Estimate", "PreArm: Radio failsafe on"]
    assert "no position" in estimator(telemetry(pilot.vehicle, "EKF_STATUS_REPORT", 0).flags)
    pilot.set("ARMING_CHECK", 0)
    assert pilot.command(dialect.ARM, 1) == dialect.ACCEPTED


def test_wind_that_is_too_strong_blows_it_away() -> None:
    """A moderate wind is flown against and costs battery; a storm takes it along."""
    used: list[float] = []
    for wind in (0, 8):
        pilot = copter()
        pilot.up()
        before = pilot.vehicle.flight.battery_percent
        pilot.set("SIM_WIND_SPD", wind)
        pilot.fly(20)
        used.append(before - pilot.vehicle.flight.battery_percent)
        assert math.hypot(*pilot.vehicle.flight.position[:2]) < 2.0
    assert used[1] > 1.2 * used[0]
    pilot.set("SIM_WIND_SPD", 20)
    pilot.set("SIM_WIND_DIR", 0)  # from the north
    pilot.fly(10)
    assert pilot.vehicle.flight.position.y < -20.0


def test_an_empty_battery_lets_it_fall() -> None:
    """Without charge the motors stop and it comes down."""
    pilot = copter()
    pilot.up()
    pilot.vehicle.flight.battery_percent = 0.0
    pilot.fly(5)
    assert not pilot.vehicle.flight.armed
    assert pilot.vehicle.flight.landed


def test_parameters_are_listed_and_read() -> None:
    """A list comes in portions, whole; one is read by name or number; an unknown one is met with silence."""
    pilot = copter()
    target = {"target_system": 1, "target_component": 1}
    assert pilot.send("PARAM_REQUEST_LIST", **target) == []
    told = [each for _ in range(10) for each in pilot.vehicle.step(0.1, 1.0) if each.get_type() == "PARAM_VALUE"]
    assert sorted(each.param_index for each in told) == list(range(told[0].param_count))
    (one,) = pilot.send("PARAM_REQUEST_READ", param_id=b"RTL_ALT", param_index=-1, **target)
    assert one.param_value == 800
    (same,) = pilot.send("PARAM_REQUEST_READ", param_id=b"", param_index=one.param_index, **target)
    assert same.param_value == 800
    assert pilot.send("PARAM_REQUEST_READ", param_id=b"NOTHING", param_index=-1, **target) == []
    with pytest.raises(ConfigError, match="no parameter 'NOTHING'"):
        make_vehicle(VehicleSettings(site=SITE, parameters={"NOTHING": 1.0}))


def test_parameters_from_the_command_line() -> None:
    """NAME=VALUE in any case; what is none of that is refused with the remedy."""
    assert read_parameters(["sim_wind_spd=6", "FENCE_ENABLE=1"]) == {"SIM_WIND_SPD": 6.0, "FENCE_ENABLE": 1.0}
    for wrong in ("SIM_WIND_SPD", "=3", "A=b", "A=nan", "A="):
        with pytest.raises(ConfigError, match="is no parameter"):
            read_parameters([wrong])


def upload(pilot: Pilot, *items: tuple[int, float, float, float, tuple[float, ...]]) -> None:
    """Upload a mission: command, metres north and east of home in units of 1e-7 degrees, height, parameters."""
    common = {"target_system": 1, "target_component": 1, "mission_type": 0}
    pilot.send("MISSION_COUNT", count=len(items), **common)
    for seq, (command, north, east, z, values) in enumerate(items):
        padded = (*values, 0.0, 0.0, 0.0, 0.0)[:4]
        answers = pilot.send(
            "MISSION_ITEM_INT",
            seq=seq,
            frame=dialect.FRAME_RELATIVE,
            command=command,
            current=0,
            autocontinue=1,
            x=round(SITE.latitude_deg * 1e7 + north),
            y=round(SITE.longitude_deg * 1e7 + east),
            z=z,
            **{f"param{index + 1}": value for index, value in enumerate(padded)},
            **common,
        )
    assert answers[0].type == dialect.MISSION_OK


def test_a_circle_and_a_return_by_mission() -> None:
    """LOITER_TURNS flies its laps at its radius, a picture is taken on the way, and the mission ends at home."""
    pilot = copter()
    upload(
        pilot,
        (dialect.WAYPOINT, 0, 0, 0, ()),
        (dialect.TAKEOFF, 0, 0, 8, ()),
        (dialect.LOITER_TURNS, 2000, 0, 8, (2.0, 0.0, 6.0)),
        (dialect.IMAGE_START, 0, 0, 0, (0.0, 0.0, 1.0)),
        (dialect.RETURN, 0, 0, 0, ()),
    )
    pilot.command(dialect.SET_MODE, 1, 4)
    pilot.command(dialect.ARM, 1)
    assert pilot.command(dialect.MISSION_START) == dialect.ACCEPTED
    assert pilot.mode == "AUTO"
    centre = Point(0.0, 22.2, 8.0)
    angles: list[float] = []
    for _ in range(1500):
        pilot.fly(0.1)
        x, y, _ = pilot.vehicle.flight.position
        if pilot.vehicle.at == 2 and abs(math.hypot(x - centre.x, y - centre.y) - 6.0) < 0.9:
            angles.append(math.atan2(x - centre.x, y - centre.y))
        if not pilot.vehicle.flight.armed:
            break
    turned = sum(math.remainder(new - old, math.tau) for old, new in pairwise(angles))
    assert turned == pytest.approx(2 * math.tau, rel=0.2)
    assert pilot.vehicle.pictures == 1
    assert not pilot.vehicle.flight.armed
    assert math.hypot(*pilot.vehicle.flight.position[:2]) < 1.0


def test_a_mission_is_told_as_it_came() -> None:
    """Items are read back as they were uploaded, in both forms; one that does not exist is an error."""
    pilot = copter()
    upload(pilot, (dialect.WAYPOINT, 0, 0, 0, ()), (dialect.WAYPOINT, 1234, -4321, 7.5, (2.0,)))
    common = {"target_system": 1, "target_component": 1, "mission_type": 0}
    assert pilot.send("MISSION_REQUEST_LIST", **common)[0].count == 2
    (item,) = pilot.send("MISSION_REQUEST_INT", seq=1, **common)
    assert (item.x - round(SITE.latitude_deg * 1e7), item.z, item.param1) == (1234, 7.5, 2.0)
    (item,) = pilot.send("MISSION_REQUEST", seq=1, **common)
    assert item.x == pytest.approx(SITE.latitude_deg + 1.234e-4, abs=1e-5)
    (error,) = pilot.send("MISSION_REQUEST_INT", seq=9, **common)
    assert error.type == dialect.MISSION_SEQUENCE


def test_a_rover_drives_a_mission_and_home() -> None:
    """It arms in GUIDED, drives through its waypoints, and RTL brings it home; it does not take off."""
    pilot = rover()
    upload(
        pilot,
        (dialect.WAYPOINT, 0, 0, 0, ()),
        (dialect.CHANGE_SPEED, 0, 0, 0, (1.0, 1.5)),
        (dialect.WAYPOINT, 900, 0, 0, ()),
        (dialect.WAYPOINT, 900, 1200, 0, (2.0,)),
    )
    pilot.command(dialect.SET_MODE, 1, ROVER.numbers["GUIDED"])
    assert pilot.command(dialect.ARM, 1) == dialect.ACCEPTED
    assert pilot.command(dialect.TAKEOFF, 0, 0, 0, 0, 0, 0, 5) == dialect.UNSUPPORTED
    pilot.command(dialect.SET_MODE, 1, ROVER.numbers["AUTO"])
    pilot.fly(30)
    assert pilot.vehicle.complete
    assert pilot.vehicle.flight.near(Point(9.05, 10.0, 0.0), 1.0)
    pilot.command(dialect.SET_MODE, 1, ROVER.numbers["RTL"])
    pilot.fly(30)
    assert pilot.vehicle.flight.near(Point(0.0, 0.0, 0.0), 0.5)
    pilot.command(dialect.SET_MODE, 1, ROVER.numbers["GUIDED"])
    pilot.set("SIM_RC_FAIL", 1)
    pilot.fly(0.5)
    assert (pilot.mode, pilot.critical) == ("HOLD", True)


@given(x=st.floats(-40, 40), y=st.floats(-40, 40), speed=st.floats(0.3, 10.0))
def test_a_rover_keeps_to_its_limits(x: float, y: float, speed: float) -> None:
    """It arrives, never faster than it can, nor changing speed faster than it can brake."""
    ground = Ground(speed=speed)
    ground.armed = True
    ground.target = Point(x, y, 0.0)
    for _ in range(6000):
        before = math.hypot(*ground.velocity[:2])
        ground.step(0.05)
        now = math.hypot(*ground.velocity[:2])
        assert now <= min(speed, TOP_MPS) + 1e-6
        assert abs(now - before) <= max(ACCELERATION, BRAKE) * 0.05 + 1e-6
        if ground.near(ground.target, 0.2):
            break
    assert ground.near(ground.target, 0.2)


def test_sticks_fly_it_by_hand_and_not_in_guided() -> None:
    """An override moves it in LOITER, not in GUIDED, and stops moving it when it is silent."""
    pilot = copter()
    pilot.up()
    sticks = {f"chan{number}_raw": 0 for number in range(1, 9)} | {"target_system": 1, "target_component": 1}
    sticks |= {"chan1_raw": 2000}
    pilot.send("RC_CHANNELS_OVERRIDE", **sticks)
    pilot.fly(2)
    assert math.hypot(*pilot.vehicle.flight.position[:2]) < 0.5
    pilot.command(dialect.SET_MODE, 1, 5)
    pilot.send("RC_CHANNELS_OVERRIDE", **sticks)
    pilot.fly(2)
    assert math.hypot(*pilot.vehicle.flight.position[:2]) > 2.0
    pilot.fly(5)
    assert math.hypot(*pilot.vehicle.flight.velocity[:2]) < 0.3


def test_the_camera_counts_orders_not_messages() -> None:
    """A repeated order is one picture and tells the same; recording shows in the status."""
    pilot = copter()
    camera = SimCamera(pilot.vehicle)
    assert pilot.command(dialect.IMAGE_START, 0, 0, 1, 77, to=camera) == dialect.ACCEPTED
    assert pilot.command(dialect.IMAGE_START, 0, 0, 1, 77, to=camera) == dialect.ACCEPTED
    assert camera.count == 1
    assert pilot.command(dialect.IMAGE_START, 0, 0, 1, 78, to=camera) == dialect.ACCEPTED
    assert camera.count == 2
    assert pilot.command(dialect.VIDEO_START, to=camera) == dialect.ACCEPTED
    status = dialect.constant("MAVLINK_MSG_ID_CAMERA_CAPTURE_STATUS")
    pilot.command(dialect.REQUEST_MESSAGE, status, to=camera)
    assert (pilot.heard[-1].video_status, pilot.heard[-1].image_count) == (1, 2)
    assert pilot.command(31010, to=camera) == dialect.UNSUPPORTED


def test_the_gimbal_turns_for_whoever_is_in_control() -> None:
    """Without control it is denied, beyond its limits too; with it it turns at its rate, and keeps a point in view."""
    pilot = copter()
    gimbal = SimGimbal(pilot.vehicle)
    assert pilot.command(dialect.GIMBAL_ANGLES, -30, 20, to=gimbal) == dialect.DENIED
    configure = dialect.constant("MAV_CMD_DO_GIMBAL_MANAGER_CONFIGURE")
    pilot.command(configure, -2, -2, -1, -1, to=gimbal)
    assert pilot.command(dialect.GIMBAL_ANGLES, PITCH_DEG[0] - 1, 0, to=gimbal) == dialect.DENIED
    assert pilot.command(dialect.GIMBAL_ANGLES, -30, 20, to=gimbal) == dialect.ACCEPTED
    assert pilot.command(dialect.GIMBAL_ANGLES, 0, 0, to=gimbal, sender=9) == dialect.DENIED
    gimbal.step(0.1, 0.0)
    assert gimbal.pitch_deg == pytest.approx(-6.0)
    gimbal.step(1.0, 1.0)
    assert (gimbal.pitch_deg, gimbal.yaw_deg) == pytest.approx((-30, 20))
    pilot.vehicle.flight.position = Point(0.0, 0.0, 10.0)
    at = (SITE.latitude_deg, SITE.longitude_deg + 1.327e-4, SITE.altitude_m)  # 10 m east, on the ground
    assert pilot.command(dialect.LOOK_AT, 0, 0, 0, 0, *at, to=gimbal) == dialect.ACCEPTED
    for _ in range(30):
        gimbal.step(0.1, 2.0)
    assert (gimbal.pitch_deg, gimbal.yaw_deg) == pytest.approx((-45, 90), abs=2.0)
