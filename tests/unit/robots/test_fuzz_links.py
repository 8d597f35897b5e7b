"""Whatever comes on a link: counted or dropped, never a crash, never growth, and the others are served."""

import asyncio
import contextlib
import os
import pty
import socket
import tty
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any, cast

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.model import RobotInfo, Site, TaskRecord, TaskRequest
from appliance.robots.doors import Tasks
from appliance.robots.mavlink.dialect import Codec, Damage, Frame, Stream, make
from appliance.robots.mavlink.kinds import KINDS, checksum, decode
from appliance.robots.mavlink.signing import Signer
from appliance.robots.mavlink.station import Station
from appliance.robots.mavlink.tunnel import MAX_PAYLOAD, PAYLOAD_TYPE
from appliance.robots.settings import MavlinkLink, RobotsConfig
from tests.unit.robots.conftest import FakeSession, FakeStore

pytestmark = pytest.mark.anyio

BEAT = {"type": 2, "autopilot": 3, "base_mode": 0, "custom_mode": 4, "system_status": 4, "mavlink_version": 3}
KEY = bytes(range(32))


class Wire(FakeSession):
    """A plane that nobody listens to: a real one is in tests/integration."""

    unsent = 0

    def subscribe_typed(self, *_: object, **__: object) -> "Wire":
        """Subscribe."""
        return self

    def watch_alive(self, *_: object) -> "Wire":
        """Watch."""
        return self

    def declare_alive(self, _: str) -> "Wire":
        """Declare."""
        return self

    def serve(self, *_: object, **__: object) -> "Wire":
        """Serve."""
        return self

    def close(self) -> None:
        """Close."""


@asynccontextmanager
async def station(port: int, *more: MavlinkLink, **changes: Any) -> AsyncIterator[tuple[Station, dict[str, int]]]:
    """Open a station on a UDP port, with further links."""
    refused: dict[str, int] = {}

    async def submit(request: TaskRequest) -> TaskRecord:
        return TaskRecord(id=request.id, instruction=request.instruction)

    async def look(task: str) -> TaskRecord:
        return TaskRecord(id=task, instruction="")

    made = Station(
        RobotsConfig(mavlink=(MavlinkLink(listen=f"udp://127.0.0.1:{port}"), *more), **changes),
        session=cast("Any", Wire()),
        store=FakeStore(),
        gateway="gw-1",
        site=Site(),
        refused=refused,
        tasks=Tasks(submit=submit, cancel=lambda task, _: look(task), look=look),
    )
    await made.start()
    try:
        yield made, refused
    finally:
        await made.stop()


@asynccontextmanager
async def sender(port: int) -> AsyncIterator[Callable[[bytes], None]]:
    """Open a socket that sends to a port."""
    transport, _ = await asyncio.get_running_loop().create_datagram_endpoint(
        asyncio.DatagramProtocol, remote_addr=("127.0.0.1", port)
    )
    try:
        yield transport.sendto
    finally:
        transport.close()


async def until(holds: Callable[[], object], act: Callable[[], object] = lambda: None) -> None:
    """Wait until something is so, doing something again and again meanwhile."""
    async with asyncio.timeout(60):
        while not holds():
            act()
            await asyncio.sleep(0.02)


raws = st.one_of(
    st.binary(max_size=300),
    st.tuples(st.sampled_from(sorted(KINDS)), st.binary(max_size=255), st.integers(0, 255), st.integers(0, 255)).map(
        lambda each: framed(*each)
    ),
    st.tuples(st.binary(max_size=128), st.integers(0, 255)).map(lambda each: tunnel(*each)),
)


def framed(number: int, payload: bytes, system: int, component: int) -> bytes:
    """Return a frame with a right checksum and any payload at all."""
    payload = payload or b"\0"
    head = bytes((len(payload), 0, 0, 1, system, component, number & 255, number >> 8 & 255, number >> 16))
    return b"\xfd" + head + payload + checksum(head + payload + KINDS[number].extra).to_bytes(2, "little")


def tunnel(payload: bytes, length: int) -> bytes:
    """Return a TUNNEL frame for the gateway whose announced length need not be true."""
    return Codec(255, 190).pack(
        make(
            "TUNNEL", target_system=242, target_component=191, payload_type=PAYLOAD_TYPE, payload_length=length,
            payload=list(payload.ljust(MAX_PAYLOAD, b"\0")),
        )
    )  # fmt: skip


@given(st.sampled_from(sorted(KINDS)), st.binary(max_size=255))
def test_any_payload_of_any_message_is_decoded(number: int, payload: bytes) -> None:
    """A frame whose checksum is right has fields, however short or long its payload is."""
    (frame,) = Codec(9, 9).read(framed(number, payload, 1, 1))
    assert isinstance(frame, Frame)
    assert decode(frame.raw).get_type() == frame.name == KINDS[number].name


@given(st.lists(raws, max_size=20), st.integers(1, 400), st.booleans())
def test_streams_of_anything(parts: list[bytes], size: int, signed: bool) -> None:
    """However cut, signed or not: every byte is a frame's, damage's or waits, and at most one frame waits."""
    whole = b"".join(parts)
    stream = Stream(Codec(9, 9, signer=Signer(KEY, link_id=0) if signed else None))
    used = 0
    for start in range(0, len(whole), size):
        for found in stream.feed(whole[start : start + size]):
            used += found.length if isinstance(found, Damage) else len(found.raw)
        assert stream.pending <= 280
    assert used + stream.pending == len(whole)


@settings(max_examples=15)
@given(st.lists(raws, min_size=1, max_size=60))
async def test_a_gateway_that_hears_anything(datagrams: list[bytes]) -> None:
    """Random bytes, good frames with random payloads, tunnels that lie: a vehicle that speaks meanwhile is heard."""
    port = _port()
    async with station(port) as (made, refused), sender(port) as stranger, sender(port) as vehicle:
        codec = Codec(77, 1)
        for raw in datagrams:
            stranger(raw)
        # A stranger may have taken the vehicle's name before: then both are told apart, and that is counted.
        await until(
            lambda: "drone_77" in made.attached and any(each.senders for each in made.link_list().links),
            lambda: vehicle(codec.pack(make("HEARTBEAT", **BEAT))),
        )
        assert all(count >= 0 for count in refused.values())


@settings(max_examples=10)
@given(st.lists(raws, min_size=1, max_size=60))
async def test_a_stream_that_brings_anything(datagrams: list[bytes]) -> None:
    """The same over TCP: what is no frame is skipped, what is one is found behind it, and others are served."""
    port, stream = _port(), _port(socket.SOCK_STREAM)
    async with (
        station(port, MavlinkLink(listen=f"tcp://127.0.0.1:{stream}")) as (made, refused),
        sender(port) as vehicle,
    ):
        _, writer = await asyncio.open_connection("127.0.0.1", stream)
        for raw in datagrams:
            writer.write(raw)
        await writer.drain()
        await _served(made, vehicle)
        # Behind all that the stream is understood again: at the latest when the longest frame that it may have begun
        # is at its end.
        codec = Codec(78, 1)
        await until(
            lambda: any(each.system == 78 for link in made.link_list().links for each in link.senders),
            lambda: writer.write(codec.pack(make("HEARTBEAT", **BEAT)) + bytes(280)),
        )
        writer.close()
        assert all(count >= 0 for count in refused.values())


@settings(max_examples=10)
@given(st.lists(raws, min_size=1, max_size=60))
async def test_a_serial_port_that_brings_anything(datagrams: list[bytes]) -> None:
    """The same over a serial port (a pseudo-terminal): a radio's noise keeps nobody else from being served."""
    port = _port()
    master, slave = pty.openpty()
    tty.setraw(master)
    os.set_blocking(master, False)
    device = MavlinkLink(connect=f"serial:{os.ttyname(slave)}:57600")
    try:
        async with station(port, device) as (made, refused), sender(port) as vehicle:
            await until(lambda: not any(each.problem for each in made.link_list().links))
            left = bytearray(b"".join(datagrams))
            codec = Codec(78, 1)

            def write() -> None:
                with contextlib.suppress(BlockingIOError):
                    sent = os.write(master, left or codec.pack(make("HEARTBEAT", **BEAT)) + bytes(280))
                    del left[:sent]

            await _served(made, vehicle)
            await until(
                lambda: any(each.system == 78 for link in made.link_list().links for each in link.senders), write
            )
            assert all(count >= 0 for count in refused.values())
    finally:
        os.close(master)
        os.close(slave)


async def _served(made: Station, vehicle: Callable[[bytes], None]) -> None:
    """Wait until a vehicle on another link is a robot."""
    codec = Codec(77, 1)
    await until(lambda: "drone_77" in made.attached, lambda: vehicle(codec.pack(make("HEARTBEAT", **BEAT))))


@settings(max_examples=5)
@given(st.lists(st.booleans(), min_size=10, max_size=60))
async def test_two_vehicles_with_one_system_id_in_any_order(order: list[bool]) -> None:
    """However their frames mix: what is told of the robot is what the first one says, and the other is counted."""
    port = _port()
    async with station(port) as (made, refused), sender(port) as first, sender(port) as second:
        one, two = Codec(1, 1), Codec(1, 1)
        await until(lambda: made.attached, lambda: first(one.pack(make("HEARTBEAT", **BEAT))))
        two._mav.seq = 100
        for mine in (*order, False):
            if mine:
                first(one.pack(make("HEARTBEAT", **BEAT)))
            else:
                second(two.pack(make("HEARTBEAT", **(BEAT | {"custom_mode": 9, "base_mode": 128}))))
        await until(lambda: refused.get("address_conflict", 0) >= 1, lambda: first(one.pack(make("HEARTBEAT", **BEAT))))
        await until(lambda: len(_told(made)) > 3)
        assert {(each.mode, each.armed) for each in _told(made)} == {("GUIDED", False)}


def _told(made: Station) -> list[RobotInfo]:
    session = cast("Wire", made._session)
    return [msgspec.json.decode(value, type=RobotInfo) for key, value in session.puts if key.endswith("/state")]


async def test_two_vehicles_with_one_system_id() -> None:
    """The first one is believed, the other's frames are counted and its place is not taken."""
    port = _port()
    async with station(port) as (made, refused), sender(port) as first, sender(port) as second:
        one, two = Codec(1, 1), Codec(1, 1)
        await until(lambda: made.attached, lambda: first(one.pack(make("HEARTBEAT", **BEAT))))
        two._mav.seq = 100

        def both() -> None:
            first(one.pack(make("HEARTBEAT", **BEAT)))
            second(two.pack(make("HEARTBEAT", **(BEAT | {"custom_mode": 9}))))

        await until(lambda: refused.get("address_conflict", 0) > 5, both)
        assert made.attached == ("drone_1",)


async def test_a_recorded_signed_link_played_again(tmp_path: Any) -> None:
    """Frames of a signed link that were recorded and are sent again are refused one by one, also after a restart."""
    key = tmp_path / "key"
    key.write_text("hex:" + KEY.hex())
    key.chmod(0o600)
    port, store = _port(), FakeStore()
    codec = Codec(1, 1, signer=Signer(KEY, link_id=1))
    recorded: list[bytes] = []
    for _ in range(2):
        refused: dict[str, int] = {}
        made = Station(
            RobotsConfig(mavlink=(MavlinkLink(listen=f"udp://127.0.0.1:{port}", signing=str(key)),), repeat_s=0.0),
            session=cast("Any", Wire()), store=store, gateway="gw-1", site=Site(), refused=refused,
        )  # fmt: skip
        await made.start()
        async with sender(port) as attacker, sender(port) as vehicle:
            before = len(recorded)
            for raw in recorded:
                attacker(raw)
            await until(lambda refused=refused, before=before: refused.get("replayed", 0) == before)
            assert not made.attached

            def beat(vehicle: Callable[[bytes], None] = vehicle) -> None:
                raw = codec.pack(make("HEARTBEAT", **BEAT))
                recorded.append(raw)
                vehicle(raw)

            await until(lambda made=made: made.attached, beat)
        await made.stop()
    assert len(store.values[f"mavlink/signing/udp://127.0.0.1:{port}"]) < 2000


def _port(kind: socket.SocketKind = socket.SOCK_DGRAM) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
