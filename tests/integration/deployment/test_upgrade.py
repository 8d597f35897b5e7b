"""Upgrade and rollback as a person types them: a real bundle, a real environment made of it without a network.

In a folder of its own in place of /, and with a program in the bundle that is no more than what the upgrade asks of it.
"""

import base64
import hashlib
import os
import signal
import subprocess
import sys
import time
import zipfile
from datetime import UTC, datetime
from pathlib import Path

import msgspec
import pytest

from appliance.deploy.layout import Layout
from appliance.deploy.upgrade import Ended
from appliance.identity import parts
from appliance.identity.authority import Authority
from appliance.identity.parts import Parts
from appliance.model.roles import Role

PROGRAM = """
import json, sys, time

def main():
    if sys.argv[1] == "doctor":
        time.sleep({pause})
        print(json.dumps({checks}))
        sys.exit({code})
"""
GOOD = {"checks": "[]", "code": 0, "pause": 0}
BAD = {"checks": '[dict(name="podman api", ok=False, detail="broken by this release")]', "code": 5, "pause": 0}
SLOW = GOOD | {"pause": 600}


def write_wheel(path: Path, files: dict[str, bytes], name: str, version: str) -> None:
    """Write a wheel."""
    info = f"{name}-{version}.dist-info"
    files = files | {
        f"{info}/METADATA": f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n".encode(),
        f"{info}/WHEEL": b"Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
    }
    lines: list[str] = []
    with zipfile.ZipFile(path, "w") as wheel:
        for entry, content in files.items():
            wheel.writestr(entry, content)
            digest = base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()
            lines.append(f"{entry},sha256={digest},{len(content)}")
        wheel.writestr(f"{info}/RECORD", "\n".join([*lines, f"{info}/RECORD,,"]))


def uv() -> Path:
    """The uv that setup has installed."""
    places = (Path(sys.prefix).parent / "tools/bin/uv", Path(sys.prefix) / ".tools/bin/uv")
    found = [each for each in places if each.exists()]
    if not found:
        pytest.fail("uv is not there: run scripts/setup.sh dev")
    return found[0]


class Box:
    """A machine in a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.root = folder / "root"
        self.layout = Layout(self.root)
        self.swiftbot("release", "key", str(folder / "key"))
        trusted = self.root / "etc/swiftbot/release.pub"
        trusted.parent.mkdir(parents=True)
        trusted.write_bytes((folder / "key.pub").read_bytes())

    def command(self, *words: str) -> list[str]:
        """The command line of the product's own command."""
        return [sys.executable, "-m", "appliance.cli", *words]

    def swiftbot(self, *words: str) -> subprocess.CompletedProcess[str]:
        """Run one."""
        return subprocess.run(self.command(*words), capture_output=True, text=True, check=False)

    def changing(self, *words: str, config: Path | None = None) -> list[str]:
        """The words of one that changes the machine."""
        return [*words, "--root", str(self.root), "--config", str(config or self.folder / "none"), "--json"]

    def bundle(self, version: str, program: dict[str, object], more: dict[str, bytes] | None = None) -> Path:
        """Make a bundle by `swiftbot release pack`, with further files."""
        files, tree = self.folder / version / "files", self.folder / version / "tree"
        for name in ("wheels", "tools", "systemd", "docs"):
            (files / name).mkdir(parents=True)
        write_wheel(
            files / f"wheels/swiftbot-{version}-py3-none-any.whl",
            {
                "program.py": PROGRAM.format(**program).encode(),
                f"swiftbot-{version}.dist-info/entry_points.txt": b"[console_scripts]\nswiftbot = program:main\n",
            },
            "swiftbot",
            version,
        )
        write_wheel(files / "tools/uv-1.0-py3-none-any.whl", {"uv-1.0.data/scripts/uv": uv().read_bytes()}, "uv", "1.0")
        (files / "systemd/swiftbot-gateway.service").write_text(version)
        (files / "docs/operations.md").write_text(version)
        (files / "LICENSE").write_text(version)
        for name, data in (more or {}).items():
            (files / name).parent.mkdir(parents=True, exist_ok=True)
            (files / name).write_bytes(data)
        tree.mkdir()
        (tree / "pyproject.toml").write_text(f'[project]\nversion = "{version}"\n')
        out = self.folder / f"{version}.bundle"
        done = self.swiftbot(
            "release", "pack", str(files), "--key", str(self.folder / "key"), "--out", str(out), "--tree", str(tree)
        )
        assert done.returncode == 0, done.stderr
        return out

    def upgrade(self, *words: str) -> tuple[int, Ended, str]:
        """Upgrade; returns exit code, result, and what it said of each step."""
        done = self.swiftbot(*self.changing("upgrade", *words))
        assert done.stdout.startswith("{"), done.stderr
        return done.returncode, msgspec.json.decode(done.stdout, type=Ended), done.stderr


@pytest.fixture
def box(tmp_path: Path) -> Box:
    """A machine that runs version 1.0."""
    made = Box(tmp_path)
    code, ended, said = made.upgrade(str(made.bundle("1.0", GOOD)))
    assert (code, ended.problem) == (0, ""), said
    return made


def test_upgrade_and_rollback(box: Box) -> None:
    """Installed beside, switched to, checked by its own doctor; units and command are its own; and back."""
    code, ended, said = box.upgrade(str(box.bundle("1.1", GOOD)))
    assert (code, ended.release[:3], ended.before[:3]) == (0, "1.1", "1.0"), said
    for step in ("signature good", "make its environment", "stop the services", "switch to 1.1", "start", "check"):
        assert step in said
    unit = box.root / "usr/local/lib/systemd/system/swiftbot-gateway.service"
    assert unit.read_text() == "1.1"
    assert subprocess.run([box.root / "usr/local/bin/swiftbot", "doctor"], check=False, timeout=60).returncode == 0
    shown = msgspec.json.decode(box.swiftbot("release", "list", "--root", str(box.root), "--json").stdout)
    assert [(each["version"], each["current"], each["previous"]) for each in shown] == [
        ("1.1", True, False),
        ("1.0", False, True),
    ]
    done = box.swiftbot(*box.changing("rollback"))
    assert done.returncode == 0, done.stderr
    assert unit.read_text() == "1.0"


def test_models_and_signed_lists_come_with_a_bundle(box: Box, tmp_path: Path) -> None:
    """A model is in the release and goes with it; of the lists that of the gateway's own fleet counts."""
    lists: dict[str, bytes] = {}
    for number, fleet in enumerate(("mill", "yard")):
        authority = Authority.create(tmp_path / fleet, fleet, datetime.now(UTC))
        authority.sign_parts(Parts(skill={"goto": ("1" * 64,)}))
        lists[f"parts/{number}.json"] = (authority.folder / parts.FILE).read_bytes()
    authority.issue(Role.GATEWAY, "gw-1", out=tmp_path / "yard/gateway.pem")
    config = tmp_path / "gateway.toml"
    (tmp_path / "yard" / parts.FILE).unlink()
    config.write_text(
        f'fleet = "yard"\nid = "gw-1"\ndata_dir = "{tmp_path}/data"\n[plane]\nkeys = "{tmp_path}/yard/gateway.pem"\n'
        'listen = ["tls/127.0.0.1:7447"]\n'
    )
    more = lists | {"models/small/model.onnx": b"weights", "packages/wanted": b"podman\n"}
    file = box.bundle("1.1", GOOD, more)
    done = box.swiftbot(*box.changing("upgrade", str(file), config=config))
    assert done.returncode == 0, done.stderr
    assert (box.layout.current / "models/small/model.onnx").read_bytes() == b"weights"
    assert not (box.layout.current / "parts").exists()
    assert (tmp_path / "yard" / parts.FILE).read_bytes() == lists["parts/1.json"]
    for said in ("without the list of parts 0.json", "the list of parts is number 1", "is not this machine's root"):
        assert said in done.stderr
    assert box.swiftbot(*box.changing("rollback")).returncode == 0
    assert not (box.layout.current / "models").exists()
    shown = box.swiftbot("release", "show", str(file), "--trusted", str(tmp_path / "key.pub"))
    for said in ("models   small", "parts    2 signed lists", "Debian   no packages"):
        assert said in shown.stdout


def test_a_release_that_finds_itself_wrong_is_undone(box: Box) -> None:
    """The check fails: the release before is current again, the exit code and the text say so."""
    code, ended, said = box.upgrade(str(box.bundle("1.1", BAD)))
    assert (code, ended.rolled_back, ended.release[:3]) == (1, True, "1.0")
    assert "broken by this release" in ended.problem
    assert "back: switch to 1.0" in said


def test_refused_bundles_leave_all_as_it_is(box: Box) -> None:
    """Cut in half, an older version, another key: an error with a remedy, nothing beside the release that runs."""
    good = box.bundle("1.1", GOOD)
    half = box.folder / "half"
    half.write_bytes(good.read_bytes()[: good.stat().st_size // 2])
    older = box.bundle("0.9", GOOD)
    before = sorted(box.root.rglob("*"))
    for file, said in ((half, "cut off"), (older, "older than 1.0"), (box.folder / "absent", "cannot be read")):
        done = box.swiftbot("upgrade", str(file), "--root", str(box.root))
        assert done.returncode != 0
        assert said in " ".join(done.stderr.split())
        assert "hint:" in done.stderr
        assert sorted(box.root.rglob("*")) == before
    (box.root / "etc/swiftbot/release.pub").unlink()
    done = box.swiftbot("upgrade", str(good), "--root", str(box.root))
    assert done.returncode == 9
    assert "no key of bundles is trusted" in " ".join(done.stderr.split())


def test_killed_in_the_check_it_is_resumed(box: Box) -> None:
    """Killed while the new release is checked: another upgrade is refused, and --resume checks again and finishes."""
    bundle = box.bundle("1.1", SLOW)
    with subprocess.Popen(
        box.command(*box.changing("upgrade", str(bundle))),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        assert process.stderr is not None
        assert any("check: services stay up" in line for line in process.stderr)
        time.sleep(0.2)
        os.killpg(process.pid, signal.SIGKILL)
    assert box.layout.running().startswith("1.1")
    done = box.swiftbot(*box.changing("upgrade", str(bundle)))
    assert (done.returncode, "--resume" in done.stderr) == (4, True)
    program = next(box.layout.current.glob("venv/lib/python3*/site-packages/program.py"))
    program.write_text(PROGRAM.format(**BAD))
    code, ended, said = box.upgrade("--resume")
    assert (code, ended.release[:3], ended.rolled_back) == (1, "1.0", True), said
    code, ended, _ = box.upgrade("--resume")
    assert (code, ended.problem, ended.release[:3]) == (0, "", "1.0")
