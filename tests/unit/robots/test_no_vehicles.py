"""Senders that are no vehicle make no robot: addresses for all, ground stations, cameras; and rows can be removed."""

import asyncio
import itertools
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import pytest
from pymavlink.dialects.v20 import ardupilotmega

from appliance.errors import NotFoundError, RefusedError
from appliance.model import RobotInfo, Site
from appliance.model.robot_api import RobotForget
from appliance.plane.registry import Roster
from appliance.ports import free_port
from appliance.robots.hub import RobotHub
from appliance.robots.mavlink.dialect import VEHICLES, Codec, frame_length, label, make
from appliance.robots.settings import RobotsConfig
from tests.unit.robots.conftest import FakeStore
from tests.unit.robots.links import BEAT, LINKS, Wire, beside, sender, station, until

pytestmark = pytest.mark.anyio
NONE = [(0, 1), (0, 0), (1, 0), (255, 190), (1, 100), (9, 191)]
"""Systems and components: addresses, a ground station, a camera, a companion computer."""


@pytest.mark.parametrize("kind", LINKS)
async def test_no_sender_that_is_none_makes_a_robot(kind: str) -> None:
    """Whatever type and autopilot they name. System 0 is counted, and nothing of it is learned or passed on."""
    async with beside(kind) as (made, refused, outside, vehicle):
        codecs, real = [Codec(*each) for each in NONE], Codec(77, 1)

        def act() -> None:
            outside.write(*(each.pack(make("HEARTBEAT", **BEAT)) for each in codecs))
            vehicle(real.pack(make("HEARTBEAT", **BEAT)))

        await until(lambda: made.vehicles.attached and refused.get("no_sender", 0) > 5, act)
        assert made.vehicles.attached == ("drone_77",)
        assert not [each for each in made.routing.routes if each[0] == 0]
        assert all(each.system for link in made.link_list().links for each in link.senders)


_TYPES: dict[int, Any] = ardupilotmega.enums["MAV_TYPE"]
_COMPONENTS = [each for each in _TYPES if each not in VEHICLES and not _TYPES[each].name.endswith("ENUM_END")]


def test_types_that_move_are_vehicles() -> None:
    """Each type of MAVLink is one or the other; a new one has to be looked at here."""
    names = {label("MAV_TYPE", each).removeprefix("MAV_TYPE_") for each in _COMPONENTS}
    assert names == {
        "GENERIC", "ANTENNA_TRACKER", "GCS", "ONBOARD_CONTROLLER", "GIMBAL", "ADSB", "CAMERA", "CHARGING_STATION",
        "FLARM", "SERVO", "ODID", "BATTERY", "PARACHUTE", "LOG", "OSD", "IMU", "GPS", "WINCH", "ILLUMINATOR", "GRIPPER",
    }  # fmt: skip


@pytest.mark.parametrize("kind", ["udp listen", "tcp listen"])
async def test_components_that_name_an_autopilot_make_no_robot(kind: str) -> None:
    """Whatever autopilot they name, also a type that nobody knows; vehicles of each type do."""
    async with beside(kind, sender_hz=0.0, max_vehicles=250) as (made, _, outside, vehicle):
        types = [*_COMPONENTS, 200]
        frames = [
            Codec(number + 1, 1).pack(make("HEARTBEAT", **(BEAT | {"type": each, "autopilot": autopilot})))
            for number, (each, autopilot) in enumerate(itertools.product(types, (0, 3, 12)))
        ]
        codecs = {Codec(150 + number, 1): each for number, each in enumerate(sorted(VEHICLES))}

        def act() -> None:
            outside.write(*frames)
            for codec, each in codecs.items():
                vehicle(codec.pack(make("HEARTBEAT", **(BEAT | {"type": each}))))

        await until(lambda: len(made.vehicles.attached) >= len(VEHICLES), act)
        await until(lambda: len(made.vehicles._guests) >= len(frames), act)
        assert {int(each.removeprefix("drone_")) for each in made.vehicles.attached} == {each.system for each in codecs}


async def test_a_vehicle_is_not_made_a_gimbal() -> None:
    """A heartbeat with its address and another type changes nothing of it."""
    port = free_port(socket.SOCK_DGRAM)
    async with station(port) as (made, _), sender(port) as send:
        codec = Codec(7, 1)
        await until(lambda: made.vehicles.attached, lambda: send(codec.pack(make("HEARTBEAT", **BEAT))))
        (each,) = made.vehicles._vehicles.values()
        odd = BEAT | {"type": 26, "custom_mode": 9, "base_mode": 128}
        before = made.link_list().links[0].frames_in
        await until(
            lambda: made.link_list().links[0].frames_in > before + 3,
            lambda: send(codec.pack(make("HEARTBEAT", **odd))),
        )
        assert (each.vehicle.kind, each.vehicle.mode, each.vehicle.armed) == (2, "GUIDED", False)


async def test_a_real_flight_makes_one_robot(data: Path) -> None:
    """A log with a submarine, its companion computer, its camera manager and its ground station: one robot."""
    log = (data / "mavlink/ardusub-4.1.1-small.tlog").read_bytes()
    for route in (True, False):
        async with station(free_port(socket.SOCK_DGRAM), sender_hz=0.0, route=route) as (made, _):
            (entry,) = tuple(made.links)
            cast("Any", entry.link)._write = lambda *_: True
            at = 0
            while at < len(log):
                length = frame_length(log, at + 8) or 0
                entry.link.feed(log[at + 8 : at + 8 + length], ("127.0.0.1", 14550))
                at += 8 + length
            assert made.vehicles.attached == ("drone_1",)


class Hub:
    """A hub around a station, with the roster as the test has it."""

    def __init__(self, made: Any) -> None:
        self.roster: dict[str, RobotInfo] = {}
        self.deleted: list[str] = []
        wire: Any = Wire()
        wire.delete = self.deleted.append
        self.hub = RobotHub(
            RobotsConfig(), session=wire, store=FakeStore(), gateway="gw-1", site=Site(), roster=self.roster,
            keeps_ground=lambda robot: robot == "rover_9",
        )  # fmt: skip
        self.hub._mavlink = made


async def test_a_robot_that_is_gone_can_be_forgotten() -> None:
    """Its row is deleted, and heard again it is a robot again; one that is online or unknown is refused."""
    port = free_port(socket.SOCK_DGRAM)
    async with station(port, heartbeat_lost_s=0.3) as (made, _), sender(port) as send:
        codec, it = Codec(7, 1), Hub(made)
        beat: Callable[[], None] = lambda: send(codec.pack(make("HEARTBEAT", **BEAT)))  # noqa: E731
        await until(lambda: made.vehicles.online("drone_7"), beat)
        with pytest.raises(RefusedError, match="drone_7 is online"):
            await it.hub.forget(RobotForget(robot="drone_7"))
        await until(lambda: not made.vehicles.online("drone_7"))
        done = await it.hub.forget(RobotForget(robot="drone_7", by="ann"))
        assert (done.robot, done.gateway, made.vehicles.attached) == ("drone_7", "gw-1", ())
        assert it.deleted == ["swiftbot/test/robot/drone_7/state"]
        with pytest.raises(NotFoundError, match="no robot 'drone_7'"):
            await it.hub.forget(RobotForget(robot="drone_7"))
        await until(lambda: made.vehicles.online("drone_7"), beat)
        it.roster["rover_1"] = RobotInfo(id="rover_1", kind="zenoh")
        with pytest.raises(RefusedError, match="rover_1 is online"):
            await it.hub.forget(RobotForget(robot="rover_1"))
        it.roster["rover_1"] = RobotInfo(id="rover_1", kind="zenoh", online=False)
        await it.hub.forget(RobotForget(robot="rover_1"))
        assert it.deleted[1:] == ["swiftbot/test/robot/rover_1/state"]
        await it.hub.forget(RobotForget(robot="rover_9"))  # off the roster for long, but its ground is still kept


async def test_a_deleted_row_is_gone_from_rosters() -> None:
    """At once, and counted as a change; what never was there is none."""
    changes: list[int] = []
    roster = Roster(cast("Any", Wire()), on_change=lambda: changes.append(1))
    roster._on_robot("swiftbot/test/robot/r/state", RobotInfo(id="r", kind="zenoh", online=False))
    roster._on_robot("swiftbot/test/robot/r/state", None)
    roster._on_robot("swiftbot/test/robot/r/state", None)
    await asyncio.sleep(0)
    assert (roster.robots, len(changes)) == ({}, 2)
