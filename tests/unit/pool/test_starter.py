"""What containers of an image are given: time to load, folders of the machine, a cache."""

import asyncio
import textwrap
from collections import Counter
from pathlib import Path

import pytest

from appliance.model import Need, Phase, RunRequest
from appliance.pool.settings import PoolConfig
from appliance.pool.starter import IMPORT_S, MAX_RESULT_BYTES, PRELOAD_PART, Starter
from appliance.pool.volumes import ALONE
from appliance.skills.catalogue import Catalogue, load_catalogue
from tests.unit.pool.bench import Bench

pytestmark = pytest.mark.anyio

HANDLER = """
def run(ctx):
    kept = ctx.cache / "kept"
    before = kept.read_text() if kept.exists() else ""
    kept.write_text("worked out")
    try:
        read = (ctx.host_folder("yard") / "map").read_text()
    except ctx.Fail as error:
        read = error.message
    return {"read": read, "before": before} | ctx.params | {"most": ctx.max_result_bytes}
"""
MANIFEST = """
id = "reader"
domain = "media"
summary = "Read."
runs = "compute"
image = "heavy"
folders = ["yard"]
cache = true
"""


@pytest.fixture
def catalogue(tmp_path: Path) -> Catalogue:
    """Return a catalogue with an image of large modules and a skill that reads a folder and caches."""
    root = tmp_path / "skills"
    (root / "reader").mkdir(parents=True)
    (root / "reader" / "handler.py").write_text(textwrap.dedent(HANDLER))
    (root / "reader" / "skill.toml").write_text(MANIFEST)
    (root / "images" / "heavy").mkdir(parents=True)
    (root / "images" / "heavy" / "image.toml").write_text('name = "heavy"\npackages = ["python3"]\nload_s = 60\n')
    return load_catalogue([root])


def _starter(tmp_path: Path, catalogue: Catalogue, config: PoolConfig) -> Starter:
    return Starter(
        config, gateway="g1", fleet="f1", run_dir=tmp_path / "run", data_dir=tmp_path / "data", catalogue=catalogue,
        site={}, refused=Counter(), on_death=lambda _: None, state=ALONE,
    )  # fmt: skip


def test_an_image_of_large_modules_has_its_own_time_to_load(tmp_path: Path, catalogue: Catalogue) -> None:
    """`load_s` bounds each import and all that is loaded, and the start may take longer; other images keep theirs."""
    starter = _starter(tmp_path, catalogue, PoolConfig(start_timeout_s=20.0))
    told = starter._told("heavy")
    assert (told["import_s"], told["patience_s"]) == (60.0, 60.0)
    assert starter.start_timeout_s("heavy") == pytest.approx(60.0 / PRELOAD_PART)
    told = starter._told("base")
    assert (told["import_s"], told["patience_s"]) == (IMPORT_S, pytest.approx(20.0 * PRELOAD_PART))
    assert starter.start_timeout_s("base") == 20.0


def test_a_longer_start_timeout_is_not_cut_by_the_image(tmp_path: Path, catalogue: Catalogue) -> None:
    """An operator's longer `start_timeout_s` counts for each image."""
    starter = _starter(tmp_path, catalogue, PoolConfig(start_timeout_s=300.0))
    assert starter.start_timeout_s("heavy") == 300.0
    assert starter._told("heavy")["patience_s"] == pytest.approx(120.0)


def test_another_folder_is_another_container(tmp_path: Path, catalogue: Catalogue) -> None:
    """A container that mounts another folder than the configuration says now is not adopted."""
    made = {
        _made(tmp_path, catalogue, PoolConfig(folders=folders))
        for folders in ({}, {"yard": str(tmp_path / "a")}, {"yard": str(tmp_path / "b")})
    }
    assert len(made) == 3


def _made(tmp_path: Path, catalogue: Catalogue, config: PoolConfig) -> str:
    starter = _starter(tmp_path, catalogue, config)
    asyncio.run(starter.open())
    return starter._made("heavy")


async def _run(bench: Bench, number: int, **settings: object) -> dict[str, object]:
    pool = await bench.pool(gateway=f"g{number}", **settings)
    need = Need(image="heavy", cpu=0.2, memory_mb=64)
    request = RunRequest(task="t", subtask=f"s{number}", attempt=1, skill="reader", need=need)
    decision = await pool.select(need, allow_remote=False)
    assert decision.phase is Phase.COLD
    last = await pool.run(request, decision, lambda _: None)
    assert last.result is not None, last
    return last.result


async def test_a_folder_of_the_machine_is_read(bench: Bench, tmp_path: Path) -> None:
    """A skill reads the folder that the configuration gives it, and finds in the cache what runs before it left."""
    (tmp_path / "yard").mkdir()
    (tmp_path / "yard" / "map").write_text("dock 3")
    settings = {"folders": {"yard": str(tmp_path / "yard")}}
    assert await _run(bench, 1, **settings) == {"read": "dock 3", "before": "", "most": MAX_RESULT_BYTES}
    assert (bench.folder / "data" / "f1" / "g1" / "cache" / "heavy" / "kept").read_text() == "worked out"


async def test_a_result_beyond_the_limit_is_refused_where_the_handler_returns_it(bench: Bench) -> None:
    """By the one limit that holds for a task's record, with what to do instead; one that just fits is kept."""
    own = bench.folder / "data" / "f1" / "g1" / "folders" / "yard"
    own.mkdir(parents=True)
    (own / "map").write_text("dock 4")
    pool = await bench.pool()
    need = Need(image="heavy", cpu=0.2, memory_mb=64)
    for number, length in enumerate((MAX_RESULT_BYTES - 400, MAX_RESULT_BYTES)):
        request = RunRequest(
            task="t", subtask=f"s{number}", attempt=1, skill="reader", need=need, params={"text": "x" * length}
        )
        last = await pool.run(request, await pool.select(need, allow_remote=False), lambda _: None)
        if length < MAX_RESULT_BYTES:
            assert last.result is not None, last
            continue
        assert last.failure is not None
        assert last.failure.code == "payload"
        assert "at most 49,152 (48 KiB)" in last.failure.message
        assert "ctx.put_artifact" in last.failure.remedy


async def test_a_folder_that_is_not_configured_is_the_gateways_own(bench: Bench) -> None:
    """Without a setting the folder is made in the gateway's data directory."""
    own = bench.folder / "data" / "f1" / "g2" / "folders" / "yard"
    own.mkdir(parents=True)
    (own / "map").write_text("dock 4")
    assert (await _run(bench, 2))["read"] == "dock 4"


async def test_a_configured_folder_that_is_not_there_is_told_to_the_handler(bench: Bench, tmp_path: Path) -> None:
    """A missing folder keeps no container from starting: the run that wants it says which."""
    result = await _run(bench, 3, folders={"yard": str(tmp_path / "gone")})
    assert "'yard' is not mounted" in str(result["read"])
