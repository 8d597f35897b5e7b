"""A pool on an engine without containers, and what a test needs around it."""

import asyncio
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import pytest

from appliance.errors import UnreachableError
from appliance.identity.parts import ALL, InForce
from appliance.model import ContainerInfo, ContainerState, Need, Phase, RunEvent, RunRequest, Site
from appliance.pool import images
from appliance.pool.pool import Call, Pool
from appliance.pool.pressure import Reading
from appliance.pool.selection import Candidate, Decision
from appliance.pool.settings import PoolConfig
from appliance.pool.volumes import ALONE, State
from appliance.skills.catalogue import Catalogue
from tests.unit.pool.fake_engine import FakeEngine

COLD = Decision(phase=Phase.COLD, gateway="g1")
"""That a run begins in a container that is started for it."""


async def until(true: Callable[[], bool], what: str, *, within_s: float = 60.0) -> None:
    """Wait until something holds; fails with what it was."""
    try:
        async with asyncio.timeout(within_s):
            while not true():
                await asyncio.sleep(0.005)
    except TimeoutError:
        pytest.fail(f"not within {within_s} s: {what}")


class Bench:
    """A pool on a fake engine, and what a test needs around it."""

    def __init__(self, folder: Path, catalogue: Catalogue) -> None:
        self.folder = folder
        self.catalogue = catalogue
        self.engine = FakeEngine(folder)
        self.engine.references = {name: images.reference(each, PoolConfig()) for name, each in catalogue.images.items()}
        self.pools: list[Pool] = []
        self.changes: list[tuple[ContainerInfo, ...]] = []
        self.calls: list[Call] = []
        self.offers: list[Candidate] = []
        self.avoided: list[set[str]] = []
        self.memory = Reading()

    async def answer(self, call: Call) -> dict[str, Any]:
        """Carry out a handler's call."""
        self.calls.append(call)
        match call.name:
            case "command" if call.args["verb"] == "fly":
                raise UnreachableError("no such robot", remedy="look for it")
            case "command":
                return {"at": call.args["args"], "blobs": {"a.png": b"123"}}
            case "put_artifact":
                return {"artifact": "abc", "bytes": len(call.args["data"])}
            case "get_artifact":
                return {"data": b"\x00\xff"}
            case _:
                return {"number": call.number}

    async def find_remote(self, need: Need, avoid: Collection[str]) -> list[Candidate]:
        """Offer what the test has put there for this image, and note whose will not be used."""
        self.avoided.append(set(avoid))
        return [each for each in self.offers if each.container.image == need.image]

    async def pool(
        self, *, gateway: str = "g1", fleet: str = "f1", state: State = ALONE, parts: InForce = ALL, **settings: Any
    ) -> Pool:
        """Return a started pool."""
        settings = {"floor": {}, "cancel_grace_s": 0.3, "probe_s": 0.2, "mode": "local"} | settings
        pool = Pool(
            PoolConfig(**settings),
            gateway=gateway,
            fleet=fleet,
            run_dir=self.folder / "run" / fleet / gateway,
            data_dir=self.folder / "data" / fleet / gateway,
            catalogue=self.catalogue,
            site=Site(name="yard"),
            find_remote=self.find_remote,
            on_call=self.answer,
            on_change=self.changes.append,
            state=state,
            make_engine=lambda: self.engine,
            read_memory=lambda: self.memory,
            parts=parts,
        )
        self.pools.append(pool)
        await pool.start()
        return pool

    @staticmethod
    def request(number: int = 1, *, skill: str = "probe", image: str = "base", **more: Any) -> RunRequest:
        """Return an order to run a skill; `do` and others are its parameters."""
        deadline_s = more.pop("deadline_s", 10.0)
        volumes = more.pop("volumes", ())
        return RunRequest(
            task="t",
            subtask=f"s{number}",
            attempt=1,
            skill=skill,
            need=Need(image=image, cpu=0.1, memory_mb=64, volumes=volumes),
            params=more,
            deadline_s=deadline_s,
        )

    async def run(self, pool: Pool, request: RunRequest) -> tuple[RunEvent, list[RunEvent]]:
        """Select and run; returns the last event and those before."""
        events: list[RunEvent] = []
        decision = await pool.select(request.need, allow_remote=False)
        return await pool.run(request, decision, events.append), events

    @staticmethod
    async def ready(pool: Pool, count: int, image: str = "base") -> None:
        """Wait until a pool has so many ready containers of an image."""

        def enough() -> bool:
            return sum(c.state is ContainerState.READY and c.image == image for c in pool.containers()) == count

        await until(enough, f"{count} ready containers of {image}")

    until = staticmethod(until)

    async def close(self) -> None:
        """End everything."""
        for pool in self.pools:
            await pool.stop(keep_containers=True)
        for container in list(self.engine.processes):
            await self.engine.kill(container)
