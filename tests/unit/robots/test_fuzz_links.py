"""Whatever comes on a link: counted or dropped, never a crash, never growth, and the others are served."""

import asyncio
import gc
import random
import socket
import struct
import tracemalloc
from typing import Any, cast

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.ports import free_port
from appliance.robots.mavlink.dialect import KINDS, Codec, Damage, Frame, Stream, checksum, decode, make
from appliance.robots.mavlink.signing import Signer
from appliance.robots.mavlink.tunnel import MAX_GOING, MAX_PAYLOAD, PART, PAYLOAD_TYPE
from tests.unit.robots.links import (
    BEAT,
    KEY,
    LINKS,
    STATION,
    Wire,
    beside,
    served,
    station,
    tunnel_of,
    understood,
    until,
)

pytestmark = pytest.mark.anyio

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
    """However cut, signed or not: every byte is a frame's, damage's or waits, and at most three frames wait."""
    whole = b"".join(parts)
    stream = Stream(Codec(9, 9, signer=Signer(KEY, link_id=0) if signed else None))
    used = 0
    for start in range(0, len(whole), size):
        for found in stream.feed(whole[start : start + size]):
            used += found.length if isinstance(found, Damage) else len(found.raw)
        assert stream.pending <= 3 * 280
    assert used + stream.pending == len(whole)


@pytest.mark.parametrize("kind", LINKS)
@settings(max_examples=8)
@given(brought=st.lists(raws, min_size=1, max_size=60))
async def test_an_end_that_brings_anything(kind: str, brought: list[bytes]) -> None:
    """Random bytes, good frames with random payloads, tunnels that lie: the others are served, and it is understood."""
    async with beside(kind) as (made, refused, outside, vehicle):
        outside.write(Codec(255, 190).pack(make("HEARTBEAT", **STATION)), *brought)
        # A stranger may have taken the vehicle's name before: then both are distinguished, and that is counted.
        await served(made, vehicle, outside)
        # Behind all that a stream is understood again: at the latest when the longest frame that it may have begun
        # is at its end.
        await understood(made, outside)
        assert all(count >= 0 for count in refused.values())


@pytest.mark.parametrize("kind", LINKS)
async def test_what_is_none_is_counted(kind: str) -> None:
    """Wrong checksums, cut frames, parts of messages that are cut or lie, absurd counts: counted, kept nowhere."""
    async with beside(kind) as (made, refused, outside, vehicle):
        await served(made, vehicle, outside)
        codec = Codec(255, 190)

        def damaged() -> bytes:
            raw = codec.pack(make("HEARTBEAT", **STATION))
            return raw[:-1] + bytes((raw[-1] ^ 0xFF,))

        outside.write(codec.pack(make("HEARTBEAT", **STATION)))
        await until(lambda: refused.get("checksum"), lambda: outside.write(damaged()))
        await until(
            lambda: refused.get("truncated") or outside._datagrams is None, lambda: outside.write(damaged()[:9])
        )
        await understood(made, outside)
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
                lambda payload=payload: outside.write(tunnel_of(codec, payload)),
            )
        before = refused.get("mission_refused", 0)
        target = {"target_system": 77, "target_component": 191, "mission_type": 0}
        await until(
            lambda: refused.get("mission_refused", 0) > before,
            lambda: outside.write(codec.pack(make("MISSION_COUNT", count=65_535, **target))),
        )
        await until(lambda: not made.companion._missions._uploads)
        # More parts than any message may have: refused, and nothing of it is kept.
        for _ in range(200):
            outside.write(tunnel_of(codec, _part(index=7, count=65_535, data=bytes(112))))
        await understood(made, outside, system=79)
        channel = made.companion._tunnel._senders[255, 190].channel
        assert not channel._coming
        assert len(channel._refusals) <= MAX_GOING
        await served(made, vehicle, outside)


@pytest.mark.parametrize("kind", LINKS)
async def test_a_flood_on_one_link(kind: str) -> None:
    """One that sends far more than it may is cut off or slowed, which is counted, and a vehicle elsewhere is served."""
    async with beside(kind, sender_hz=100.0) as (made, refused, outside, vehicle):
        loud, codec = Codec(255, 190), Codec(77, 1)

        def both() -> None:
            outside.write(*(loud.pack(make("HEARTBEAT", **STATION)) for _ in range(60)))
            vehicle(codec.pack(make("HEARTBEAT", **BEAT)))

        counted = "flood" if kind.startswith("udp") else "slowed"
        await until(lambda: "drone_77" in made.vehicles.attached and refused.get(counted, 0) > 0, both)


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
                lambda: make(
                    "MISSION_COUNT",
                    count=chance.randint(0, 300),
                    mission_type=0,
                    target_component=191,
                    target_system=chance.randint(1, 60),
                ),
                lambda: make("STATUSTEXT", severity=6, text=b"x" * 50, id=chance.randint(1, 9999), chunk_seq=3),
                lambda: make("MISSION_CURRENT", seq=chance.randint(0, 9999)),
            )
        )()
        raw = codec.pack(message)
        if chance.random() < 0.2:
            part = struct.pack("<2sBBIHHI", b"SB", 1, PART, chance.getrandbits(32), 0, 2, 0) + bytes(112)
            raw = tunnel_of(codec, part)
        elif chance.random() < 0.1:
            raw = raw[: chance.randint(1, len(raw))]
        found.append(
            (raw, (f"10.{number % 7}.{chance.randint(0, 9)}.{chance.randint(1, 250)}", chance.randint(1, 9999)))
        )
    return found


@pytest.mark.long
async def test_a_flood_of_everything_costs_no_memory() -> None:
    """Frames that make a gateway remember something, from ever other senders: what is kept does not grow with them."""
    async with station(free_port(socket.SOCK_DGRAM), sender_hz=0.0, repeat_s=0.01, max_vehicles=8) as (made, refused):
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
                    made.companion.tick(asyncio.get_running_loop().time())
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
