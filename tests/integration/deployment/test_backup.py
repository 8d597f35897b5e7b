"""Backup and restore as a person types them, with a real state volume."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

WORDS = "a long enough passphrase"


def run(*words: str, passphrase: str = "") -> subprocess.CompletedProcess[str]:
    """Run a command."""
    environment = os.environ | ({"SWIFTBOT_PASSPHRASE": passphrase} if passphrase else {})
    return subprocess.run(words, capture_output=True, text=True, check=False, env=environment)


def swiftbot(*words: str, passphrase: str = WORDS) -> subprocess.CompletedProcess[str]:
    """Run the product's own command."""
    return run(sys.executable, "-m", "appliance.cli", *words, passphrase=passphrase)


def test_a_volume_comes_back_with_its_labels(podman: Path, tmp_path: Path) -> None:
    """Written to, backed up, removed, restored: files and labels are there; one that is there is not overwritten.

    Another gateway's volume of the same fleet is none of it.
    """
    assert podman
    name = f"swiftbot-backup-test-{os.getpid()}"
    labels = {"swiftbot.fleet": name, "swiftbot.gateway": "gw-1", "swiftbot.kept": "yes"}
    config, file = tmp_path / "etc/gateway.toml", tmp_path / "file"
    config.parent.mkdir()
    (tmp_path / "data").mkdir()
    config.write_text(f'id = "gw-1"\nfleet = "{name}"\ndata_dir = "{tmp_path}/data"\n')
    options = [word for each in labels.items() for word in ("--label", "=".join(each))]
    assert run("podman", "volume", "create", *options, name).returncode == 0
    other = [each.replace("gw-1", "gw-2") for each in options]
    assert run("podman", "volume", "create", *other, f"{name}-other").returncode == 0
    try:
        at = Path(run("podman", "volume", "inspect", "--format", "{{.Mountpoint}}", name).stdout.strip())
        (at / "state").write_text("learned")
        done = swiftbot("backup", str(file), "--config", str(config))
        assert done.returncode == 0, done.stderr
        assert ", 1 state volume" in " ".join(done.stdout.split())
        (at / "state").write_text("newer")
        root = tmp_path / "root"
        root.mkdir()
        done = swiftbot("restore", str(file), "--root", str(root))
        assert done.returncode == 4, done.stderr
        assert "volumes are here already" in " ".join(done.stderr.split())
        assert (at / "state").read_text() == "newer"
        assert run("podman", "volume", "rm", name).returncode == 0
        done = swiftbot("restore", str(file), "--root", str(root))
        assert done.returncode == 0, done.stderr
        assert (at / "state").read_text() == "learned"
        shown = run("podman", "volume", "inspect", "--format", '{{index .Labels "swiftbot.kept"}}', name).stdout
        assert shown.strip() == "yes"
        assert (root / str(config).lstrip("/")).read_text() == config.read_text()
    finally:
        run("podman", "volume", "rm", "--force", name, f"{name}-other")


@pytest.mark.parametrize(("passphrase", "said", "code"), [("", "no passphrase", 2), ("short", "characters", 2)])
def test_mistakes_name_the_remedy(tmp_path: Path, passphrase: str, said: str, code: int) -> None:
    """Without a passphrase on no terminal, or with a short one, nothing is written."""
    done = swiftbot("backup", str(tmp_path / "file"), passphrase=passphrase)
    assert (done.returncode, said in done.stderr, "hint:" in done.stderr) == (code, True, True)
    assert list(tmp_path.iterdir()) == []
