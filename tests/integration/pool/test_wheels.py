"""Python packages from wheels in an image, built by the real command and imported by a skill in a real container."""

import hashlib
import json
import subprocess
import sys
import zipfile
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from pool_bench import Bench, write_probe

from appliance.model import Need, RunEventKind, RunRequest
from appliance.pool import images
from appliance.pool.engine import PodmanEngine
from appliance.pool.settings import PoolConfig
from appliance.skills.catalogue import load_catalogue

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.timeout(560), pytest.mark.long]

HANDLER = """
import importlib.metadata
import greetings

def run(ctx):
    return {"text": greetings.greet("yard"), "version": importlib.metadata.version("greetings"),
            "compiled": greetings.__cached__ and __import__("os").path.exists(greetings.__cached__)}
"""


def _wheel(folder: Path) -> str:
    """Write a wheel of one module; returns its hash."""
    folder.mkdir(exist_ok=True)
    file = folder / "greetings-1.0-py3-none-any.whl"
    contents = {
        "greetings.py": "def greet(name):\n    return f'hello {name}'\n",
        "greetings-1.0.dist-info/METADATA": "Metadata-Version: 2.1\nName: greetings\nVersion: 1.0\n",
        "greetings-1.0.dist-info/WHEEL": "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
        "greetings-1.0.dist-info/RECORD": "",
    }
    with zipfile.ZipFile(file, "w") as archive:
        for path, text in contents.items():
            archive.writestr(path, text)
    return hashlib.sha256(file.read_bytes()).hexdigest()


@pytest.fixture
def skills(folder: Path) -> Path:
    """Return a folder with a skill in an image of its own, which wants a package in one version."""
    root = write_probe(folder, HANDLER)
    manifest = root / "probe" / "skill.toml"
    manifest.write_text(manifest.read_text().replace('"base"', '"wheeled"'))
    image = root / "images" / "wheeled"
    image.mkdir(parents=True)
    (image / "image.toml").write_text('name = "wheeled"\npackages = ["python3"]\n')
    (image / "Containerfile").write_text("ARG BASE\nFROM ${BASE}\nARG PACKAGES\n")
    (image / "requirements.txt").write_text(f"greetings==1.0 --hash=sha256:{_wheel(folder / 'elsewhere')}\n")
    return root


@pytest.fixture
async def forgotten(podman: Path, skills: Path) -> AsyncIterator[list[str]]:
    """Return a list of references that are removed from Podman afterwards."""
    references: list[str] = []
    yield references
    storage = PodmanEngine.for_transfers()
    try:
        for each in references:
            await storage.remove_image(each)
    finally:
        storage.close()


def _build(skills: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "appliance.cli", "images", "build", "wheeled", "--skills", str(skills), *arguments],
        capture_output=True, text=True, timeout=400, check=False,
    )  # fmt: skip


def _unwrapped(text: str) -> str:
    """Return a text without the spaces and the ends of lines that a console of 80 columns puts into it."""
    return "".join(text.split())


async def _said(folder: Path, skills: Path) -> dict[str, object]:
    """Return what the skill tells, run in a container of its image."""
    bench = Bench(folder, load_catalogue([skills]))
    pool = await bench.pool(floor={})
    try:
        need = Need(image="wheeled", cpu=0.2, memory_mb=64)
        request = RunRequest(task="t", subtask="s", attempt=1, skill="probe", need=need)
        final = await pool.run(request, await pool.select(need, allow_remote=False), lambda _: None)
        assert final.kind is RunEventKind.SUCCEEDED, final.failure
        assert final.result is not None
        return final.result
    finally:
        await pool.stop(keep_containers=False)


async def test_a_skill_imports_a_wheel_of_its_image(folder: Path, skills: Path, forgotten: list[str]) -> None:
    """A missing or wrong file is reported before anything is built; the right wheel is there in the container."""
    requirements = skills / "images" / "wheeled" / "requirements.txt"
    missing = _build(skills)
    assert missing.returncode != 0
    assert _unwrapped(f"{requirements}:1: greetings==1.0: no wheelhouse") in _unwrapped(missing.stderr)
    assert "pipdownload" in _unwrapped(missing.stderr)

    text = requirements.read_text()
    requirements.write_text(f"greetings==1.0 --hash=sha256:{'0' * 64}\n")
    wrong = _build(skills, "--wheelhouse", str(folder / "elsewhere"))
    assert wrong.returncode != 0
    assert _unwrapped(f"wrong hash: {folder}/elsewhere/greetings-1.0-py3-none-any.whl") in _unwrapped(wrong.stderr)
    requirements.write_text(text)

    built = _build(skills, "--wheelhouse", str(folder / "elsewhere"), "--json")
    assert built.returncode == 0, built.stderr
    reference = json.loads(built.stdout)["wheeled"]
    forgotten.append(reference)
    assert reference == images.reference(load_catalogue([skills]).images["wheeled"], PoolConfig())
    assert await _said(folder, skills) == {"text": "hello yard", "version": "1.0", "compiled": True}
    again = _build(skills)
    assert "is there" in again.stderr, "an image that is there needs no wheelhouse"


async def test_wheels_are_laid_over_an_image_of_a_containerfile(
    folder: Path, skills: Path, built: None, forgotten: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a base image they come from `wheelhouse/` beside the requirements, and go where its own Python looks."""
    base = images.reference(load_catalogue().images["base"], PoolConfig())
    monkeypatch.setenv("SWIFTBOT_BASE_IMAGE", base)
    (folder / "elsewhere").rename(skills / "images" / "wheeled" / "wheelhouse")
    made = _build(skills)
    assert made.returncode == 0, made.stderr
    forgotten.append(made.stdout.strip())
    assert not [each for each in await _tags() if each.startswith(f"{forgotten[0]}-")], "nothing half made is named"
    assert (await _said(folder, skills))["text"] == "hello yard"


async def _tags() -> list[str]:
    storage = PodmanEngine.for_transfers()
    try:
        return [tag for each in await storage.images() for tag in each.tags]
    finally:
        storage.close()
