"""What `swiftbot up` and `down` do with a folder of skills and with state volumes, by the real commands."""

import json
import os
import secrets
import subprocess
import sys
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from pool_bench import write_probe

from appliance.pool.engine import PodmanEngine, remove_fleet

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.timeout(400)]

SMALL = ("--gateways", "1", "--robots", "mavlink=0,zenoh=0", "--detach")


@pytest.fixture
async def fleet(built: None) -> AsyncIterator[str]:
    """Return the name of a fleet of which nothing is left afterwards."""
    name = f"t{os.getpid()}-{secrets.token_hex(3)}"
    yield name
    await remove_fleet(name, volumes=True)


@pytest.fixture
def skills(tmp_path: Path) -> Path:
    """Return a folder with a skill that has a state volume."""
    return write_probe(tmp_path, "def run(ctx):\n    return {}\n", 'volumes = ["notes"]\n')


async def _volumes(fleet: str) -> dict[str, Path]:
    storage = PodmanEngine.for_transfers()
    try:
        return {each.name: each.folder for each in await storage.volumes({"swiftbot.fleet": fleet})}
    finally:
        storage.close()


def _swiftbot(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "appliance.cli", *arguments], capture_output=True, text=True, timeout=200, check=False
    )


async def test_state_volumes_stay_unless_their_removal_is_asked_for(fleet: str, skills: Path, tmp_path: Path) -> None:
    """`down` says how many it keeps and how to remove them, `up` finds what was kept, `--volumes` removes it."""
    where = ("--fleet", fleet, "--dir", str(tmp_path / "fleet"))
    up = _swiftbot("up", *SMALL, *where, "--skills", str(skills))
    assert up.returncode == 0, up.stderr
    volumes = await _volumes(fleet)
    name = f"swiftbot-{fleet}-gw-1-notes"
    others = {f"swiftbot-{fleet}-gw-1-baselines"}  # of built-in skills
    assert set(volumes) == {name, *others}, "the skill of the folder has its volume"
    (volumes[name] / "kept.txt").write_text("kept")

    down = _swiftbot("down", *where)
    assert down.returncode == 0, down.stderr
    assert "kept 2 state volumes" in down.stdout
    assert f"swiftbot down --volumes --fleet {fleet} --dir {tmp_path / 'fleet'}" in " ".join(down.stdout.split())
    assert (volumes[name] / "kept.txt").read_text() == "kept"

    up = _swiftbot("up", *SMALL, *where, "--skills", str(skills))
    assert up.returncode == 0, up.stderr
    assert ((await _volumes(fleet))[name] / "kept.txt").read_text() == "kept"
    down = _swiftbot("down", *where, "--json", "--volumes")
    told = json.loads(down.stdout)
    assert (set(told["removed_volumes"]), told["kept_volumes"], told["problem"]) == ({name, *others}, [], "")
    assert (told["fleet"], told["processes"]) == (fleet, 2)
    assert told["containers"] >= 3
    assert "removed 2 state volumes" in down.stderr
    assert await _volumes(fleet) == {}


async def test_volumes_that_an_earlier_down_kept_can_be_removed(fleet: str, skills: Path, tmp_path: Path) -> None:
    """The command that `down` names works although nothing runs any more; when nothing is left, that is the error."""
    where = ("--fleet", fleet, "--dir", str(tmp_path / "fleet"))
    assert _swiftbot("up", *SMALL, *where, "--skills", str(skills)).returncode == 0
    told = json.loads(_swiftbot("down", *where, "--json").stdout)
    assert (told["removed_volumes"], len(told["kept_volumes"])) == ([], 2)
    again = _swiftbot("down", "--volumes", *where)
    assert again.returncode == 0, again.stderr
    assert "removed 2 state volumes" in again.stdout
    assert await _volumes(fleet) == {}
    nothing = _swiftbot("down", "--volumes", *where)
    assert nothing.returncode != 0
    assert "no fleet runs" in nothing.stderr


def test_a_mistake_in_a_folder_of_skills_is_told_before_anything_starts(skills: Path, tmp_path: Path) -> None:
    """`up` names the file and the key, and leaves no fleet behind."""
    manifest = skills / "probe" / "skill.toml"
    manifest.write_text(manifest.read_text().replace('"compute"', '"nowhere"'))
    where = ("--dir", str(tmp_path / "fleet"))
    for folder, told in ((skills, "probe/skill.toml"), (tmp_path / "absent", "no such folder of skills")):
        up = _swiftbot("up", *SMALL, *where, "--skills", str(folder))
        assert up.returncode != 0
        assert told in up.stderr.replace("\n", "")
    assert not (tmp_path / "fleet" / "fleet.json").exists()
