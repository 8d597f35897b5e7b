"""What goes wrong while a fleet trains, with real gateways and containers: each run ends, or says what it waits for."""

import asyncio
import contextlib
import os
import signal
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest
from msgspec.structs import replace

from appliance.client import FleetClient
from appliance.config import GatewayConfig
from appliance.connection import Endpoint, FleetState
from appliance.errors import DeadlineError, UnreachableError
from appliance.learn import records
from appliance.learn.datasets.make import Clips, make_clips
from appliance.learn.tables import explained
from appliance.llm.settings import LlmConfig
from appliance.model import RunEvent, RunEventKind, keyspace
from appliance.model.learn_api import ClientWhy, LearnShown
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
from appliance.pool.settings import PoolConfig
from workshop import local_fleet
from workshop.local_fleet import Order

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.timeout(600), pytest.mark.long]

CLIPS = Clips(train_sites=2, test_sites=1, train_clips=1, test_clips=1)

MODEL = """
import pathlib, tempfile, time
import torch

def build(classes):
    {fault}
    return torch.nn.Sequential(torch.nn.AdaptiveAvgPool3d((4, 4, 4)), torch.nn.Flatten(), torch.nn.Linear(64, classes))
"""
TENSORS = """
name = "{name}"
task = "classify"
input = "clip"
batch = 5
[[tensors]]
name = "2.weight"
shape = ["classes", 64]
[[tensors]]
name = "2.bias"
shape = ["classes"]
"""
FAULTS = {
    "memory": ("bytearray(16 << 30)", "ran out of its memory"),
    "hang": ("time.sleep(3600)", "no answer within 20 s"),
    "disk": (
        "[pathlib.Path(tempfile.gettempdir(), str(n)).write_bytes(bytes(8 << 20)) for n in range(500)]",
        "No space left on device",
    ),
}
"""What a model's code does at the first gateway, and what is told of it."""


def write_model(folder: Path, name: str, fault: str = "") -> None:
    """Lay a small model into a gateway's folder of data."""
    at = folder / "models" / name
    at.mkdir(parents=True, exist_ok=True)
    (at / "model.toml").write_text(TENSORS.format(name=name))
    (at / "model.py").write_text(MODEL.format(fault=fault or "pass"))


@contextlib.asynccontextmanager
async def fleet_of(folder: Path, pools: list[PoolConfig], *, robots: int = 0) -> AsyncIterator[FleetState]:
    """Run a fleet of so many gateways, each with a pool of its own, and robots at them in turn."""
    order = Order(
        fleet=f"x{os.getpid()}-{time.monotonic_ns() % 100000}", directory=folder / "fleet", gateways=len(pools),
        mavlink=robots, zenoh=0, pools={f"gw-{number}": pool for number, pool in enumerate(pools, start=1)},
        base=GatewayConfig(id="base", llm=LlmConfig(tiers=("rules",))),
    )  # fmt: skip
    state = await local_fleet.up(order, progress=print, timeout_s=180.0)
    try:
        yield state
    finally:
        await local_fleet.down(order.directory, progress=print, volumes=True)


async def until(client: FleetClient, run: str, wanted: Callable[[LearnShown], bool], *, s: float = 150) -> LearnShown:
    """Wait until what is shown of a run is so."""
    found: LearnShown | None = None
    try:
        async with asyncio.timeout(s):
            while True:
                with contextlib.suppress(UnreachableError, DeadlineError):  # gateways that have just come or gone
                    found = await client.learn_show(run)
                    if wanted(found):
                        return found
                await asyncio.sleep(0.1)
    except TimeoutError:
        raise AssertionError(f"not so: {found}") from None


async def ended(client: FleetClient, run: str, *, s: float = 150) -> RunRecord:
    """Wait for a run's end."""
    return (await until(client, run, lambda found: found.run.state.final, s=s)).run


def at_first(fleet: FleetState) -> FleetClient:
    """A client of the first gateway."""
    return FleetClient(Endpoint(fleet=fleet.fleet, connect=(fleet.endpoints[0],)))


def why(found: LearnShown, name: str) -> ClientWhy:
    """What `swiftbot learn why` tells of a client."""
    return explained(found, next(each for each in found.run.clients if each.name == name))


async def test_clients_that_run_out_of_memory_hang_or_fill_their_disk_are_left_out(tmp_path: Path) -> None:
    """Four robots at two gateways, of which one breaks its clients: rounds close with the others', and say why.

    Where nothing breaks, robots at one gateway count side by side, each with data of its own.
    """
    pools: list[PoolConfig] = []
    for number in (1, 2):
        folder = tmp_path / f"data-{number}"
        for robot in (number, number + 2):
            make_clips(folder / f"drone_{robot}" / "clips", CLIPS)
        write_model(folder, "sound")
        for name, (fault, _) in FAULTS.items():
            write_model(folder, name, fault if number == 1 else "")
        pools.append(PoolConfig(floor={"learn": 2}, capacity=3, folders={"learning": str(folder)}))
    recipe = Recipe(
        model="sound", data=Data(folder="{robot}/clips"),
        clients=Clients(robots=tuple(f"drone_{number}" for number in range(1, 5))),
        rounds=Rounds(count=1, mode=Mode.SYNC, timeout_s=20.0), evaluation=Evaluation(every=0),
    )  # fmt: skip
    async with fleet_of(tmp_path, pools, robots=4) as fleet, FleetClient(fleet.endpoint) as client:
        await client.learn_start("sound", replace(recipe, rounds=Rounds(count=2, mode=Mode.SYNC)))
        sound = await ended(client, "sound")
        assert [(line.clients, line.samples) for line in sound.history] == [(4, 80), (4, 80)]
        assert all((each.rounds, each.samples) == (2, 20) for each in sound.clients)
        for name, (_, told) in FAULTS.items():
            await client.learn_start(name, replace(recipe, model=name))
            run = await ended(client, name)
            assert (run.state, run.history[0].clients) == (RunState.SUCCEEDED, 2), name
            assert {each.name: each.rounds for each in run.clients} == {
                "drone_1": 0, "drone_2": 1, "drone_3": 0, "drone_4": 1
            }  # fmt: skip
            found = await client.learn_show(name)
            for robot in ("drone_1", "drone_3"):
                assert told in why(found, robot).client.note, (name, why(found, robot))


async def test_without_a_free_container_a_round_waits_and_says_why(tmp_path: Path) -> None:
    """The only container trains for another run: `show` and `why` say so; once it is free the run goes on."""
    make_clips(tmp_path / "data" / "clips", CLIPS)
    write_model(tmp_path / "data", "sound")
    pool = PoolConfig(floor={"learn": 1}, capacity=1, queue_wait_s=10.0, folders={"learning": str(tmp_path / "data")})
    recipe = Recipe(
        model="sound", data=Data(name="clips"), clients=Clients(partitions=1, by="even"),
        rounds=Rounds(count=1, mode=Mode.SYNC), evaluation=Evaluation(every=0),
    )  # fmt: skip
    async with fleet_of(tmp_path, [pool]) as fleet, FleetClient(fleet.endpoint) as client:
        slow = replace(recipe, emulation=Emulation(nominal_batch_s=300.0), training=Training(batch=1))
        await client.learn_start("busy", slow)
        await until(client, "busy", lambda found: found.clients[0].state is Activity.TRAINING)
        await client.learn_start("waits", recipe)
        queued = await until(client, "waits", lambda found: "1 of 1 in line" in found.clients[0].why)
        assert queued.clients[0].state is Activity.WAITING
        # Longer than it may stand in line: the order is made again, and the reason stays.
        later = await until(client, "waits", lambda found: why(found, "part-000").status.attempt > 1)
        shown = await until(
            client, "waits", lambda found: bool(found.round and "gw-1" in found.round.waits and found.clients[0].why)
        )
        assert later.run.history == ()
        assert shown.round is not None
        assert "1 of 1 clients: part-000 (" in shown.round.waits
        assert why(shown, "part-000").status.why
        print(shown.round.waits, "|", why(shown, "part-000").status.why)
        await client.learn_steer("busy", "stop")
        assert (await ended(client, "waits")).state is RunState.SUCCEEDED


@pytest.mark.parametrize("phase", ["before", "in", "after"])
async def test_a_coordinator_that_is_killed_around_aggregation_costs_nothing(tmp_path: Path, phase: str) -> None:
    """SIGKILL when the last update has come, while updates are summed, when they are: the models of a calm run.

    What is aggregated is asked for under the same name by the successor, and each round has one model.
    """
    make_clips(tmp_path / "data" / "clips", CLIPS)
    write_model(tmp_path / "data", "sound")
    recipe = Recipe(
        model="sound", data=Data(name="clips"), clients=Clients(partitions=4, by="even"),
        rounds=Rounds(count=3, mode=Mode.SYNC), evaluation=Evaluation(every=0),
    )  # fmt: skip
    pool = PoolConfig(floor={"learn": 1}, capacity=3, folders={"learning": str(tmp_path / "data")})
    # By way of one that is not killed.
    async with fleet_of(tmp_path, [pool] * 3) as fleet, at_first(fleet) as client:
        await client.learn_start("calm", recipe)
        calm = await ended(client, "calm")
        ring = Ring(sorted(client.plane.members()), virtual_nodes=client.plane.config.virtual_nodes)
        name = next(
            each for each in (f"r{number}" for number in range(1000))
            if ring.owner(records.round_key(each, 2)) == "gw-2" and ring.owner(records.run_key(each)) != "gw-2"
        )  # fmt: skip
        process = client.plane.registry.gateways["gw-2"].pid
        trained: set[str] = set()
        killed: list[str] = []

        def hear(_: str, event: RunEvent | None) -> None:
            if event is None or killed:
                return
            sums = event.subtask.startswith("aggregate")
            if event.kind is RunEventKind.SUCCEEDED and not sums:
                trained.add(event.subtask)
            due = {
                "before": len(trained) == 4,
                "in": sums and event.kind is RunEventKind.STARTED,
                "after": sums and event.kind is RunEventKind.SUCCEEDED,
            }
            if due[phase]:
                os.kill(process, signal.SIGKILL)
                killed.append(f"{event.subtask} {event.kind}")

        with contextlib.closing(
            client.plane.session.subscribe_typed(keyspace.RUN_EVENT, hear, records.task_of(name, 2))
        ):
            await client.learn_start(name, recipe)
            run = await ended(client, name)
        assert killed
        assert [line.number for line in run.history] == [1, 2, 3]
        assert [line.digest for line in run.history] == [line.digest for line in calm.history]
        assert all(line.clients == 4 for line in run.history)
