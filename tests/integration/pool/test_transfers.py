"""Pools with volumes and transfers, on real Podman: an image that only another gateway has, and state over runs."""

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace
from pool_bench import HANDLER, Bench
from transfer_bench import podman_service, sides

from appliance.model import Phase, RunEventKind
from appliance.model.pool_api import EvictAsk
from appliance.pool import images, manager
from appliance.pool.engine import PodmanEngine
from appliance.pool.settings import PoolConfig, PressureConfig
from appliance.pool.volumes import State, transfers

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.timeout(400)]

COUNTING = """
    if do == "count":
        path = ctx.volume("notes") / "count"
        count = int(path.read_text()) + 1 if path.exists() else 1
        path.write_text(str(count))
        return {"count": count}
"""


@pytest.fixture
def probe() -> tuple[str, str]:
    """Return a skill that counts its runs in a state volume."""
    return HANDLER + COUNTING, 'volumes = ["notes"]\n'


async def test_a_cold_start_brings_its_image_from_another_gateway(
    bench: Bench, folder: Path, free_ports: Callable[..., list[int]]
) -> None:
    """A pool whose Podman has no image runs a subtask all the same; the next start needs nobody any more."""
    reference = images.reference(bench.catalogue.images["base"], PoolConfig())
    async with podman_service(folder.parent / "second") as url, sides(folder, free_ports(2)) as fleet:
        giver, here = await fleet.start(0), await fleet.start(1, podman=url)
        await fleet.settled()
        assert not await here.storage.has_image(reference)
        state = State(bring_image=here.transfers.bring_image)
        pool = await bench.pool(floor={}, podman_url=url, start_timeout_s=60.0, state=state)
        first = await bench.run(pool, "echo", 1)
        assert (first.kind, first.phase) == (RunEventKind.SUCCEEDED, Phase.COLD), first.failure
        assert (await here.storage.image(reference)).id == (await giver.storage.image(reference)).id
        assert not pool.problem
        await fleet.stop(0)
        await bench.ready(pool)
        assert (await bench.run(pool, "echo", 2)).phase is Phase.LOCAL_WARM
        await bench.ready(pool)
        await pool.verbs.evict(EvictAsk(image="base"))
        third = await bench.run(pool, "echo", 3)
        assert (third.kind, third.phase) == (RunEventKind.SUCCEEDED, Phase.COLD), third.failure
        await pool.stop(keep_containers=False)


async def test_a_warm_run_with_state_asks_nothing_of_podman(
    bench: Bench, folder: Path, free_ports: Callable[..., list[int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each run finds what the last one left, and the fleet knows of it, without one request to Podman's API."""
    for module, name in ((manager, "SWEEP_S"), (manager, "FIRST_SWEEP_S"), (transfers, "_LOOK_S")):
        monkeypatch.setattr(module, name, 1e9)  # what comes by the clock is nobody's run
    asked: list[str] = []
    real = PodmanEngine._ask

    async def watched(self: PodmanEngine, what: str, work: Callable[[Any], Any]) -> Any:
        asked.append(what)
        return await real(self, what, work)

    monkeypatch.setattr(PodmanEngine, "_ask", watched)
    async with sides(folder, free_ports(1)) as fleet:
        side = await fleet.start(0)
        await fleet.settled()
        state = State(bring=side.transfers.bring_newest, use=side.volumes.use, newest_here=side.volumes.newest_here)
        pool = await bench.pool(
            gateway="g0", fleet=side.fleet, capacity=1, state=state, pressure=PressureConfig(watch=False)
        )
        async with asyncio.timeout(60):
            while not side.transfers.images():  # it has looked what there is
                await asyncio.sleep(0.02)
        for number in range(1, 6):
            await bench.ready(pool)
            before = len(asked)
            request = bench.request("count", number)
            need = replace(request.need, volumes=("notes",))
            decision = await pool.select(need, allow_remote=False)
            final = await pool.run(replace(request, need=need), decision, lambda _: None)
            assert (final.phase, final.result) == (Phase.LOCAL_WARM, {"count": number}), final.failure
            assert side.volumes.infos()[0].generation == number
            if number > 1:  # the first one asks where the volume lies
                assert asked[before:] == []
        await pool.stop(keep_containers=False)
