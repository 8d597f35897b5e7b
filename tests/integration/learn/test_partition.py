"""Federated learning over a partition of a real fleet: both halves go on, and afterwards each round has one model."""

import asyncio
import contextlib
import os
import time
from functools import partial
from pathlib import Path

import pytest
from fleets import RULES
from relays import Relay, router

from appliance import config as configuration
from appliance.client import FleetClient
from appliance.config import GatewayConfig
from appliance.connection import Endpoint
from appliance.errors import DeadlineError, NotFoundError, UnreachableError
from appliance.learn.datasets.make import Clips, make_clips
from appliance.model.learning import Clients, Emulation, Evaluation, Mode, Recipe, Rounds, RunRecord, RunState, Training
from appliance.plane.settings import PlaneConfig
from appliance.pool.engine import remove_fleet
from appliance.pool.settings import PoolConfig
from appliance.ports import free_port
from tests.integration.tasks.test_partition import process, until_seen

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.timeout(900), pytest.mark.long]

NAMES = ("gw-1", "gw-2", "gw-3", "gw-4")
LEASE_MS = 5000


async def shown(client: FleetClient) -> RunRecord | None:
    """The run as a side of the partition has it; None while that side cannot tell."""
    with contextlib.suppress(UnreachableError, DeadlineError, NotFoundError):
        return (await client.learn_show("one")).run
    return None


async def reached(client: FleetClient, number: int) -> RunRecord:
    """Wait until a run has closed so many rounds."""
    async with asyncio.timeout(240):
        while True:
            run = await shown(client)
            if run is not None and run.model.number >= number:
                return run
            await asyncio.sleep(0.3)


async def test_each_round_has_one_model_after_both_halves_have_trained(tmp_path: Path) -> None:
    """Both halves close rounds of their own while they are apart; afterwards both have one run, which goes on."""
    data = tmp_path / "data"
    make_clips(data / "clips", Clips(train_sites=4, test_sites=2, train_clips=1, test_clips=1))
    fleet = f"q{os.getpid()}-{time.monotonic_ns() % 100000}"
    one, other, between = free_port(), free_port(), free_port()
    relay = Relay(between, one)
    recipe = Recipe(
        model="clips", clients=Clients(partitions=4, by="even"), training=Training(batch=5),
        rounds=Rounds(count=500, mode=Mode.PARTIAL), evaluation=Evaluation(every=0),
        emulation=Emulation(nominal_batch_s=1.0),
    )  # fmt: skip
    async with contextlib.AsyncExitStack() as stack:
        stack.push_async_callback(partial(remove_fleet, fleet, volumes=True))
        await relay.mend()
        stack.push_async_callback(relay.cut)
        ends = [f"tcp/127.0.0.1:{port}" for port in (one, other)]
        await stack.enter_async_context(router(ends[0], lease_ms=LEASE_MS))
        await stack.enter_async_context(router(ends[1], f"tcp/127.0.0.1:{between}", lease_ms=LEASE_MS))
        for number, name in enumerate(NAMES):
            config = GatewayConfig(
                id=name, fleet=fleet, llm=RULES, data_dir=str(tmp_path / name), drain_s=1.0, keep_containers=False,
                plane=PlaneConfig(mode="client", connect=(ends[number // 2],), lease_ms=LEASE_MS),
                pool=PoolConfig(floor={"learn": 1}, capacity=4, folders={"learning": str(data)}),
            )  # fmt: skip
            path = tmp_path / f"{name}.toml"
            path.write_text(configuration.dump(config))
            await stack.enter_async_context(process(tmp_path, name, "gateway", "--config", str(path)))
        here, there = [
            await stack.enter_async_context(FleetClient(Endpoint(fleet=fleet, connect=(end,)))) for end in ends
        ]
        for client in (here, there):
            await until_seen(client, set(NAMES), ready=1)
        await here.learn_start("one", recipe)
        common = await reached(here, 2)
        await relay.cut()
        await until_seen(here, set(NAMES[:2]))
        await until_seen(there, set(NAMES[2:]))
        # Of the same clients both would make the same models, bit by bit.
        await there.learn_steer("one", "exclude", client="part-003")
        apart = [await reached(client, common.model.number + 4) for client in (here, there)]
        assert apart[0].model.digest != apart[1].model.digest
        await relay.mend()
        for client in (here, there):
            await until_seen(client, set(NAMES))
        async with asyncio.timeout(60):  # what the other half has trained counts in the next round
            while (run := await shown(here)) is None or not run.apart:
                await asyncio.sleep(0.1)
        assert run.apart[0] > common.model.number
        ahead = max(run.model.number for run in apart)
        later = await reached(here, ahead + 3)
        assert [line.number for line in later.history] == list(range(1, later.model.number + 1))
        await here.learn_steer("one", "stop")
        async with asyncio.timeout(60):
            while True:
                both = [await shown(client) for client in (here, there)]
                if both[0] is not None and both[0] == both[1] and both[0].state is RunState.STOPPED:
                    break
                await asyncio.sleep(0.3)
        histories = [[line.digest for line in run.history] for run in apart]
        final = [line.digest for line in both[0].history]
        assert final[: len(common.history)] == [line.digest for line in common.history]
        assert any(final[: len(side)] == side for side in histories)
        assert both[0].apart == ()
