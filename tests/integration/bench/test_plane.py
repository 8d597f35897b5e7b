"""The benchmarks of the plane at their smallest: that they measure, end exactly once, and leave no process."""

import asyncio
import signal
import sys
from pathlib import Path

import psutil
import pytest
from fleets import INTERRUPTIBLE

from workshop.bench import idle
from workshop.bench.failover import restart, takeover
from workshop.bench.members import run as members

pytestmark = [pytest.mark.anyio, pytest.mark.timeout(400), pytest.mark.long]


def _children() -> set[int]:
    return {each.pid for each in psutil.Process().children(recursive=True)}


async def test_members_know_each_other() -> None:
    """Twelve members behind a router: all know all, records are there, a newcomer is known and forgotten everywhere."""
    before = _children()
    told: list[str] = []
    options = members.Options(members=12, per_process=6, rounds=1, count=20, idle_s=0.5)
    found = await members.run(options, progress=told.append)
    assert found["write"]["count"] == found["read"]["count"] == 20
    assert found["newcomer_known_everywhere"]["count"] == found["killed_forgotten_everywhere"]["count"] == 1
    assert found["newcomer_known_everywhere"]["p50"] > 0
    assert found["member_mb"] > 0
    assert found["router_mb"] > 0
    assert found["refused"] == {}
    assert found["known_by_each"] == 12
    assert any("idle" in each for each in told)
    assert _children() == before


async def test_members_interrupted(project_root: Path) -> None:
    """Ctrl-C in mid-run ends the command with 130 and takes the router and all hosts along."""
    process = await asyncio.create_subprocess_exec(
        *INTERRUPTIBLE, sys.executable, "-m", "appliance.cli", "bench", "members", "--members", "8",
        "--per-process", "4", "--idle-s", "300", "--json",
        stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE, cwd=project_root,
    )  # fmt: skip
    assert process.stderr is not None
    try:
        line = ""
        while "idle for" not in line:
            line = (await process.stderr.readline()).decode()
            assert line
        daemons = [each.pid for each in psutil.Process(process.pid).children()]
        assert len(daemons) == 3
        process.send_signal(signal.SIGINT)
        assert await process.wait() == 130
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
    assert not any(psutil.pid_exists(pid) for pid in daemons)


async def test_idle() -> None:
    """Memory, CPU, threads and descriptors of an idle gateway are reported, for each size of fleet."""
    result = await idle.run(idle.Options(gateways=(1, 2), seconds=0.5), progress=lambda _: None)
    for size in ("gateways_1", "gateways_2"):
        assert result[size]["rss_mb"] > 10
        assert result[size]["cpu_percent"] >= 0
        assert result[size]["descriptors"] > 5


@pytest.mark.parametrize("how", ["stop", "kill"])
async def test_restarts(how: str) -> None:
    """A gateway that was stopped, or killed, tells itself when it is back, and another sees it and has an answer."""
    options = restart.Options(gateways=3, rounds=2, records=20, how=how)  # type: ignore[arg-type]
    result = await restart.run(options, progress=lambda _: None)
    assert {each["count"] for each in result["own"].values()} == {2}
    own = result["own"]
    assert 0 < own["linked_ms"]["max"] <= own["present_ms"]["max"] <= own["joined_ms"]["max"]
    assert own["joined_ms"]["max"] < own["reconciled_ms"]["max"] < result["process"]["up_ms"]["max"]
    assert result["seen"]["answers_ms"]["count"] == 2


@pytest.mark.podman
async def test_takeovers(built: None) -> None:
    """Tasks of a coordinator that is killed, and of one that is frozen, are adopted, and end exactly once."""
    options = takeover.Options(gateways=4, kills=1, freezes=1, silents=1, tasks=4, sleep_ms=2000)
    result = await takeover.run(options, progress=lambda _: None)
    for how in ("kill", "freeze", "silent"):
        assert result[how]["tasks"] == 4
        assert result[how]["tasks_taken_over"] >= 1
        assert result[how]["not_exactly_once"] == []
        assert result[how]["adopted_after_detection"]["count"] == result[how]["tasks_taken_over"]
    assert result["freeze"]["detected"]["p50"] > result["kill"]["detected"]["p50"]
