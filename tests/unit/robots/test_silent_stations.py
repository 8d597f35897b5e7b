"""Stations that never send a heartbeat: any frame tells where they are, as to any MAVLink router."""

import asyncio
import socket
from collections.abc import AsyncGenerator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from typing import Any

import pytest

from appliance.model.robot_api import MavlinkLink
from appliance.ports import free_port
from appliance.robots.mavlink.dialect import Codec, Frame, make
from appliance.robots.settings import Template
from tests.unit.robots.links import BEAT, LINKS, Outside, beside, sender, station, until

pytestmark = pytest.mark.anyio


@asynccontextmanager
async def ear(port: int) -> AsyncGenerator[tuple[Callable[[bytes], None], list[Frame]]]:
    """Open an end that sends to a UDP port and keeps the frames that come back."""
    heard: list[Frame] = []

    class End(asyncio.DatagramProtocol):
        def datagram_received(self, data: bytes, addr: Any) -> None:
            del addr
            heard.extend(each for each in Codec(9, 9).read(data) if isinstance(each, Frame))

    transport, _ = await asyncio.get_running_loop().create_datagram_endpoint(End, remote_addr=("127.0.0.1", port))
    try:
        yield transport.sendto, heard
    finally:
        transport.close()


async def test_a_station_without_a_heartbeat_is_routed_and_answered() -> None:
    """What it asks of a vehicle arrives, what that says comes back, and the gateway itself answers it."""
    one, two = free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_DGRAM)
    templates = (Template(id=1, instruction="photograph the gate"),)
    async with (
        station(one, MavlinkLink(listen=f"udp://127.0.0.1:{two}"), templates=templates) as (made, refused),
        ear(one) as (vehicle, at_vehicle),
        ear(two) as (ground, at_ground),
    ):
        codec, asker = Codec(1, 1), Codec(255, 190)
        await until(lambda: made.vehicles.attached, lambda: vehicle(codec.pack(make("HEARTBEAT", **BEAT))))
        ask = {"target_system": 1, "target_component": 1}
        await until(
            lambda: any(each.name == "PARAM_REQUEST_READ" for each in at_vehicle),
            lambda: ground(asker.pack(make("PARAM_REQUEST_READ", param_id=b"X", param_index=-1, **ask))),
        )
        assert (255, 190) in made.routing.routes
        await until(
            lambda: any(each.name == "HEARTBEAT" and each.system == 1 for each in at_ground),
            lambda: vehicle(codec.pack(make("HEARTBEAT", **BEAT))),
        )
        numbers = {f"param{number}": 0.0 for number in range(2, 8)}
        order = {"target_system": 242, "target_component": 191, "command": 31010, "confirmation": 0, "param1": 1.0}
        ground(asker.pack(make("COMMAND_LONG", **order, **numbers)))
        await until(lambda: any(each.name == "COMMAND_ACK" and each.message.result == 0 for each in at_ground))
        await until(
            lambda: any(each.name == "TIMESYNC" for each in at_ground),
            lambda: ground(asker.pack(make("TIMESYNC", tc1=0, ts1=77))),
        )
        assert "unknown_system" not in refused
        assert made.vehicles.attached == ("drone_1",)


@pytest.mark.parametrize("kind", LINKS)
async def test_on_any_link_its_frames_arrive(kind: str) -> None:
    """Also where it connects to, and over a serial port."""
    port, outside = free_port(socket.SOCK_DGRAM), Outside(kind)
    async with AsyncExitStack() as closing:
        link = await outside.prepare(closing)
        made, _ = await closing.enter_async_context(station(port, link))
        await outside.meet(made, closing)
        vehicle, heard = await closing.enter_async_context(ear(port))
        codec, asker = Codec(1, 1), Codec(255, 190)
        await until(lambda: made.vehicles.attached, lambda: vehicle(codec.pack(make("HEARTBEAT", **BEAT))))
        ask = make("PARAM_REQUEST_LIST", target_system=1, target_component=1)
        await until(
            lambda: any(each.name == "PARAM_REQUEST_LIST" for each in heard), lambda: outside.write(asker.pack(ask))
        )


async def test_who_takes_a_vehicles_address_is_not_learned() -> None:
    """Another with its system and component on a second link is no guest: what is for the vehicle goes to it alone."""
    async with beside("udp listen") as (made, refused, outside, vehicle):
        one, two = Codec(1, 1), Codec(1, 1)
        two._mav.seq = 100
        await until(lambda: made.vehicles.attached, lambda: vehicle(one.pack(make("HEARTBEAT", **BEAT))))
        before = made.routing.where(1, 1)
        time = {"time_unix_usec": 1, "time_boot_ms": 1}
        await until(
            lambda: refused.get("unknown_system", 0) > 3, lambda: outside.write(two.pack(make("SYSTEM_TIME", **time)))
        )
        assert made.routing.where(1, 1) == before
        # One whose name is taken, or that may have none, is not learned of by its other frames either.
        await until(
            lambda: refused.get("name_conflict", 0) > 3, lambda: outside.write(two.pack(make("HEARTBEAT", **BEAT)))
        )
        assert made.routing.where(1, 1) == before


async def test_vehicles_that_may_not_be_robots_are_not_routed() -> None:
    """A link that accepts no further vehicles does not pass on what they say once they have said what they are."""
    port = free_port(socket.SOCK_DGRAM)
    async with station(port, max_vehicles=1) as (made, refused), sender(port) as send:
        one, two = Codec(1, 1), Codec(2, 1)
        await until(lambda: made.vehicles.attached, lambda: send(one.pack(make("HEARTBEAT", **BEAT))))
        await until(lambda: refused.get("unknown_system", 0) > 3, lambda: send(two.pack(make("HEARTBEAT", **BEAT))))
        time = {"time_unix_usec": 1, "time_boot_ms": 1}
        before = refused["unknown_system"]
        await until(lambda: refused["unknown_system"] > before + 3, lambda: send(two.pack(make("SYSTEM_TIME", **time))))
        assert (2, 1) not in made.routing.routes
