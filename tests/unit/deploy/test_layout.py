"""Releases side by side: killed at any write, an installation is the old release or the new one, whole."""

import fcntl
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from appliance import durable
from appliance.deploy import layout
from appliance.deploy.layout import Layout
from appliance.errors import ConfigError, NotFoundError

WRITES = {
    "os.rename", "os.remove", "os.symlink", "os.link", "os.mkdir", "os.rmdir", "os.chmod", "shutil.copyfile",
    "shutil.rmtree",
}  # fmt: skip
CURRENT = "opt/swiftbot/current"


def make_tree(folder: Path, said: str, *, units: tuple[str, ...] = ("gateway.service", "recorder.service")) -> Path:
    """A source tree with no more in it than a release takes, each file saying which it is of."""
    files = {
        "pyproject.toml": f'[project]\nversion = "{said}"\n',
        "systemd/gateway.toml": 'id = "@ID@"\n',
        "systemd/system-generators/swiftbot-generator": "#!/bin/sh\n",
        "systemd/sysusers.d/swiftbot.conf": f"# {said}\n",
        "systemd/tmpfiles.d/swiftbot.conf": f"# {said}\n",
        "docs/operations.md": said,
        "LICENSE": said,
    } | {f"systemd/{unit}": said for unit in units}
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


def install(root: Path, tree: Path) -> int:
    """The part of `make install` that writes files."""
    return layout.main(["--root", str(root), "--tree", str(tree), "--name", "gw-1"])


def killed_at(number: int, work: Callable[[], Any]) -> bool:
    """Do something in a process that is killed just before its so-manieth write; returns whether it came that far."""
    child = os.fork()
    if child == 0:
        left = number

        def count(event: str, arguments: tuple[Any, ...]) -> None:
            nonlocal left
            opened = event == "open" and isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR)
            if event in WRITES or opened:
                left -= 1
                if left == 0:
                    os.kill(os.getpid(), signal.SIGKILL)

        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        sys.addaudithook(count)
        try:
            work()
        finally:
            os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL


def check_whole(root: Path, allowed: set[str]) -> str:
    """Check that what is reachable is one release, whole; returns which ("" before the first)."""
    found = Layout(root)
    running = found.running()
    assert running.partition("+")[0] in allowed
    if running:  # links of the next release may be there already, and lead nowhere; those of this one lead to it
        for link, target in found.wanted(running):
            assert not link.exists() or link.resolve() == target.resolve()
    said = {link.read_text() for link in found.links() if link.suffix == ".service" and link.exists()}
    assert said <= {running.partition("+")[0]}, "units of two releases, or cut off"
    config = root / "etc/swiftbot/gateway.toml"
    assert not config.exists() or config.read_text() == 'id = "gw-1"\n'
    return running.partition("+")[0]


@pytest.mark.parametrize("upgrade", [False, True], ids=["first", "upgrade"])
def test_killed_at_each_write_it_is_the_old_or_the_new(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, upgrade: bool
) -> None:
    """At every write of an installation: what systemd sees is whole and of one release; the next run completes it."""
    monkeypatch.setattr(os, "fsync", lambda _: None)  # what a killed process has written is there all the same
    first, second = make_tree(tmp_path / "a", "1"), make_tree(tmp_path / "b", "2", units=("gateway.service", "x.mount"))
    allowed = {"1", "2"} if upgrade else {"", "2"}
    number, seen = 0, set[str]()
    while True:
        number += 1
        root = tmp_path / f"root-{number}"
        if upgrade:
            assert install(root, first) == 0
        killed = killed_at(number, lambda root=root: install(root, second))
        seen.add(check_whole(root, allowed))
        assert install(root, second) == 0
        assert check_whole(root, {"2"}) == "2"
        assert list(root.rglob(f"*{durable.NEW}")) == []
        names = {link.name for link in Layout(root).links()}
        assert names == {"gateway.service", "x.mount", "swiftbot-generator", "swiftbot.conf"}
        if not killed:
            break
    assert number > 25
    assert seen == allowed


def test_files_are_on_the_disk_before_their_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What gets a name was synced before, with its folder after: without that a power cut leaves files of 0 bytes."""
    synced: list[str] = []
    real = os.fsync

    def fsync(handle: int) -> None:
        synced.append(str(Path(f"/proc/self/fd/{handle}").readlink()))
        real(handle)

    monkeypatch.setattr(os, "fsync", fsync)
    path = tmp_path / "unit"
    durable.write(path, b"whole", mode=0o640)
    assert [Path(each).name.startswith(".unit.") for each in synced] == [True, False]
    assert synced[1] == str(tmp_path)
    assert (path.read_bytes(), path.stat().st_mode & 0o777) == (b"whole", 0o640)
    synced.clear()
    install(tmp_path / "root", make_tree(tmp_path / "a", "1"))
    release = Layout(tmp_path / "root").running()
    laid_out = [each for each in synced if f"/.{release}." in each]
    assert {Path(each).name for each in laid_out} >= {"gateway.service", "recorder.service", "release.json", "LICENSE"}


def test_a_full_disk_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    """A write that fails leaves the release that runs, says why, and ends with an error."""
    root = tmp_path / "root"
    install(root, make_tree(tmp_path / "a", "1"))

    def full(source: object, target: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(layout.shutil, "copyfile", full)
    assert install(root, make_tree(tmp_path / "b", "2")) == 1
    assert "No space left" in capsys.readouterr().err
    assert check_whole(root, {"1"}) == "1"


def test_rollback_is_the_same_switch(tmp_path: Path) -> None:
    """The release before is there, and what it did not have is gone after the switch back to it."""
    root = tmp_path / "root"
    install(root, make_tree(tmp_path / "a", "1"))
    install(root, make_tree(tmp_path / "b", "2", units=("gateway.service", "new.mount")))
    found = Layout(root)
    assert found.before().startswith("1+")
    found.switch(found.before())
    assert check_whole(root, {"1"}) == "1"
    assert {link.name for link in found.links() if link.parent.name == "system"} == {
        "gateway.service",
        "recorder.service",
    }
    assert found.before().startswith("2+")


def test_old_releases_go_and_those_in_use_stay(tmp_path: Path) -> None:
    """Three are kept: the one that runs, the one before, and one more; one that is installed again gets a number."""
    root = tmp_path / "root"
    for number in range(5):
        install(root, make_tree(tmp_path / "tree", str(number)))
    install(root, tmp_path / "tree")
    found = Layout(root)
    assert [each.version for each in found.installed()] == ["3", "4", "4"]
    assert found.running() == f"{found.before()}.2"


def test_what_is_no_whole_release_is_refused(tmp_path: Path) -> None:
    """Neither a folder that was cut off nor a path that leads elsewhere becomes the current release."""
    root = tmp_path / "root"
    install(root, make_tree(tmp_path / "a", "1"))
    found = Layout(root)
    (found.releases / "half").mkdir()
    with pytest.raises(NotFoundError, match="no whole release half"):
        found.switch("half")
    for name in ("../../etc", "", ".hidden", "a/b"):
        with pytest.raises(ConfigError, match="is no release"):
            found.switch(name)
    assert check_whole(root, {"1"}) == "1"


def test_files_of_older_installations_become_links(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Units that were files before there were releases are replaced, each in one step, after the release is there."""
    root = tmp_path / "root"
    monkeypatch.setattr(os, "fsync", lambda _: None)
    unit = root / "usr/local/lib/systemd/system/gateway.service"
    unit.parent.mkdir(parents=True)
    unit.write_text("old")
    tree = make_tree(tmp_path / "a", "1")
    number = 0
    while True:
        number += 1
        unit.unlink()
        unit.write_text("old")
        killed = killed_at(number, lambda: install(root, tree))
        assert unit.read_text() in ("old", "1")
        if not killed:
            break
    assert unit.is_symlink()


def test_releases_stay_until_the_services_were_started_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Installed again and again before a restart, the release that services run from is still there; then it goes."""
    root = tmp_path / "root"
    install(root, make_tree(tmp_path / "tree", "0"))
    for number in range(1, 5):
        options = ["--root", str(root), "--tree", str(make_tree(tmp_path / "tree", str(number)))]
        capsys.readouterr()
        assert layout.main([*options, "--stage"]) == 0
        assert layout.main([*options, "--staged", capsys.readouterr().out.strip()]) == 0
    assert [each.version for each in Layout(root).installed()] == ["0", "1", "2", "3", "4"]
    assert layout.main([*options, "--prune"]) == 0
    assert [each.version for each in Layout(root).installed()] == ["2", "3", "4"]


def test_an_installation_waits_for_no_upgrade(project_root: Path, tmp_path: Path) -> None:
    """`make install` is refused while an upgrade has the lock, and leaves alone what that is laying out."""
    staged = Layout(tmp_path).stage("1.0")

    def run() -> subprocess.CompletedProcess[str]:
        environment = os.environ | {"DESTDIR": str(tmp_path), "WITHOUT_ENVIRONMENT": "1"}
        script = project_root / "scripts/install.sh"
        return subprocess.run([script], env=environment, capture_output=True, text=True, check=False)

    with (tmp_path / "opt/swiftbot/.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        done = run()
    assert (done.returncode, staged.is_dir()) == (1, True), done.stderr
    assert "another upgrade, rollback or installation is running" in done.stderr
    assert run().returncode == 0
    assert not (tmp_path / "opt/swiftbot/.lock").exists()
