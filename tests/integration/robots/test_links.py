"""What passes over a gateway's links beside vehicles' own business: the time, and keys that nobody may see."""

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest
from pymavlink import mavutil

from appliance.model import Site
from appliance.model.robot_api import MavlinkLink
from appliance.plane.session import Message, Session
from appliance.plane.settings import PlaneConfig
from appliance.plane.store import Store
from appliance.robots.hub import RobotHub
from appliance.robots.settings import RobotsConfig

pytestmark = pytest.mark.anyio
SECRET = bytes(range(200, 232))
_AUTOPILOT = (2, 3, 0, 4, 4)
_STATION = (6, 8, 0, 0, 4)


class Links:
    """A hub with a UDP link for vehicles and one for stations, and all that it puts on the plane."""

    def __init__(self, vehicles: int, stations: int) -> None:
        self.ports = {"vehicle": vehicles, "station": stations}
        self.told: list[Message] = []

    def end(self, kind: str, system: int) -> Any:
        """Connect to a link as one end of it does."""
        component = 1 if kind == "vehicle" else 190
        return mavutil.mavlink_connection(
            f"udpout:127.0.0.1:{self.ports[kind]}", source_system=system, source_component=component
        )


@pytest.fixture
async def links(free_ports: Callable[..., list[int]], tmp_path: Path) -> AsyncIterator[Links]:
    """Open them; everything is closed afterwards."""
    (plane,) = free_ports(1)
    vehicles, stations = free_ports(2, udp=True)
    async with contextlib.AsyncExitStack() as stack:
        session = await Session.open(PlaneConfig(listen=(f"tcp/127.0.0.1:{plane}",)), "links")
        stack.push_async_callback(session.close)
        store = await Store.open(tmp_path / "store.sqlite")
        stack.push_async_callback(store.close)
        config = RobotsConfig(
            mavlink=(
                MavlinkLink(listen=f"udp://127.0.0.1:{vehicles}"),
                MavlinkLink(listen=f"udp://127.0.0.1:{stations}"),
            ),
            timesync_s=0.2,
        )
        it = Links(vehicles, stations)
        session.subscribe("swiftbot/**", it.told.append)
        hub = RobotHub(config, session=session, store=store, gateway="gw-1", site=Site())
        await hub.start()
        stack.push_async_callback(hub.stop)
        yield it


def _heard(end: Any, kind: str, holds: Callable[[Any], bool], beat: tuple[int, ...], send: Callable[[], None]) -> Any:
    """Send, with heartbeats, until a message of that kind comes back."""
    for _ in range(100):
        end.mav.heartbeat_send(*beat)
        send()
        until = time.monotonic() + 0.3
        while time.monotonic() < until:
            found = end.recv_match(type=kind, blocking=True, timeout=0.1)
            if found is not None and holds(found):
                return found
    raise AssertionError(f"no {kind} came")


@pytest.mark.parametrize(("kind", "beat", "system"), [("vehicle", _AUTOPILOT, 7), ("station", _STATION, 255)])
async def test_who_asks_for_the_time_is_told_the_gateways(
    links: Links, kind: str, beat: tuple[int, ...], system: int
) -> None:
    """TIMESYNC with tc1 = 0 is answered with the asker's own stamp and the gateway's time, which goes on; recorded."""

    def ask() -> list[tuple[int, int]]:
        end = links.end(kind, system)
        try:
            found: list[tuple[int, int]] = []
            for number in (1, 2):
                stamps: list[int] = []

                def send(first: int = number * 10**12, stamps: list[int] = stamps) -> None:
                    stamps.append(first + len(stamps))
                    end.mav.timesync_send(0, stamps[-1])

                def mine(message: Any, stamps: list[int] = stamps) -> bool:
                    return message.ts1 in stamps and message.get_srcSystem() == 242

                answer = _heard(end, "TIMESYNC", mine, beat, send)
                found.append((answer.tc1, answer.get_srcComponent()))
            return found
        finally:
            end.close()

    before = time.monotonic_ns()
    (first, component), (then, _) = await asyncio.to_thread(ask)
    assert before < first < then < time.monotonic_ns()
    assert component == 191
    async with asyncio.timeout(60):
        while not any(first.to_bytes(8, "little") in each.payload for each in links.told if each.key.endswith("/tx")):
            await asyncio.sleep(0.05)


async def test_an_answer_is_not_answered_and_the_latency_is_still_told(links: Links) -> None:
    """The gateway's own questions are answered by the vehicle and end there: nobody answers an answer."""

    def fly() -> tuple[int, int]:
        end = links.end("vehicle", 7)
        asked = answered = 0
        try:
            until = time.monotonic() + 4.0
            while time.monotonic() < until:
                end.mav.heartbeat_send(*_AUTOPILOT)
                found = end.recv_match(type="TIMESYNC", blocking=True, timeout=0.1)
                if found is not None and found.tc1 == 0:
                    asked += 1
                    end.mav.timesync_send(5 * 10**9, found.ts1)
                elif found is not None:
                    answered += 1
            return asked, answered
        finally:
            end.close()

    asked, answered = await asyncio.to_thread(fly)
    assert asked > 0
    assert answered == 0
    async with asyncio.timeout(60):
        while not any(b'"latency":[{' in each.payload for each in links.told if each.key.endswith("/mavlink/links")):
            await asyncio.sleep(0.05)


@pytest.mark.parametrize("autopilot", [0, 8], ids=["generic", "none"])
async def test_a_router_that_calls_itself_a_station_is_heard(links: Links, autopilot: int) -> None:
    """What it asks of a vehicle reaches that, what the vehicle says reaches it, and it is no vehicle itself.

    By its documentation mavp2p beats so: MAVLink 1, a ground station, a generic autopilot, system 125, component 191.
    """

    def ask() -> tuple[int, int]:
        vehicle, router = links.end("vehicle", 7), links.end("station", 125)
        router.mav.srcComponent = 191
        try:
            for _ in range(100):
                vehicle.mav.heartbeat_send(*_AUTOPILOT)
                router.mav.heartbeat_send(6, autopilot, 0, 0, 4, force_mavlink1=True)
                router.mav.request_data_stream_send(7, 1, 0, 4, 1)
                found = vehicle.recv_match(type="REQUEST_DATA_STREAM", blocking=True, timeout=0.3)
                beat = router.recv_match(
                    type="HEARTBEAT", condition="HEARTBEAT.autopilot==3", blocking=True, timeout=0.3
                )
                if found is not None and beat is not None:
                    return found.get_srcSystem(), beat.get_srcSystem()
            raise AssertionError("it was not heard")
        finally:
            vehicle.close()
            router.close()

    assert await asyncio.to_thread(ask) == (125, 7)
    robots = {each.key.split("/")[3] for each in links.told if "/robot/" in each.key and each.key.endswith("/state")}
    assert len(robots) == 1


async def test_a_signing_key_is_passed_on_and_told_to_nobody(links: Links) -> None:
    """SETUP_SIGNING reaches the vehicle that it is for; what is put on the plane, and so recorded, has no key in it."""

    def set_up() -> bytes:
        vehicle, station = links.end("vehicle", 7), links.end("station", 255)
        try:
            for number in range(100):
                vehicle.mav.heartbeat_send(*_AUTOPILOT)
                station.mav.heartbeat_send(*_STATION)
                station.mav.setup_signing_send(7, 1, list(SECRET), 10**9 + number)
                found = vehicle.recv_match(type="SETUP_SIGNING", blocking=True, timeout=0.3)
                if found is not None:
                    return bytes(found.secret_key)
            raise AssertionError("it was not passed on")
        finally:
            vehicle.close()
            station.close()

    assert await asyncio.to_thread(set_up) == SECRET
    await asyncio.sleep(0.5)  # what is on its way
    frames = [each for each in links.told if each.key.endswith(("/rx", "/tx"))]
    assert {each.key.rsplit("/", 1)[1] for each in frames} == {"rx", "tx"}
    assert not any(SECRET in each.payload or SECRET[:8] in each.payload for each in links.told)
