"""Faults of what is at the other ends of MAVLink links, as users of a real gateway process see them."""

import asyncio
import time
from pathlib import Path

import pytest
from robots_process import beats, gateway_process

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.fleet]
FOREIGN = bytes.fromhex("fd06000000050161ea0001020304fdff2ab4")
FOREIGN_LAST = bytes.fromhex("fd03000000010161ea0001020387fd")


async def test_a_false_header_holds_no_vehicle_back(tmp_path: Path) -> None:
    """Behind foreign frames with markers in their bodies, a TCP vehicle at 1 Hz comes and stays online."""
    async with gateway_process(tmp_path) as it:
        port = await it.link("tcp")
        end, beat = it.connect("tcp", port), beats(7)
        end.send(FOREIGN_LAST + beat() + beat())
        await it.until(lambda: "drone_7" in it.robots() and it.robots()["drone_7"].online, limit_s=10)
        offline = 0
        for _ in range(8):
            # In two pieces, so that the gateway reads damage that is not whole.
            end.send(FOREIGN[:7])
            await asyncio.sleep(0.05)
            end.send(FOREIGN[7:])
            until = time.monotonic() + 1.0
            end.send(beat())
            while time.monotonic() < until:
                offline += not it.robots()["drone_7"].online
                await asyncio.sleep(0.1)
        facts = await it.facts(port)
        assert not offline
        assert facts.refused == {"unknown_message": 9}
        assert facts.frames_in == 10
