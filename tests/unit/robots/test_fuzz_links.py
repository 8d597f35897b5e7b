"""Whatever comes on a link: counted or dropped, never a crash, never growth, and the others are served."""

import asyncio
import contextlib
import gc
import os
import pty
import random
import socket
import struct
import tracemalloc
import tty
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
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
from appliance.robots.mavlink.tunnel import MAX_GOING, MAX_PAYLOAD, PART, PAYLOAD_TYPE
from appliance.robots.settings import MavlinkLink, RobotsConfig
from tests.unit.robots.conftest import FakeSession, FakeStore

pytestmark = pytest.mark.anyio

BEAT = {"type": 2, "autopilot": 3, "base_mode": 0, "custom_mode": 4, "system_status": 4, "mavlink_version": 3}
STATION = BEAT | {"autopilot": 8, "type": 6}
"""A ground station's heartbeat: from then on what it asks is listened to."""
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


LINKS = ("udp listen", "udp connect", "tcp listen", "tcp connect", "serial")


class Outside:
    """Who is at the other end of a gateway's link of some kind, and brings what the test wants."""

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self._port = 0
        self._datagrams: Callable[[bytes], None] | None = None
        self._writer: asyncio.StreamWriter | None = None
        self._master = -1
        self._left = bytearray()

    async def prepare(self, closing: AsyncExitStack) -> MavlinkLink:
        """Return the link that a gateway is to open; what it connects to is there already."""
        if self.kind == "serial":
            self._master, slave = pty.openpty()
            closing.callback(os.close, self._master)
            closing.callback(os.close, slave)
            tty.setraw(self._master)
            os.set_blocking(self._master, False)
            return MavlinkLink(connect=f"serial:{os.ttyname(slave)}:57600")
        scheme, _, way = self.kind.partition(" ")
        if way == "listen":
            self._port = _port(socket.SOCK_DGRAM if scheme == "udp" else socket.SOCK_STREAM)
            return MavlinkLink(listen=f"{scheme}://127.0.0.1:{self._port}")
        if scheme == "udp":
            outside = self

            class Waiting(asyncio.DatagramProtocol):
                def connection_made(self, transport: asyncio.BaseTransport) -> None:
                    self.transport = cast("asyncio.DatagramTransport", transport)

                def datagram_received(self, _: bytes, address: Any) -> None:
                    outside._datagrams = lambda raw: self.transport.sendto(raw, address)

            transport, _ = await asyncio.get_running_loop().create_datagram_endpoint(
                Waiting, local_addr=("127.0.0.1", 0)
            )
            closing.callback(transport.close)
            return MavlinkLink(connect=f"udp://127.0.0.1:{transport.get_extra_info('sockname')[1]}")

        def accept(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            self._writer = writer
            closing.callback(writer.close)

        server = await asyncio.start_server(accept, "127.0.0.1", 0)
        closing.callback(server.close)
        return MavlinkLink(connect=f"tcp://127.0.0.1:{server.sockets[0].getsockname()[1]}")

    async def meet(self, made: Station, closing: AsyncExitStack) -> None:
        """Come to the gateway, or wait until it has come."""
        if self.kind == "udp listen":
            self._datagrams = await closing.enter_async_context(sender(self._port))
        elif self.kind == "tcp listen":
            _, self._writer = await asyncio.open_connection("127.0.0.1", self._port)
            closing.callback(self._writer.close)
        elif self.kind == "serial":
            await until(lambda: not any(each.problem for each in made.link_list().links))
        else:
            await until(lambda: self._datagrams or self._writer)

    def write(self, *raws: bytes) -> None:
        """Send some frames, or go on with what a serial port has not taken yet."""
        for raw in raws:
            if self._datagrams is not None:
                self._datagrams(raw)
            elif self._writer is not None:
                self._writer.write(raw)
            elif len(self._left) < 2**16:
                self._left += raw
        if self._left:
            with contextlib.suppress(BlockingIOError):
                del self._left[: os.write(self._master, self._left)]


@asynccontextmanager
async def beside(
    kind: str, signing: str = "", **changes: Any
) -> AsyncIterator[tuple[Station, dict[str, int], Outside, Callable[[bytes], None]]]:
    """Open a station with a link of that kind, whose other end the test has, and another link with a vehicle."""
    port, outside = _port(), Outside(kind)
    async with AsyncExitStack() as closing:
        link = msgspec.structs.replace(await outside.prepare(closing), signing=signing)
        made, refused = await closing.enter_async_context(station(port, link, **changes))
        await outside.meet(made, closing)
        vehicle = await closing.enter_async_context(sender(port))
        yield made, refused, outside, vehicle


@pytest.mark.parametrize("kind", LINKS)
@settings(max_examples=8)
@given(brought=st.lists(raws, min_size=1, max_size=60))
async def test_an_end_that_brings_anything(kind: str, brought: list[bytes]) -> None:
    """Random bytes, good frames with random payloads, tunnels that lie: the others are served, and it is understood."""
    async with beside(kind) as (made, refused, outside, vehicle):
        outside.write(Codec(255, 190).pack(make("HEARTBEAT", **STATION)), *brought)
        # A stranger may have taken the vehicle's name before: then both are told apart, and that is counted.
        await _served(made, vehicle, outside)
        # Behind all that a stream is understood again: at the latest when the longest frame that it may have begun
        # is at its end.
        await _understood(made, outside)
        assert all(count >= 0 for count in refused.values())


@pytest.mark.parametrize("kind", LINKS)
async def test_what_is_none_is_counted(kind: str) -> None:
    """Wrong checksums, cut frames, parts of messages that are cut or lie, absurd counts: counted, kept nowhere."""
    async with beside(kind) as (made, refused, outside, vehicle):
        await _served(made, vehicle, outside)
        codec = Codec(255, 190)

        def damaged() -> bytes:
            raw = codec.pack(make("HEARTBEAT", **STATION))
            return raw[:-1] + bytes((raw[-1] ^ 0xFF,))

        outside.write(codec.pack(make("HEARTBEAT", **STATION)))
        await until(lambda: refused.get("checksum"), lambda: outside.write(damaged()))
        await until(
            lambda: refused.get("truncated") or outside._datagrams is None, lambda: outside.write(damaged()[:9])
        )
        await _understood(made, outside)
        part = _part(index=0, count=3, data=bytes(112))
        for payload in (
            part[:7],  # a header that is cut
            part[:-1],  # a part that is cut, and not the last
            b"XX" + part[2:],  # of another protocol
            _part(index=3, count=3, data=b"x"),  # the fourth of three
            _part(index=0, count=0, data=b""),  # the first of none
        ):
            before = refused.get("tunnel_malformed", 0)
            await until(
                lambda before=before: refused.get("tunnel_malformed", 0) > before,
                lambda payload=payload: outside.write(_tunnel(codec, payload)),
            )
        before = refused.get("mission_refused", 0)
        target = {"target_system": 77, "target_component": 191, "mission_type": 0}
        await until(
            lambda: refused.get("mission_refused", 0) > before,
            lambda: outside.write(codec.pack(make("MISSION_COUNT", count=65_535, **target))),
        )
        await until(lambda: not made._switch._missions._uploads)
        # More parts than any message may have: refused, and nothing of it is kept.
        for _ in range(200):
            outside.write(_tunnel(codec, _part(index=7, count=65_535, data=bytes(112))))
        await _understood(made, outside, system=79)
        channel = made._switch._letters._senders[255, 190].channel
        assert not channel._coming
        assert len(channel._refusals) <= MAX_GOING
        await _served(made, vehicle, outside)


@pytest.mark.parametrize("kind", LINKS)
async def test_signed_frames_that_are_played_again(kind: str, tmp_path: Any) -> None:
    """On any link: each is refused as what it is, so are unsigned and wrongly signed ones, and the vehicle stays."""
    key = tmp_path / "key"
    key.write_text("hex:" + KEY.hex())
    key.chmod(0o600)
    async with beside(kind, signing=str(key), repeat_s=0.0) as (made, refused, outside, _):
        codec = Codec(1, 1, signer=Signer(KEY, link_id=1))
        recorded: list[bytes] = []

        def beat() -> None:
            recorded.append(codec.pack(make("HEARTBEAT", **BEAT)))
            outside.write(recorded[-1])

        await until(lambda: made.attached == ("drone_1",), beat)
        assert "replayed" not in refused
        outside.write(*recorded)
        await until(lambda: refused.get("replayed", 0) == len(recorded), outside.write)
        forger = Codec(2, 1, signer=Signer(KEY[::-1], link_id=1))
        await until(lambda: refused.get("bad_signature"), lambda: outside.write(forger.pack(make("HEARTBEAT", **BEAT))))
        plain = Codec(2, 1)
        await until(lambda: refused.get("unsigned"), lambda: outside.write(plain.pack(make("HEARTBEAT", **BEAT))))
        assert made.attached == ("drone_1",)


@pytest.mark.parametrize("kind", LINKS)
async def test_a_flood_on_one_link(kind: str) -> None:
    """One that sends far more than it may is cut off or slowed, which is counted, and a vehicle elsewhere is served."""
    async with beside(kind, sender_hz=100.0) as (made, refused, outside, vehicle):
        loud, codec = Codec(255, 190), Codec(77, 1)

        def both() -> None:
            outside.write(*(loud.pack(make("HEARTBEAT", **STATION)) for _ in range(60)))
            vehicle(codec.pack(make("HEARTBEAT", **BEAT)))

        counted = "flood" if kind.startswith("udp") else "slowed"
        await until(lambda: "drone_77" in made.attached and refused.get(counted, 0) > 0, both)


@pytest.mark.parametrize("kind", LINKS)
async def test_two_vehicles_with_one_system_id_on_two_links(kind: str) -> None:
    """The first one is believed; what says the same on another link is counted, and its place is not taken."""
    async with beside(kind) as (made, refused, outside, vehicle):
        one, two = Codec(1, 1), Codec(1, 1)
        await until(lambda: made.attached, lambda: vehicle(one.pack(make("HEARTBEAT", **BEAT))))
        two._mav.seq = 100

        def both() -> None:
            vehicle(one.pack(make("HEARTBEAT", **BEAT)))
            outside.write(two.pack(make("HEARTBEAT", **(BEAT | {"custom_mode": 9, "base_mode": 128}))))

        await until(lambda: refused.get("name_conflict", 0) > 5, both)
        assert made.attached == ("drone_1",)
        assert {(each.mode, each.armed) for each in _told(made)} <= {("GUIDED", False)}


def _storm(chance: random.Random, count: int) -> list[tuple[bytes, tuple[str, int]]]:
    """Return frames of every kind that makes a gateway remember something, from ever other senders and addresses."""
    found: list[tuple[bytes, tuple[str, int]]] = []
    target = {"target_system": 242, "target_component": 191}
    params = {f"param{number}": 0.0 for number in range(1, 8)}
    for number in range(count):
        codec = Codec(chance.randint(1, 60), chance.choice((1, 100, 190, 191, 192)))
        codec._mav.seq = chance.randint(0, 255)
        message = chance.choice(
            (
                lambda: make("HEARTBEAT", **STATION),
                lambda: make("HEARTBEAT", **BEAT),
                lambda: make("TIMESYNC", tc1=chance.choice((0, 5)), ts1=chance.getrandbits(60)),
                lambda: make("COMMAND_LONG", command=31010, confirmation=chance.randint(0, 2), **target, **params),
                lambda: make("COMMAND_CANCEL", command=31010, **target),
                lambda: make("MISSION_COUNT", count=chance.randint(0, 300), mission_type=0, **target),
                lambda: make("STATUSTEXT", severity=6, text=b"x" * 50, id=chance.randint(1, 9999), chunk_seq=3),
                lambda: make("MISSION_CURRENT", seq=chance.randint(0, 9999)),
            )
        )()
        raw = codec.pack(message)
        if chance.random() < 0.2:
            part = struct.pack("<2sBBIHHI", b"SB", 1, PART, chance.getrandbits(32), 0, 2, 0) + bytes(112)
            raw = _tunnel(codec, part)
        elif chance.random() < 0.1:
            raw = raw[: chance.randint(1, len(raw))]
        found.append(
            (raw, (f"10.{number % 7}.{chance.randint(0, 9)}.{chance.randint(1, 250)}", chance.randint(1, 9999)))
        )
    return found


async def test_a_flood_of_everything_costs_no_memory() -> None:
    """Frames that make a gateway remember something, from ever other senders: what is kept does not grow with them."""
    async with station(_port(), sender_hz=0.0, repeat_s=0.01, max_vehicles=8) as (made, refused):
        session = cast("Wire", made._session)
        (entry,) = tuple(made.links)
        # The addresses are made up, so nothing may be sent to them.
        cast("Any", entry.link)._write = lambda *_: True
        chance = random.Random(7)  # noqa: S311 - no secret
        kept: list[int] = []
        tracemalloc.start()
        try:
            for _ in range(5):
                for raw, address in _storm(chance, 1000):
                    entry.link.feed(raw, address)
                for _ in range(50):
                    made._switch.tick(asyncio.get_running_loop().time())
                    await asyncio.sleep(0)
                session.puts.clear()
                gc.collect()
                kept.append(tracemalloc.get_traced_memory()[0])
        finally:
            tracemalloc.stop()
        assert min(refused.get(what, 0) for what in ("truncated", "address_conflict", "mission_refused")) > 0, refused
        assert kept[-1] - kept[1] < 2**20, kept


def _part(*, index: int, count: int, data: bytes) -> bytes:
    return struct.pack("<2sBBIHHI", b"SB", 1, PART, 4711, index, count, 0) + data


def _tunnel(codec: Codec, payload: bytes) -> bytes:
    return codec.pack(
        make(
            "TUNNEL", target_system=242, target_component=191, payload_type=PAYLOAD_TYPE,
            payload_length=len(payload), payload=list(payload.ljust(MAX_PAYLOAD, b"\0")),
        )
    )  # fmt: skip


async def _understood(made: Station, outside: Outside, system: int = 78) -> None:
    """Wait until a frame is heard from this end."""
    codec = Codec(system, 1)
    await until(
        lambda: any(each.system == system for link in made.link_list().links for each in link.senders),
        lambda: outside.write(codec.pack(make("HEARTBEAT", **BEAT)) + bytes(280)),
    )


async def _served(made: Station, vehicle: Callable[[bytes], None], outside: Outside) -> None:
    """Wait until a vehicle on another link is a robot, while this one brings what it has left."""
    codec = Codec(77, 1)

    def act() -> None:
        vehicle(codec.pack(make("HEARTBEAT", **BEAT)))
        outside.write()

    await until(lambda: "drone_77" in made.attached, act)


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


async def test_an_end_that_understands_mavlink_1_alone() -> None:
    """It is a vehicle like others: what it is told, by the gateway or from another link, is in MAVLink 1."""
    port, other = _port(), _port()
    heard: list[bytes] = []

    class Old(asyncio.DatagramProtocol):
        def datagram_received(self, data: bytes, _: Any) -> None:
            heard.append(data)

    async with (
        station(other, MavlinkLink(listen=f"udp://127.0.0.1:{port}", mavlink1=True)) as (made, refused),
        sender(other) as ground,
    ):
        transport, _ = await asyncio.get_running_loop().create_datagram_endpoint(Old, remote_addr=("127.0.0.1", port))
        try:
            codec, watching = Codec(5, 1, v1=True), Codec(255, 190)
            await until(lambda: made.attached, lambda: transport.sendto(codec.pack(make("HEARTBEAT", **BEAT))))
            asked = make("COMMAND_INT", target_system=5, target_component=1, frame=3, command=192, current=0,
                         autocontinue=0, param1=0, param2=0, param3=0, param4=0, x=7, y=8, z=0)  # fmt: skip
            tunnel = {"payload_type": 1, "payload_length": 0, "payload": [0] * 128}
            unknown = make("TUNNEL", target_system=5, target_component=1, **tunnel)

            def act() -> None:
                transport.sendto(codec.pack(make("HEARTBEAT", **BEAT)))
                for message in (make("HEARTBEAT", **STATION), asked, unknown):
                    ground(watching.pack(message))

            def told() -> set[str]:
                frames = [frame for raw in heard for frame in Codec(9, 9).read(raw)]
                return {each.name for each in frames if isinstance(each, Frame)}

            await until(lambda: refused.get("no_mavlink_1") and {"HEARTBEAT", "COMMAND_INT"} <= told(), act)
            await until(lambda: "COMMAND_LONG" in told(), act)  # the gateway asks for its telemetry
            assert {raw[0] for raw in heard} == {0xFE}
            assert "TUNNEL" not in told()
            assert all(payload for key, payload in cast("Wire", made._session).puts if "/mavlink/" in key)
        finally:
            transport.close()


async def test_a_repetition_is_recorded_and_goes_no_further() -> None:
    """What comes twice stands in the log twice, under who said it, and another end gets it once."""
    port, other = _port(), _port()
    async with (
        station(port, MavlinkLink(listen=f"udp://127.0.0.1:{other}"), repeat_s=600.0) as (made, refused),
        sender(port) as vehicle,
        sender(other) as ground,
    ):
        codec, watching = Codec(1, 1), Codec(255, 190)
        await until(lambda: made.attached, lambda: vehicle(codec.pack(make("HEARTBEAT", **BEAT))))
        await until(lambda: made.link_list().routes.get("255/190"), lambda: ground(_watch(watching)))
        said, asked = codec.pack(make("HEARTBEAT", **(BEAT | {"custom_mode": 5}))), _watch(watching)
        session = cast("Wire", made._session)
        keys = session.keys

        def told(raw: bytes) -> int:
            return sum(payload == raw and key.endswith("/rx") for key, payload in session.puts)

        await until(lambda: told(said) > 2 and told(asked) > 2, lambda: (vehicle(said), ground(asked)))
        assert refused["repeated"] == told(said) + told(asked) - 2
        heard = [key for key, payload in session.puts if payload == said and key.endswith("/rx")]
        assert set(heard) == {keys.mavlink("drone_1", "rx")}
        assert sum(key.endswith("/tx") for key, payload in session.puts if payload == said) == 1
        heard = [key for key, payload in session.puts if payload == asked and key.endswith("/rx")]
        assert set(heard) == {keys.link_frames("gw-1", "1", "rx")}
        assert sum(key.endswith("/tx") for key, payload in session.puts if payload == asked) == 1


def _watch(codec: Codec) -> bytes:
    return codec.pack(make("HEARTBEAT", **STATION))


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
