"""Each benchmark on real containers, with counts as small as they go: that it measures, and leaves nothing."""

import asyncio
import secrets
import signal
import stat
import sys
from pathlib import Path
from typing import Any

import psutil
import pytest
from fleets import INTERRUPTIBLE

from appliance.learn.datasets.make import Clips
from appliance.pool import images
from appliance.pool.engine import PodmanEngine
from appliance.skills.catalogue import load_catalogue
from workshop.bench import actors, federated, migrate, pooled, rate, refill, soak, startup, training, transfer, zygote
from workshop.bench.learning import run as learning

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.timeout(400), pytest.mark.long]


async def fleets_with_containers() -> list[str]:
    """Return the fleets of all containers."""
    engine = PodmanEngine(threads=1)
    try:
        found = await engine.containers({})
    finally:
        engine.close()
    return [each.labels.get("swiftbot.fleet", "") for each in found]


async def test_startup(built: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Cold and warm are measured in one run; a warm run asks nothing of Podman; no container is left."""
    mine = f"bench-{secrets.token_hex(4)}"
    monkeypatch.setattr(pooled, "FLEET", mine)
    result = await startup.run(5, 1)
    assert result["local"]["count"] == result["local_round_trip"]["count"] == 5
    assert result["cold"]["p50"] > result["local"]["p50"] > 0
    assert result["local_round_trip"]["p50"] > result["local"]["p50"]
    assert set(result["local"]) == {"count", "p50", "p90", "p99", "max"}
    assert result["cdf"]["local"][-1][1] == 1.0
    assert result["podman_calls_per_warm_run"] == 0
    assert not any(each.startswith(mine) for each in await fleets_with_containers())


async def test_four_gateways(built: None) -> None:
    """Each way is served in its own phase; all figures are there."""
    result = await federated.run(2, 1, image="base", progress=lambda _: None)
    assert {name: result[name]["count"] for name in ("ordered", "federated", "cold_ordered")} == {
        "ordered": 2, "federated": 2, "cold_ordered": 1,
    }  # fmt: skip
    assert result["cold_ordered"]["p50"] > result["federated"]["p50"] > 0


async def test_rates(built: None) -> None:
    """Two rates of one mode: cells, phases and what the machine did are reported; an open loop loses no run."""
    options = rate.Options(
        modes=("federated",), spreads=("uneven",), rates=(4.0, 8.0), services_ms=(50.0,), seconds=1.0, least=4,
        most_s=1.0, limit_ms=60_000.0,
    )  # fmt: skip
    told: list[str] = []
    result = await rate.run(options, progress=told.append)
    (ladder,) = result["ladders"]
    assert set(ladder["cells"]) == {"4", "8"}
    for cell in ladder["cells"].values():
        assert cell["start"]["count"] == sum(cell["phases"].values()) + sum(cell["unserved"].values())
        assert set(cell["cores_by_process"]) == {"gw-1", "gw-2", "gw-3", "gw-4", "recorder", "sender", "others"}
    assert any("8/s" in each for each in told)


async def test_interrupted(built: None, project_root: Path) -> None:
    """Ctrl-C in mid-run ends the command with 130, and takes the fleet, its containers and its folder along."""
    process = await asyncio.create_subprocess_exec(
        *INTERRUPTIBLE, sys.executable, "-m", "appliance.cli", "bench", "rate", "--mode", "federated", "--rates", "2",
        "--seconds", "300", "--json",
        stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE, cwd=project_root,
    )  # fmt: skip
    assert process.stderr is not None
    try:
        lines: list[str] = []
        while not any("arrivals" in each for each in lines):
            line = (await process.stderr.readline()).decode()
            assert line, lines
            lines.append(line)
        daemons = [each.pid for each in psutil.Process(process.pid).children()]
        assert len(daemons) == 5
        process.send_signal(signal.SIGINT)
        left = (await process.stderr.read()).decode()
        assert await process.wait() == 130, left
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
    assert not any(psutil.pid_exists(pid) for pid in daemons)
    (started,) = (each for each in lines if each.startswith("started "))
    fleet = started.split()[-1]
    assert fleet.startswith("bench-")
    assert fleet not in await fleets_with_containers()


async def test_without_ray(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Where Ray is not installed the result says so and how to get it, and nothing is compared."""
    monkeypatch.setattr(actors, "find_python", lambda: None)
    found = await actors.run(1, 1, progress=lambda _: None)
    assert "make ray" in found["remedy"]
    assert actors.compare({"ray": found, "local": {"p50": 1.0}}) == {}


FAKE = """#!{python}
import json, sys
warm, cold = int(sys.argv[4]), int(sys.argv[5])
print("a line of Ray's own")
print(json.dumps({{"event": "ready", "version": "0", "took_ms": 1.0}}))
print(json.dumps({{"event": "warm", "start_ms": [0.5] * warm, "round_trip_ms": [1.0] * warm}}))
print(json.dumps({{"event": "cold", "start_ms": [500.0] * cold}}), flush=True)
"""


async def test_the_talk_with_rays_side(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """What Ray's side tells becomes figures and ratios of medians; one that breaks is an error with its last words."""
    fake = tmp_path / "python"
    fake.write_text(FAKE.format(python=sys.executable))
    fake.chmod(fake.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("SWIFTBOT_RAY_PYTHON", str(fake))
    result: dict[str, Any] = {"local": {"p50": 1.0}, "local_round_trip": {"p50": 2.0}, "federated": {"p50": 10.0}}
    result["ray"] = await actors.run(4, 2, progress=lambda _: None)
    assert result["ray"]["start"]["count"] == 4
    assert actors.compare(result)["against_ray"] == {
        "local_over_ray_start": 2.0, "local_over_ray_round_trip": 2.0,
        "ray_cold_over_local": 500.0, "ray_cold_over_federated": 50.0,
    }  # fmt: skip
    fake.write_text(f"#!{sys.executable}\nraise SystemExit('no such thing')\n")
    with pytest.raises(actors.PoolError, match="no such thing"):
        await actors.run(1, 1, progress=lambda _: None)


async def test_refill(built: None) -> None:
    """An empty pool fills, by one and by two starts at the same time."""
    result = await refill.run(2, (1, 2), progress=lambda _: None)
    for starts in (1, 2):
        assert result[f"starts_at_once_{starts}"]["containers_per_s"] > 0
        assert result[f"starts_at_once_{starts}"]["podman_requests"] >= 2


async def test_soak(built: None) -> None:
    """Runs of all kinds end as they must, containers are replaced and killed, and counts are what they were."""
    result = await soak.run(60, at_once=2, progress=lambda _: None)
    assert result["lost"] == 0
    assert sum(result["unexpected"].values()) <= result["killed_from_outside"]
    assert result["killed_from_outside"] >= 1
    assert set(soak.SHARES) <= set(result["ended"])
    assert result["census"]["leaks"] == {}
    assert result["census"]["after"]["containers"] == result["census"]["after"]["conmon"] == soak.CONTAINERS


async def test_zygote(built: None) -> None:
    """Forks and starts are measured for a heap of each kind, beside a plain process that loads the same."""
    result = await zygote.run(2, (4,), plain=1)
    assert [(each["kind"], each["size_mb"]) for each in result["heaps"]] == [("objects", 4), ("buffers", 4)]
    for each in result["heaps"]:
        assert [each[key]["count"] for key in ("fork", "ahead", "at_once", "python")] == [2, 2, 2, 1]
        assert each["rss_mb"] > 4


async def test_transfer(built: None) -> None:
    """A small volume is moved to a gateway that has nothing of it, again after a change, and by Podman."""
    result = await transfer.run(1, 1, progress=lambda _: None)
    assert all(result[f"{way}_ms"] > 0 for way in ("first", "again", "podman"))
    assert 0 < result["wire_share"] <= 1.5


async def test_migrate(built: None) -> None:
    """Moves with checkpoints and with a volume, each step's time, and the alternative; all of them start there."""
    result = await migrate.run(2, 1, 1, 1, part="moves", progress=lambda _: None)
    for name in ("move, checkpoint 1 kB", "move, checkpoint 256 kB"):
        assert result[name]["took"]["count"] == 2
        assert result[name]["took"]["p99"] is not None, result
        assert {"step find", "step hold", "step write", "step start"} <= set(result[name])
    assert result["move, volume 1 MB"]["took"]["max"] is not None, result
    assert result["end, start anew cold"]["count"] == 1


async def test_overload(built: None) -> None:
    """Only with moves on are runs moved, none twice; without, what may run on one gateway alone waits for long runs."""
    load = migrate.Overload(runs=4, work_s=0.5, long_s=15.0, short=4, short_s=0.2)
    result = (await migrate.run(load=load, part="overload", progress=lambda _: None))["overload"]
    assert result["crowd, moves off"]["moves"] == result["held, moves off"]["moves"] == 0
    assert result["crowd, moves on"]["most moves of a run"] <= 1
    on, off = result["held, moves on"], result["held, moves off"]
    assert on["moves"] >= 1
    assert on["most moves of a run"] == 1
    assert on["queue_wait"]["count"] == off["queue_wait"]["count"] == 4
    # Without moves the first of them begins when a long run has ended.
    assert off["queue_wait"]["p50"] > 10_000, result


@pytest.mark.long
async def test_training(built: None) -> None:
    """A container that trains is measured, and two rounds of two clients make a model that is judged."""
    await images.build("learn", load_catalogue())
    small = Clips(train_sites=2, test_sites=1, train_clips=2, test_clips=1)
    result = await training.run("clips", 2, 2, every=1, data=small)
    assert set(result["accuracy"]) == {"1", "2"}
    assert result["epoch_ms"]["count"] == 4
    assert result["cold_ms"]["again"] > 0
    assert result["container_mb"]["private"] > 20
    assert result["update_bytes"] > 290_000


async def test_learning(built: None, tmp_path: Path) -> None:
    """Cells in virtual time and on a fleet are measured and kept; begun again, none is measured a second time."""
    await images.build("learn", load_catalogue())
    told: list[str] = []
    wanted = ("decided-sync-8", "decided-partial-8", "virtual-partial", "costs", "takeover-during")
    result = await learning.run(tmp_path, "clips", "quick", wanted, progress=told.append)
    cells = result["cells"]
    assert {"clips-decided-sync-8", "clips-virtual-partial-seed1", "clips-costs-4", "clips-takeover-during"} <= set(
        cells
    )
    assert cells["clips-virtual-partial-seed1"]["curve"][-1]["accuracy"] > 0
    assert cells["clips-costs-4"]["container_mb"]["private"] > 20
    (kill,) = cells["clips-takeover-during"]["kills"]
    assert (kill["same"], kill["rounds"]) == (True, [1, 2, 3])
    figures = {each["name"]: each for each in result["figures"]}
    assert figures["round time, partial / FedAvg, N = 8, virtual time"]["value"] is not None
    assert figures["round, ours / Flower's simulation"]["met"] is None
    told.clear()
    again = await learning.run(tmp_path, "clips", "quick", wanted, progress=told.append)
    assert again["cells"] == cells
    assert told == [f"{len(cells)} of {len(cells)} cells are there already"]
