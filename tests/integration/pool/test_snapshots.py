"""Which code containers run when skills are edited under a running gateway, on real Podman.

What is looked for each time: a run's result is that of the code the gateway read at its start, whatever is on disk
meanwhile, and a container that has loaded anything else serves nobody.
"""

import asyncio
from collections.abc import Callable
from pathlib import Path

import pytest
from msgspec.structs import replace
from pool_bench import Bench, engine_ids

from appliance.model import RunEventKind
from appliance.pool.engine import LABEL_SNAPSHOT, LABEL_STATE, ContainerSpec, PodmanEngine
from appliance.pool.pool import Pool

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.timeout(400)]

HANDLER = """
import os
from pathlib import Path

VERSION = 1

def run(ctx):
    table = (ctx.folder / "table.txt").read_text()
    try:
        (ctx.folder / "table.txt").write_text("x")
    except OSError as error:
        return {"version": VERSION, "table": table, "write": error.strerror}
"""


@pytest.fixture
def probe() -> tuple[str, str]:
    """Return a skill that tells which version of it runs."""
    return HANDLER, ""


@pytest.fixture
def write(folder: Path) -> Callable[[int], None]:
    """Return a function that edits the skill on disk to be of a version; it is of version 1."""

    def edit(version: int) -> None:
        skill = folder / "skills" / "probe"
        (skill / "handler.py").write_text(HANDLER.replace("VERSION = 1", f"VERSION = {version}"))
        (skill / "table.txt").write_text(str(version))

    return edit


class OtherMount(PodmanEngine):
    """Podman that mounts a live folder of skills where a snapshot is meant, as gateways once did."""

    live = Path()
    labels: dict[str, str] = {}
    """Labels that are put in the place of the true ones."""

    async def create(self, spec: ContainerSpec) -> str:
        """Make the container with the other mount and labels."""
        binds = {str(self.live) if target == "/skills-1" else source: target for source, target in spec.binds.items()}
        return await super().create(replace(spec, binds=binds, labels=spec.labels | self.labels))


async def _versions(bench: Bench, pool: Pool, number: int) -> tuple[int, str]:
    final = await bench.run(pool, "tell", number)
    assert final.kind is RunEventKind.SUCCEEDED, final.failure
    assert final.result is not None
    assert final.result["write"] == "Read-only file system"
    return final.result["version"], final.result["table"]


def _trees(bench: Bench) -> list[Path]:
    return list((bench.folder / "data" / bench.fleet / "g1" / "snapshots" / "trees").iterdir())


async def _label(bench: Bench, name: str) -> set[str]:
    engine = PodmanEngine(threads=1)
    try:
        found = await engine.containers({"swiftbot.fleet": bench.fleet})
    finally:
        engine.close()
    return {each.labels[name] for each in found}


async def test_code_of_an_edit_that_is_undone_never_runs(bench: Bench, write: Callable[[int], None]) -> None:
    """A container that starts between an edit and its undoing runs, and is adopted with, what the gateway had read."""
    write(1)
    pool = await bench.pool(floor={})
    write(2)
    assert await _versions(bench, pool, 1) == (1, "1")
    await bench.ready(pool)
    (first,) = await engine_ids(bench.fleet)
    await pool.stop(keep_containers=True)
    write(1)
    pool = await bench.pool(floor={})
    assert await engine_ids(bench.fleet) == [first]
    assert await _versions(bench, pool, 2) == (1, "1")


async def test_an_edit_takes_effect_at_the_restart(bench: Bench, write: Callable[[int], None]) -> None:
    """The container of before is not adopted, of data as of code, and its snapshot goes with it."""
    write(1)
    pool = await bench.pool(floor={"base": 1})
    await bench.ready(pool)
    (first,) = await engine_ids(bench.fleet)
    (old,) = _trees(bench)
    await pool.stop(keep_containers=True)
    (bench.folder / "skills" / "probe" / "table.txt").write_text("another")
    pool = await bench.pool(floor={"base": 1})
    await bench.ready(pool)
    assert await _versions(bench, pool, 1) == (1, "another")
    assert first not in await engine_ids(bench.fleet)
    (new,) = _trees(bench)
    assert new != old
    assert await _label(bench, LABEL_SNAPSHOT) == {new.name}


async def test_a_container_whose_label_says_more_than_it_has_loaded_is_not_adopted(
    bench: Bench, write: Callable[[int], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The label is right and the code is not: the runner tells, the container is replaced, counted and named."""
    write(1)
    pool = await bench.pool(floor={"base": 1})
    await bench.ready(pool)
    labels = {name: (await _label(bench, name)).pop() for name in (LABEL_STATE, LABEL_SNAPSHOT)}
    await pool.stop(keep_containers=False)

    write(2)
    monkeypatch.setattr("appliance.pool.pool.PodmanEngine", OtherMount)
    monkeypatch.setattr(OtherMount, "live", bench.folder / "skills")
    monkeypatch.setattr(OtherMount, "labels", labels)
    pool = await bench.pool(floor={"base": 1})
    await bench.ready(pool)
    (liar,) = await engine_ids(bench.fleet)
    await pool.stop(keep_containers=True)
    monkeypatch.undo()

    write(1)
    pool = await bench.pool(floor={"base": 1})
    assert pool.refused["loaded code"] == 1
    await bench.ready(pool)
    assert liar not in await engine_ids(bench.fleet)
    assert await _versions(bench, pool, 1) == (1, "1")


async def test_a_container_that_loads_other_code_is_retired_and_said(
    bench: Bench, write: Callable[[int], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A container that comes up with code of no snapshot never gets a run; the pool names the file and counts it."""
    write(1)
    monkeypatch.setattr("appliance.pool.pool.PodmanEngine", OtherMount)
    monkeypatch.setattr(OtherMount, "live", bench.folder / "skills")
    pool = await bench.pool(floor={}, bad_starts=1)
    write(2)
    final = await asyncio.gather(bench.run(pool, "tell"), return_exceptions=True)
    assert "skills-1/probe/handler.py" in str(final[0])
    assert "snapshot" in pool.problem
    assert pool.refused["loaded code"] == 1
    assert await engine_ids(bench.fleet) == []
