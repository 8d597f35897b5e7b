"""One recipe built twice, in other folders and at other times, by the real command: the same image."""

import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from appliance.pool.engine import PodmanEngine
from appliance.pool.oci import PACKAGES

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.timeout(560), pytest.mark.long]


def _skills(folder: Path) -> Path:
    """Write an image with a Debian package and a wheel; returns its folder of skills."""
    image = folder / "images" / "twice"
    (image / "wheelhouse").mkdir(parents=True)
    wheel = image / "wheelhouse" / "greetings-1.0-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        for path, text in {
            "greetings.py": "KNOWN = {'yard', 'dock', 'gate'}\ndef greet(name):\n    return f'hello {name}'\n",
            "greetings-1.0.dist-info/METADATA": "Metadata-Version: 2.1\nName: greetings\nVersion: 1.0\n",
            "greetings-1.0.dist-info/WHEEL": "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
        }.items():
            archive.writestr(path, text)
    pinned = hashlib.sha256(wheel.read_bytes()).hexdigest()
    (image / "image.toml").write_text('name = "twice"\npackages = ["python3"]\n')
    (image / "requirements.txt").write_text(f"greetings==1.0 --hash=sha256:{pinned}\n")
    return folder


@pytest.fixture
async def storage(podman: Path) -> AsyncIterator[PodmanEngine]:
    """Podman."""
    engine = PodmanEngine.for_transfers()
    yield engine
    engine.close()


def _build(skills: Path) -> str:
    """Build the image with a folder of temporary files of its own; returns its reference."""
    with tempfile.TemporaryDirectory() as temporary:
        Path(temporary).chmod(0o755)  # root of the build's user namespace goes through it
        built = subprocess.run(
            [sys.executable, "-m", "appliance.cli", "images", "build", "twice", "--skills", str(skills), "--json"],
            capture_output=True, text=True, timeout=250, check=False, env=os.environ | {"TMPDIR": temporary},
        )  # fmt: skip
    assert built.returncode == 0, built.stderr
    return json.loads(built.stdout)["twice"]


def _in(reference: str, *command: str) -> str:
    """Return what a command says in a container of the image."""
    run = ["podman", "run", "--rm", "--network=none", reference, *command]
    return subprocess.run(run, capture_output=True, text=True, timeout=60, check=True).stdout


async def test_built_twice_it_is_the_same_image(folder: Path, storage: PodmanEngine) -> None:
    """The id is the same, so one signature holds for both; the image says which packages are in it, with digests."""
    ids: list[str] = []
    for skills in (_skills(folder / "one"), shutil.copytree(folder / "one", folder / "other")):
        reference = _build(skills)
        ids.append((await storage.image(reference)).id)
        listed = {line.split()[0]: line.split()[-1] for line in _in(reference, "cat", f"/{PACKAGES}").splitlines()}
        assert len(listed["python3"]) == 64
        assert _in(reference, "python3", "-c", "import greetings; print(greetings.greet('yard'))") == "hello yard\n"
        await storage.remove_image(reference)
    assert ids[0] == ids[1]
