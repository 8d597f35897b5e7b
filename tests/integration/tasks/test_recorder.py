"""The fleet says what its recorder misses: gateways and recorder as processes, the recorder stopped for a while."""

import asyncio
import os
import signal
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest
from fleets import fleet_in

from appliance.client import FleetClient
from appliance.connection import FleetState, Process
from appliance.model import GatewayStatus, keyspace
from workshop import local_fleet

pytestmark = [pytest.mark.anyio, pytest.mark.podman]


def _fleet(state: FleetState, *more: str) -> str:
    """What `swiftbot fleet` prints."""
    command = (sys.executable, "-m", "appliance.cli", "fleet", "--fleet", state.fleet, *more)
    connect = [part for endpoint in state.endpoints for part in ("--connect", endpoint)]
    return subprocess.run((*command, *connect), capture_output=True, text=True, check=True, timeout=60).stdout


def _missed(state: FleetState) -> int:
    told = msgspec.json.decode(_fleet(state, "--json"), type=list[GatewayStatus])
    return sum(note.missed for status in told for note in status.recorders)


async def _restart_without_backlog(state: FleetState) -> Process:
    """Start the gateway again so that it keeps nothing of what it puts."""
    (gateway,) = (each for each in state.processes if each.name == "gw-1")
    await local_fleet.end([gateway], grace_s=20.0)
    config = Path(state.directory) / "gw-1" / "gateway.toml"
    config.write_text(config.read_text().replace("[plane]", "[plane]\nbacklog_bytes = 0", 1))
    command = (sys.executable, "-m", "appliance.cli", "gateway", "--config", str(config))
    return local_fleet.spawn("gw-1", command, Path(gateway.log))


async def test_a_recorder_that_misses_messages_is_told_of_at_once(tmp_path: Path) -> None:
    """A recorder is stopped until its link is gone: `swiftbot fleet` says how many messages it lacks, and of what keys.

    While it misses nothing, nothing is said of the recorder; `--json` has the figures.
    """
    async with fleet_in(tmp_path, gateways=1, zenoh=1) as state:
        assert "missed" not in _fleet(state)
        again = await _restart_without_backlog(state)
        try:
            (recorder,) = (each for each in state.processes if each.name == "recorder")
            async with asyncio.timeout(120):
                while "gw-1" not in _fleet(state):
                    await asyncio.sleep(0.2)
                before = _missed(state)  # what it says as it starts may be lost, as it keeps nothing
                os.kill(recorder.pid, signal.SIGSTOP)
                try:
                    async with FleetClient(state.endpoint) as client:
                        silent = asyncio.Event()
                        client.plane.session.subscribe_typed(
                            keyspace.STATUS,
                            lambda _, status: silent.set() if _is_silent(status) else None,
                        )
                        await silent.wait()
                        assert "not heard any more" in _fleet(state)
                finally:
                    os.kill(recorder.pid, signal.SIGCONT)
                while _missed(state) <= before:
                    await asyncio.sleep(0.1)
            shown = _fleet(state)
            assert "missed" in shown
            assert "of keys" in shown
            assert "gw/*/" in shown
            told = msgspec.json.decode(_fleet(state, "--json"), type=list[GatewayStatus])
            (note,) = told[0].recorders
            assert note.missed == sum(note.keys.values()) > before
        finally:
            await local_fleet.end([again], grace_s=20.0)


def _is_silent(status: GatewayStatus | None) -> bool:
    return status is not None and any(each.state == "silent" for each in status.recorders)
