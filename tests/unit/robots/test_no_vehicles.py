"""Senders that are no vehicle make no robot: addresses for all, ground stations, cameras; and rows can be removed."""

import asyncio
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import pytest

from appliance.errors import NotFoundError, RefusedError
from appliance.model import RobotInfo
from appliance.plane.roster import Roster
from appliance.ports import free_port
from appliance.robots.api import RobotForget
from appliance.robots.hub import RobotHub
from appliance.robots.mavlink.dialect import Codec, frame_length, make
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

        await until(lambda: made.attached and refused.get("no_sender", 0) > 5, act)
        assert made.attached == ("drone_77",)
        assert not [each for each in made._switch.router.routes if each[0] == 0]
        assert all(each.system for link in made.link_list().links for each in link.senders)


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
            assert made.attached == ("drone_1",)


class Hub:
    """A hub around a station, with the roster as the test has it."""

    def __init__(self, made: Any) -> None:
        self.roster: dict[str, RobotInfo] = {}
        self.deleted: list[str] = []
        wire: Any = Wire()
        wire.delete = self.deleted.append
        self.hub = RobotHub(
            RobotsConfig(), session=wire, store=FakeStore(), gateway="gw-1", site=made._site, roster=self.roster
        )
        self.hub._station = made


async def test_a_robot_that_is_gone_can_be_forgotten() -> None:
    """Its row is deleted, and heard again it is a robot again; one that is online or unknown is refused."""
    port = free_port(socket.SOCK_DGRAM)
    async with station(port, heartbeat_lost_s=0.3) as (made, _), sender(port) as send:
        codec, it = Codec(7, 1), Hub(made)
        beat: Callable[[], None] = lambda: send(codec.pack(make("HEARTBEAT", **BEAT)))  # noqa: E731
        await until(lambda: made.online("drone_7"), beat)
        with pytest.raises(RefusedError, match="drone_7 is online"):
            await it.hub.forget(RobotForget(robot="drone_7"))
        await until(lambda: not made.online("drone_7"))
        done = await it.hub.forget(RobotForget(robot="drone_7", by="ann"))
        assert (done.robot, done.gateway, made.attached) == ("drone_7", "gw-1", ())
        assert it.deleted == ["swiftbot/test/robot/drone_7/state"]
        with pytest.raises(NotFoundError, match="no robot 'drone_7'"):
            await it.hub.forget(RobotForget(robot="drone_7"))
        await until(lambda: made.online("drone_7"), beat)
        it.roster["rover_1"] = RobotInfo(id="rover_1", kind="zenoh")
        with pytest.raises(RefusedError, match="rover_1 is online"):
            await it.hub.forget(RobotForget(robot="rover_1"))
        it.roster["rover_1"] = RobotInfo(id="rover_1", kind="zenoh", online=False)
        await it.hub.forget(RobotForget(robot="rover_1"))
        assert it.deleted[1:] == ["swiftbot/test/robot/rover_1/state"]


async def test_a_deleted_row_is_gone_from_rosters() -> None:
    """At once, and counted as a change; what never was there is none."""
    changes: list[int] = []
    roster = Roster(cast("Any", Wire()), on_change=lambda: changes.append(1))
    roster._on_robot("swiftbot/test/robot/r/state", RobotInfo(id="r", kind="zenoh", online=False))
    roster._on_robot("swiftbot/test/robot/r/state", None)
    roster._on_robot("swiftbot/test/robot/r/state", None)
    await asyncio.sleep(0)
    assert (roster.robots, len(changes)) == ({}, 2)
