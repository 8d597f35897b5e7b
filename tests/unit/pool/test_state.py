"""State volumes and images of other gateways, as the pool asks for them; what is behind is played by the test."""

import asyncio
import contextlib
from collections.abc import AsyncGenerator, Iterable
from typing import Any

import pytest
from msgspec.structs import replace

from appliance.errors import NotFoundError, PrerequisiteError, RefusedError, UnreachableError
from appliance.model import ContainerState, Phase, RunEventKind
from appliance.model.pool_api import ReleaseAsk
from appliance.pool.selection import Decision
from appliance.pool.volumes import State
from appliance.skills.catalogue import Catalogue

pytestmark = pytest.mark.anyio

COLD = Decision(phase=Phase.COLD, gateway="g1")


class Elsewhere:
    """State and images as another gateway would have them; notes what is asked of it, in order."""

    def __init__(self) -> None:
        self.log: list[str] = []
        self.newer: set[str] = set()
        self.come = asyncio.Event()
        self.come.set()
        self.problem: Exception | None = None

    async def bring(self, names: Iterable[str]) -> None:
        """Bring volumes, once the test lets them come."""
        self.log.append("bring " + " ".join(names))
        await self.come.wait()
        if self.problem is not None:
            raise self.problem
        self.newer.clear()

    @contextlib.asynccontextmanager
    async def use(self, names: Iterable[str]) -> AsyncGenerator[None]:
        """Note the use."""
        self.log.append("use " + " ".join(names))
        yield
        self.log.append("used " + " ".join(names))

    def state(self) -> State:
        """Return the pool's doors to it."""
        return State(bring=self.bring, use=self.use, newest_here=lambda name: name not in self.newer)


async def test_state_comes_before_the_run(bench: Any) -> None:
    """The newest state is brought before a run begins, and its use ends before the run's end is published."""
    there = Elsewhere()
    pool = await bench.pool(state=there.state(), floor={"base": 1})
    await bench.ready(pool, 1)
    there.come.clear()
    task = asyncio.create_task(bench.run(pool, bench.request(1, volumes=("map",))))
    await bench.until(lambda: there.log == ["bring map"], "it is asked for")
    assert ContainerState.RESERVED in {each.state for each in pool.containers()}
    there.come.set()
    final, events = await task
    assert final.kind is RunEventKind.SUCCEEDED
    assert there.log == ["bring map", "use map", "used map"]
    assert events[0].startup_ms > 0
    plain, _ = await bench.run(pool, bench.request(2))
    assert plain.kind is RunEventKind.SUCCEEDED
    assert len(there.log) == 3


async def test_state_comes_while_the_container_starts(bench: Any) -> None:
    """A cold start and its state come at the same time; a container that waits for state is nobody else's."""
    there = Elsewhere()
    there.come.clear()
    pool = await bench.pool(state=there.state(), lease_s=0.1, capacity=1)
    task = asyncio.create_task(pool.run(bench.request(1, volumes=("map",)), COLD, lambda _: None))
    await bench.until(
        lambda: [each.state for each in pool.containers()] == [ContainerState.RESERVED], "the container waits"
    )
    other = asyncio.create_task(pool.run(bench.request(2), COLD, lambda _: None))
    await bench.until(lambda: pool.queue == 1, "the other waits in the queue")
    await asyncio.sleep(0.2)  # longer than the lease
    assert pool.queue == 1
    there.come.set()
    first, second = await asyncio.gather(task, other)
    assert (first.kind, second.kind) == (RunEventKind.SUCCEEDED, RunEventKind.SUCCEEDED)
    assert (first.phase, second.phase) == (Phase.COLD, Phase.LOCAL_WARM)
    assert pool.refused == {}


async def test_state_that_does_not_come(bench: Any) -> None:
    """A run whose state cannot be had is given back with the reason, and its container serves the next."""
    there = Elsewhere()
    there.problem = UnreachableError("g2 has it and does not answer")
    pool = await bench.pool(state=there.state(), floor={"base": 1}, capacity=1)
    await bench.ready(pool, 1)
    with pytest.raises(UnreachableError, match="g2 has it"):
        await bench.run(pool, bench.request(1, volumes=("map",)))
    final, _ = await bench.run(pool, bench.request(2))
    assert final.kind is RunEventKind.SUCCEEDED
    there.come.clear()
    task = asyncio.create_task(bench.run(pool, bench.request(3, volumes=("map",))))
    await bench.until(lambda: there.log[-1] == "bring map" and len(there.log) == 2, "it is asked for again")
    assert await pool.cancel("t/s3/1")
    assert (await task)[0].failure.code == "cancelled"
    await bench.ready(pool, 1)


async def test_containers_tell_what_state_is_here(bench: Any) -> None:
    """A container's facts list a volume only while its newest state is here."""
    whole = bench.catalogue
    stateful = replace(whole.skills["probe"], volumes=("map",))
    bench.catalogue = Catalogue(whole.domains, {**whole.skills, "probe": stateful}, whole.images)
    there = Elsewhere()
    pool = await bench.pool(state=there.state(), floor={"base": 1})
    await bench.ready(pool, 1)

    def volumes() -> set[str]:
        return {name for each in pool.containers() for name in each.volumes}

    await bench.ready(pool, 1)
    assert "map" in volumes()
    there.newer.add("map")
    await bench.until(lambda: "map" not in volumes(), "a newer state elsewhere is noticed")
    there.newer.clear()
    await bench.until(lambda: "map" in volumes(), "it is here again")


async def test_an_image_comes_from_another_gateway(bench: Any) -> None:
    """An image that is not here is brought as part of the cold start, whose cost counts the transfer."""
    bench.engine.missing = {"base"}
    asked: list[str] = []

    async def bring_image(reference: str) -> None:
        asked.append(reference)
        await asyncio.sleep(0.3)
        bench.engine.missing.clear()

    pool = await bench.pool(state=State(bring_image=bring_image))
    final = await pool.run(bench.request(1), COLD, lambda _: None)
    assert (final.kind, final.phase) == (RunEventKind.SUCCEEDED, Phase.COLD)
    assert asked == [bench.engine.references["base"]]
    assert pool.cold_ms("base") > 300
    assert pool.problem == ""


async def test_an_image_that_nobody_has(bench: Any) -> None:
    """The pool says which image is missing and what to do, tries in vain no more, and goes on when it is there."""
    bench.engine.missing = {"base"}
    pool = await bench.pool(floor={"base": 1}, quarantine_s=600)
    await bench.until(lambda: bool(pool.problem), "the pool says so")
    reference = bench.engine.references["base"]
    assert pool.problem == (
        f"image {reference} is not on g1: no other gateway is known that has {reference} (swiftbot images build)"
    )
    tried = bench.engine.calls["create"]
    with pytest.raises(RefusedError, match="is not on g1"):
        await pool.select(bench.request().need, allow_remote=False)
    assert bench.engine.calls["create"] == tried == 1
    bench.engine.missing.clear()
    await bench.ready(pool, 1)
    assert pool.problem == ""


async def test_a_missing_image_is_tried_at_an_operators_word(bench: Any) -> None:
    """Another gateway may have it by now: an operator's release is a new try at once."""
    bench.engine.missing = {"base"}
    has: list[str] = []

    async def bring_image(reference: str) -> None:
        if not has:
            raise NotFoundError(f"nobody has {reference}")
        bench.engine.missing.clear()

    pool = await bench.pool(state=State(bring_image=bring_image), quarantine_s=600)
    with pytest.raises(PrerequisiteError, match="nobody has"):
        await pool.run(bench.request(1), COLD, lambda _: None)
    has.append("g2")
    assert "nobody has" in (await pool.verbs.release_quarantine(ReleaseAsk(image="base"))).reason
    final = await pool.run(bench.request(1), COLD, lambda _: None)
    assert final.kind is RunEventKind.SUCCEEDED
