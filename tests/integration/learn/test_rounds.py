"""Federated learning on real gateways, with the product's handlers in containers of image `learn`, on drawn clips."""

import asyncio
import contextlib
import json
import os
import signal
import sys
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest
from msgspec.structs import replace

from appliance.client import FleetClient
from appliance.config import GatewayConfig
from appliance.connection import Endpoint, FleetState
from appliance.errors import ConfigError, DeadlineError, NotFoundError, RefusedError, UnreachableError
from appliance.learn import records
from appliance.learn.datasets.make import Clips, make_clips
from appliance.llm.settings import LlmConfig
from appliance.model.learning import (
    Activity,
    Clients,
    Data,
    Emulation,
    Evaluation,
    Mode,
    Recipe,
    Rounds,
    RunRecord,
    RunState,
    Training,
)
from appliance.plane.ring import Ring
from appliance.pool.engine import LABEL_ID
from appliance.pool.settings import PoolConfig
from appliance.skills._lib.learning import shards
from workshop import local_fleet
from workshop.local_fleet import Order

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.timeout(400)]


@pytest.fixture
async def fleet(tmp_path: Path) -> AsyncIterator[FleetState]:
    """Return a fleet of three gateways whose clients have a few drawn clips."""
    make_clips(tmp_path / "data" / "clips", Clips(train_sites=4, test_sites=2, train_clips=1, test_clips=1))
    order = Order(
        fleet=f"l{os.getpid()}-{time.monotonic_ns() % 100000}",
        directory=tmp_path / "fleet",
        gateways=3,
        mavlink=0,
        zenoh=0,
        pool=PoolConfig(floor={"learn": 1}, folders={"learning": str(tmp_path / "data")}),
        base=GatewayConfig(id="base", llm=LlmConfig(tiers=("rules",))),
    )
    yield await local_fleet.up(order, progress=print, timeout_s=180.0)
    await local_fleet.down(order.directory, progress=print, volumes=True)


def recipe(mode: Mode = Mode.SYNC, *, count: int = 2, clients: int = 4) -> Recipe:
    """A short run on the clips."""
    return Recipe(
        model="clips",
        data=Data(share="fleet"),
        clients=Clients(partitions=clients, by="even"),
        rounds=Rounds(count=count, mode=mode),
        evaluation=Evaluation(every=1),
    )


async def until(client: FleetClient, run: str, wanted: Callable[[RunRecord], bool], *, s: float = 150) -> RunRecord:
    """Wait until a run's record is so."""
    record: RunRecord | None = None
    try:
        async with asyncio.timeout(s):
            while True:
                with contextlib.suppress(UnreachableError, DeadlineError):  # gateways that have just come
                    record = (await client.learn_show(run)).run
                    if wanted(record):
                        return record
                await asyncio.sleep(0.2)
    except TimeoutError:
        raise AssertionError(f"{record} {await client.learn_show(run)}") from None


async def test_a_run_makes_its_models_and_the_same_recipe_makes_the_same(fleet: FleetState) -> None:
    """Two rounds of four clients; the model is on three gateways, evaluated, and of the same digest in a second run."""
    async with FleetClient(fleet.endpoint) as client:
        for name in ("one", "two"):
            started = await client.learn_start(name, recipe())
            assert started.state is RunState.RUNNING
            assert await client.learn_start(name, recipe()) == started
        first = await until(client, "one", lambda run: run.state.final and run.model.accuracy is not None)
        second = await until(client, "two", lambda run: run.state.final)
        assert first.state is RunState.SUCCEEDED
        assert [line.clients for line in first.history] == [4, 4]
        assert len(first.model.gateways) == 3
        assert first.model.digest == second.model.digest
        assert first.models[0].digest != first.model.digest
        assert all(each.epoch_s is not None and each.samples == 10 for each in first.clients)
        manifest = shards.parse_manifest(json.loads(await client.artifact(first.model.manifest or {})))
        files = [await client.artifact(reference) for reference in first.model.shards]
        assert shards.join(manifest, files)["head.weight"].shape == (10, 64)
        with pytest.raises(RefusedError, match="another recipe"):
            await client.learn_start("one", recipe(count=3))
        with pytest.raises(ConfigError, match="model"):
            await client.learn_start("three", Recipe(model="nothing", clients=Clients(partitions=2)))
        with pytest.raises(NotFoundError, match="no run 'four'"):
            await client.learn_show("four")


async def test_a_run_goes_on_when_its_coordinator_is_killed(fleet: FleetState) -> None:
    """The gateway that coordinates the open round is killed: the successor goes on, to the models of a calm run."""
    async with FleetClient(fleet.endpoint) as client:
        names = sorted(client.plane.members())
        await client.learn_start("calm", recipe(count=3))
        calm = await until(client, "calm", lambda run: run.state.final)
        await client.learn_start("one", recipe(count=3))
        await until(client, "one", lambda run: run.round == 2)
        shown = await client.learn_show("one")
        owner = Ring(names, virtual_nodes=client.plane.config.virtual_nodes).owner(records.round_key("one", 2))
        assert shown.round is not None
        os.kill(client.plane.registry.gateways[owner].pid, signal.SIGKILL)
    other = next(end for name, end in zip(sorted(names), fleet.endpoints, strict=True) if name != owner)
    async with FleetClient(Endpoint(fleet=fleet.fleet, connect=(other,))) as client:
        ended = await until(client, "one", lambda run: run.state.final)
        assert [line.number for line in ended.history] == [1, 2, 3]
        assert all(line.clients == 4 for line in ended.history)
        assert [line.digest for line in ended.history] == [line.digest for line in calm.history]


async def reached(endpoint: Endpoint) -> FleetClient:
    """Return an open connection to a fleet that is being started."""
    async with asyncio.timeout(60):
        while True:
            try:
                return await FleetClient(endpoint).open()
            except UnreachableError:
                await asyncio.sleep(0.2)


def started_with(fleet: FleetState, gateway: str) -> tuple[str, ...]:
    """The command of a gateway of the fleet."""
    config = Path(fleet.directory) / gateway / "gateway.toml"
    return (sys.executable, "-m", "appliance.cli", "gateway", "--config", str(config))


async def test_a_run_goes_on_when_all_gateways_were_killed(fleet: FleetState) -> None:
    """Killed in round 2 and started again they go on with it, to the models of a calm run."""
    async with FleetClient(fleet.endpoint) as client:
        await client.learn_start("calm", recipe(count=3))
        calm = await until(client, "calm", lambda run: run.state.final)
        await client.learn_start("one", recipe(count=3))
        await until(client, "one", lambda run: run.round == 2)
    gateways = [process for process in fleet.processes if process.name in fleet.gateways]
    for process in gateways:
        os.kill(process.pid, signal.SIGKILL)
    again = [
        local_fleet.spawn(process.name, started_with(fleet, process.name), Path(process.log)) for process in gateways
    ]
    try:
        async with await reached(fleet.endpoint) as client:
            ended = await until(client, "one", lambda run: run.state.final)
            assert [line.digest for line in ended.history] == [line.digest for line in calm.history]
    finally:
        await local_fleet.end(again, grace_s=20.0)


async def test_a_run_is_paused_resumed_and_stopped_and_a_client_excluded(fleet: FleetState) -> None:
    """Paused, no round closes; resumed it goes on without the excluded client; stopped, it ends with its last model."""
    async with FleetClient(fleet.endpoint) as client:
        await client.learn_start("one", recipe(count=50))
        await until(client, "one", lambda run: run.round == 2)
        paused = await client.learn_steer("one", "pause", why="inspection")
        assert paused.state is RunState.PAUSED
        await client.learn_steer("one", "exclude", client="part-003")
        await asyncio.sleep(3)
        still = (await client.learn_show("one")).run
        assert still.round - paused.round <= 1
        await client.learn_steer("one", "resume")
        later = await until(client, "one", lambda run: run.round >= still.round + 2)
        assert later.history[-1].clients == 3
        with pytest.raises(NotFoundError, match="no client 'part-009'"):
            await client.learn_steer("one", "exclude", client="part-009")
        stopped = await client.learn_steer("one", "stop")
        assert (stopped.state, bool(stopped.model.digest)) == (RunState.STOPPED, True)
        with pytest.raises(RefusedError, match="stopped"):
            await client.learn_steer("one", "resume")


@pytest.mark.long
async def test_a_removed_run_is_gone_and_its_name_is_free(fleet: FleetState) -> None:
    """One that runs is refused; removed, no gateway has it any more, and another of its name begins at round 1."""
    async with FleetClient(fleet.endpoint) as client:
        await client.learn_start("one", recipe(count=2))
        with pytest.raises(RefusedError, match="run one is running"):
            await client.learn_steer("one", "remove")
        first = await until(client, "one", lambda run: run.state.final and run.model.accuracy is not None)
        removed = await client.learn_steer("one", "remove", why="room")
        assert removed.model == first.model
        with pytest.raises(NotFoundError, match="no run 'one'"):
            await client.learn_show("one")
        assert await client.learn_runs() == ((), {})
        again = await client.learn_start("one", recipe(count=2))
        assert (again.round, again.model.number) == (1, 0)
        second = await until(client, "one", lambda run: run.state.final)
        assert [line.digest for line in second.history] == [line.digest for line in first.history]
        with pytest.raises(ConfigError, match="data: 'nothing' at gw-1"):
            await client.learn_start("two", replace(recipe(), data=Data(name="nothing")))


@pytest.mark.long
async def test_a_gateway_and_a_container_that_are_killed_cost_no_update(fleet: FleetState) -> None:
    """A container in mid-training, then a gateway whose clients' updates were accepted: the models are a calm run's.

    The gateway is none that coordinates; what it made was copied when it was accepted, what it was at is made again.
    """
    slow = Emulation(nominal_batch_s=0.3, speeds={"part-000": 6.0})
    wanted = replace(
        recipe(count=2), emulation=slow, training=Training(batch=2), clients=Clients(partitions=4, by="even")
    )
    async with FleetClient(fleet.endpoint) as client:
        await client.learn_start("calm", replace(wanted, emulation=Emulation()))
        calm = await until(client, "calm", lambda run: run.state.final)
        await client.learn_start("one", wanted)
        busy = await podman(
            "ps", "--quiet", "--filter", f"label={LABEL_ID}={await training(client, 'one.1/part-000/')}"
        )
        assert await podman("kill", "--signal", "KILL", busy)
        names = sorted(client.plane.members())
        ring = Ring(names, virtual_nodes=client.plane.config.virtual_nodes)
        safe = {ring.owner(records.round_key("one", 1)), ring.owner(records.run_key("one"))}
        done = await accepted(client, "one", without=safe)
        os.kill(client.plane.registry.gateways[done].pid, signal.SIGKILL)
    other = next(end for name, end in zip(names, fleet.endpoints, strict=True) if name != done)
    async with FleetClient(Endpoint(fleet=fleet.fleet, connect=(other,))) as client:
        ended = await until(client, "one", lambda run: run.state.final)
        assert [line.clients for line in ended.history] == [4, 4], ended.history
        assert [line.digest for line in ended.history] == [line.digest for line in calm.history]


async def podman(*arguments: str) -> str:
    """Run Podman; returns what it prints."""
    process = await asyncio.create_subprocess_exec("podman", *arguments, stdout=asyncio.subprocess.PIPE)
    out, _ = await process.communicate()
    assert process.returncode == 0, arguments
    return out.decode().strip()


async def training(client: FleetClient, run: str) -> str:
    """Return the container in which a run of a client is in progress, by the beginning of its id."""
    async with asyncio.timeout(60):
        while True:
            for held in client.plane.registry.containers.values():
                for container in held.values():
                    if container.run.startswith(run):
                        return container.id
            await asyncio.sleep(0.05)


async def accepted(client: FleetClient, run: str, *, without: set[str]) -> str:
    """Return a gateway at which a client trained whose update was accepted in round 1, but none of those."""
    at: dict[str, str] = {}
    async with asyncio.timeout(60):
        while True:
            shown = await client.learn_show(run)
            assert shown.run.round == 1
            at |= {each.client: each.gateway for each in shown.working if each.gateway}
            done = {each.client for each in shown.clients if each.state is Activity.DONE}
            if found := [at[name] for name in sorted(done & at.keys()) if at[name] not in without]:
                return found[0]
            await asyncio.sleep(0.05)


@pytest.mark.parametrize("mode", [Mode.PARTIAL, Mode.OFFLOAD])
@pytest.mark.long
async def test_a_slow_client_holds_no_round_up(fleet: FleetState, mode: Mode) -> None:
    """One of four is emulated eight times slower: once its speed is known rounds take less than half of its epoch.

    It counts all the same, with `offload` by all of its samples: the rest of them is trained on by others.
    """
    slow = Emulation(nominal_batch_s=0.5, speeds={"part-000": 8.0})
    wanted = replace(recipe(mode, count=10), emulation=slow, training=Training(batch=2))
    async with FleetClient(fleet.endpoint) as client:
        await client.learn_start("one", wanted)
        ended = await until(client, "one", lambda run: run.state.final, s=240)
        later = [(line.took_s, line.all_s) for line in ended.history[-2:]]
        assert all(took_s < all_s / 2 for took_s, all_s in later), [(x.took_s, x.all_s) for x in ended.history]
        slow_one = next(each for each in ended.clients if each.name == "part-000")
        assert slow_one.rounds >= 2
        if mode is Mode.OFFLOAD:
            assert slow_one.samples == 10
