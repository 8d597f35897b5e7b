"""Telegrams of real vehicles go into a gateway's socket, and what its log has is what another parser reads of them."""

import asyncio
import struct
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pymavlink import mavutil
from robots_process import Process, gateway_process

from appliance.record.reader import info, read
from appliance.robots.mavlink.dialect import Codec, Frame, frame_length
from workshop import local_fleet

pytestmark = [pytest.mark.anyio, pytest.mark.podman]

LOGS = ("ardusub-4.1.1-small.tlog", "ardusub-4.1.0-components.tlog")
OWN = 245
"""System id of the gateway: what it says itself is no part of what was received."""
BURST = 40
"""Frames sent at once: less than a socket holds."""


def records(log: bytes) -> Iterator[bytes]:
    """Yield the telegrams of a tlog, damaged ones too: 8 bytes of time stand before each."""
    at = 0
    while at < len(log):
        (stamp,) = struct.unpack_from(">Q", log, at)
        length = frame_length(log, at + 8)
        assert length is not None
        assert stamp
        yield log[at + 8 : at + 8 + length]
        at += 8 + length


def parsed(path: Path) -> tuple[Counter[tuple[str, int, int]], Counter[bytes]]:
    """What pymavlink reads of a tlog: telegrams by type and sender, and their bytes; damaged ones are left out."""
    counts: Counter[tuple[str, int, int]] = Counter()
    raw: Counter[bytes] = Counter()
    log: Any = mavutil.mavlink_connection(str(path), dialect="ardupilotmega")
    while (message := log.recv_msg()) is not None:
        if message.get_type() != "BAD_DATA":
            counts[message.get_type(), message.get_srcSystem(), message.get_srcComponent()] += 1
            raw[bytes(message.get_msgbuf())] += 1
    log.close()
    return counts, raw


async def play(it: Process, port: int, log: bytes) -> None:
    """Send the telegrams, each as a datagram, no faster than the gateway takes them; wait until it has them all."""
    there = it.connect("udp", port)
    sent = 0
    for number, each in enumerate(records(log)):
        there.send(each)
        sent += 1
        if number % BURST == BURST - 1:
            await asyncio.sleep(0.01)
    async with asyncio.timeout(60):
        while True:
            facts = await it.facts(port)
            if facts.frames_in + sum(facts.refused.values()) >= sent:
                return
            await asyncio.sleep(0.2)


@pytest.mark.parametrize("name", LOGS)
async def test_the_log_has_what_a_real_vehicle_sent(data: Path, tmp_path: Path, name: str) -> None:
    """Counts by type and sender are pymavlink's own of the file, the bytes are equal, and nothing is missing."""
    path = data / "mavlink" / name
    counts, raw = parsed(path)
    async with gateway_process(tmp_path) as it:
        port = await it.link("udp")
        await play(it, port, path.read_bytes())
        gateways = [each for each in it.fleet.processes if each.name in it.fleet.gateways]
        await local_fleet.end(gateways, grace_s=20.0)
        recorder = [each for each in it.fleet.processes if each.name == "recorder"]
        await local_fleet.end(recorder, grace_s=20.0)
        files = sorted(Path(it.fleet.record_dir).glob("*.mcap"))
    heard = [each.payload for file in files for each in read(file) if each.key.endswith("/rx")]
    codec = Codec(OWN, 191)
    frames = [frame for payload in heard for frame in codec.read(payload) if isinstance(frame, Frame)]
    assert len(frames) == len(heard)
    found = Counter((each.name, each.system, each.component) for each in frames if each.system != OWN)
    assert found == counts
    assert Counter(each.raw for each in frames if each.system != OWN) == raw
    assert all(not info(file).missed for file in files)
