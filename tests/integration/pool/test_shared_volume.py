"""Two runs in one state volume at once, on real Podman: what docs/skills.md says of it."""

import asyncio

import pytest
from pool_bench import Bench

from appliance.model import RunEventKind
from appliance.pool.engine import PodmanEngine

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.timeout(400)]

COUNT = """
import fcntl, os, time

def run(ctx):
    folder = ctx.volume("notes")
    (folder / f"here-{ctx.robot}").touch()
    while len(list(folder.glob("here-*"))) < 2:  # both are in the volume from here on
        time.sleep(0.005)
    for _ in range(300):
        with (folder / "lock").open("a") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            place = folder / "number"
            number = int(place.read_text()) if place.exists() else 0
            new = folder / f"number.{ctx.robot}"
            new.write_text(str(number + 1))
            os.replace(new, place)
    return {}
"""


@pytest.fixture
def probe() -> tuple[str, str]:
    """Return a skill that counts in a state volume, under a lock there."""
    return COUNT, 'volumes = ["notes"]\n'


async def test_a_lock_in_a_volume_holds_between_containers(bench: Bench) -> None:
    """Two runs that are in one volume at once lose no update of each other's when they take a lock there."""
    pool = await bench.pool(floor={"base": 2}, capacity=2)
    await bench.ready(pool, 2)
    async with asyncio.timeout(60):
        ends = await asyncio.gather(*(bench.run(pool, "", number, robot=f"r{number}") for number in (1, 2)))
    assert [each.kind for each in ends] == [RunEventKind.SUCCEEDED] * 2, [each.failure for each in ends]
    assert len({each.container for each in ends}) == 2
    assert await _number(f"swiftbot-{bench.fleet}-g1-notes") == 600


async def _number(volume: str) -> int:
    storage = PodmanEngine.for_transfers()
    try:
        return int(((await storage.volume(volume)).folder / "number").read_text())
    finally:
        storage.close()
