"""The systemd units: clean, hardened, and put where they belong by `make install`."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from appliance.config import load

UNITS = (
    "swiftbot-gateway.service",
    "swiftbot-recorder.service",
    "swiftbot-router.service",
    "swiftbot-foxglove.service",
)
MOST_EXPOSURE = 2.0
"""What `systemd-analyze security` may say; 10 is no hardening at all."""
INSTALLED = (
    "usr/local/lib/systemd/system/swiftbot-gateway.service",
    "usr/local/lib/systemd/system/swiftbot-recorder.service",
    "usr/local/lib/systemd/system/swiftbot-router.service",
    "usr/local/lib/systemd/system/swiftbot-foxglove.service",
    "usr/local/lib/systemd/system-generators/swiftbot-generator",
    "usr/local/lib/sysusers.d/swiftbot.conf",
    "usr/local/lib/tmpfiles.d/swiftbot.conf",
    "opt/swiftbot/current/docs/operations.md",
    "opt/swiftbot/current/LICENSE",
)


def run(*command: str, cwd: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a command and return what it said, both outputs together."""
    kept = {key: value for key, value in os.environ.items() if not key.startswith("MAKE")}
    return subprocess.run(
        command,
        cwd=cwd,
        env=kept | environment,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        check=False,
    )


@pytest.fixture
def analyze() -> tuple[str, ...]:
    """Return how systemd-analyze is called: with a /run of its own.

    It needs folders there that only root can make where systemd does not run, and would look at what is in ours.
    """
    found = shutil.which("systemd-analyze")
    if found is None:
        pytest.fail("systemd-analyze is not installed: run scripts/setup.sh dev")
    return (
        "unshare",
        "--map-root-user",
        "--mount",
        "sh",
        "-c",
        f'mount -t tmpfs tmpfs /run && exec {found} "$@"',
        "sh",
    )


@pytest.fixture
def installed(project_root: Path, tmp_path: Path) -> Path:
    """Lay the files out as `make install` does, without the program itself."""
    target = tmp_path / "root"
    done = run("make", "install", cwd=project_root, DESTDIR=str(target), WITHOUT_ENVIRONMENT="1")
    assert done.returncode == 0, done.stdout
    return target


@pytest.fixture
def unit_folder(installed: Path, tmp_path: Path) -> Path:
    """Return a folder with the units as systemd would see them: the generator's parts beside them, a program there."""
    folder = tmp_path / "units"
    folder.mkdir()
    program = tmp_path / "swiftbot"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    for unit in UNITS:
        text = (installed / "usr/local/lib/systemd/system" / unit).read_text()
        page = installed / "opt/swiftbot/current/docs/operations.md"
        text = text.replace("/opt/swiftbot/current/venv/bin/swiftbot", str(program))
        (folder / unit).write_text(text.replace("/opt/swiftbot/current/docs/operations.md", str(page)))
    users = tmp_path / "passwd"
    users.write_text("root:x:0:0::/root:/bin/sh\nswiftbot:x:990:990::/var/lib/swiftbot:/usr/sbin/nologin\n")
    generator = installed / "usr/local/lib/systemd/system-generators/swiftbot-generator"
    done = run(str(generator), str(folder), str(folder), str(folder), cwd=folder, PASSWD=str(users))
    assert done.returncode == 0, done.stdout
    return folder


def test_units_are_clean(analyze: tuple[str, ...], unit_folder: Path) -> None:
    """`systemd-analyze verify` has nothing to say about the units with what the generator adds to them."""
    paths = [str(unit_folder / unit) for unit in UNITS]
    done = run(*analyze, "verify", "--man=no", *paths, cwd=unit_folder, SYSTEMD_UNIT_PATH=f"{unit_folder}:")
    assert (done.returncode, done.stdout) == (0, "")


@pytest.mark.parametrize("unit", UNITS)
def test_units_are_hardened(analyze: tuple[str, ...], unit_folder: Path, unit: str) -> None:
    """Each unit's exposure, with what the generator adds, is at most 2.0 of 10."""
    done = run(
        *analyze,
        "security",
        "--offline=true",
        "--no-pager",
        str(unit_folder / unit),
        cwd=unit_folder,
        SYSTEMD_UNIT_PATH=f"{unit_folder}:",
    )
    found = re.search(r"Overall exposure level for \S+: ([\d.]+)", done.stdout)
    assert found is not None, done.stdout
    assert float(found[1]) <= MOST_EXPOSURE


def test_systemd_loads_and_enables_units_that_are_links(
    analyze: tuple[str, ...], installed: Path, tmp_path: Path
) -> None:
    """Systemd loads the units through their links into `current` without a word, and enables them by their names."""
    program = installed / "opt/swiftbot/current/venv/bin/swiftbot"
    program.parent.mkdir(parents=True)
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    folder = installed / "usr/local/lib/systemd/system"
    every = (*UNITS, "swiftbot-upgrade.service", "run-swiftbot.mount")
    assert all((folder / unit).is_symlink() for unit in every)
    mounted = f"mount --bind {installed}/opt /opt && mount --bind {installed}/usr/local/lib /usr/local/lib && "
    seen = [each.replace("exec ", mounted + "exec ") for each in analyze]
    units = [str(Path("/usr/local/lib/systemd/system") / unit) for unit in every]
    done = run(*seen, "verify", "--man=no", *units, cwd=tmp_path, SYSTEMD_UNIT_PATH="/usr/local/lib/systemd/system:")
    assert (done.returncode, done.stdout) == (0, "")
    enabled_units = (*UNITS[:2], "swiftbot-upgrade.service")
    done = run("systemctl", f"--root={installed}", "enable", *enabled_units, cwd=tmp_path)
    assert done.returncode == 0, done.stdout
    for unit in enabled_units:
        enabled = installed / "etc/systemd/system/multi-user.target.wants" / unit
        assert enabled.is_symlink()
        assert enabled.readlink().name == unit
        told = run("systemctl", f"--root={installed}", "is-enabled", unit, cwd=tmp_path)
        assert told.stdout == "enabled\n"


KILL = """
case $0 in */install.sh)
  set -T
  trap '[ "$BASH_SUBSHELL" -gt 0 ] || { [ $((--LEFT)) -gt 0 ] || kill -KILL $$; }' DEBUG
  ;;
esac
"""


def test_killed_before_any_command_install_leaves_old_or_new(
    installed: Path, project_root: Path, tmp_path: Path
) -> None:
    """`make install` is killed before each of its commands: the release before is whole and current, or the new one.

    What a kill within one of them leaves is tests/unit/deploy/test_layout.py.
    """
    hook = tmp_path / "hook"
    hook.write_text(KILL)
    links = [installed / name for name in INSTALLED[:7]]
    killed, left = 0, 0
    while True:
        left += 1
        done = run(
            "make",
            "install",
            cwd=project_root,
            DESTDIR=str(installed),
            WITHOUT_ENVIRONMENT="1",
            BASH_ENV=str(hook),
            LEFT=str(left),
        )
        for link in links:
            assert link.is_symlink()
            assert link.read_text() != ""
        assert (installed / "opt/swiftbot/current/release.json").read_text().endswith("}\n")
        if done.returncode == 0:
            break
        killed += 1
        assert "Killed" in done.stdout, done.stdout
    assert killed > 15


def test_the_recorder_starts_before_the_gateway(unit_folder: Path) -> None:
    """At boot it is ordered before the gateway, and at the end after it; it does not wait for one to be there."""
    text = (unit_folder / "swiftbot-recorder.service").read_text()
    assert "\nBefore=swiftbot-gateway.service\n" in text
    assert "Requires=" not in text
    assert "swiftbot-gateway" not in text.partition("Before=")[0].partition("[Unit]")[2]


def test_the_generator_binds_only_the_podman_folder(unit_folder: Path) -> None:
    """Of the user's runtime folder the gateway sees `podman` alone, under the id that the user has."""
    text = (unit_folder / "swiftbot-gateway.service.d/10-podman.conf").read_text()
    assert "BindPaths=/run/user/990/podman\n" in text
    assert "After=user@990.service\n" in text
    assert "Delegate=cpu cpuset io memory pids\n" in (unit_folder / "user@990.service.d/10-swiftbot.conf").read_text()


def test_the_generator_waits_for_the_user(installed: Path, tmp_path: Path) -> None:
    """Before the user exists the generator writes nothing and does not fail: it would hold up the boot."""
    users = tmp_path / "passwd"
    users.write_text("root:x:0:0::/root:/bin/sh\n")
    out = tmp_path / "out"
    out.mkdir()
    generator = installed / "usr/local/lib/systemd/system-generators/swiftbot-generator"
    done = run(str(generator), str(out), str(out), str(out), cwd=out, PASSWD=str(users))
    assert (done.returncode, list(out.iterdir())) == (0, [])


def test_install_puts_files_and_uninstall_removes_them(installed: Path, project_root: Path) -> None:
    """`make install` lays everything out; `make uninstall` leaves configuration and data, PURGE=1 nothing."""
    for name in INSTALLED:
        assert (installed / name).is_file(), name
    assert os.access(installed / "usr/local/lib/systemd/system-generators/swiftbot-generator", os.X_OK)
    assert (installed / "var/lib/swiftbot/.config/systemd/user/sockets.target.wants/podman.socket").is_symlink()

    done = run("make", "uninstall", cwd=project_root, DESTDIR=str(installed))
    assert done.returncode == 0, done.stdout
    left = {str(path.relative_to(installed)) for path in installed.rglob("*") if not path.is_dir()}
    assert left == {
        "etc/swiftbot/gateway.toml",
        "var/lib/swiftbot/.config/systemd/user/sockets.target.wants/podman.socket",
    }
    done = run("make", "uninstall", cwd=project_root, DESTDIR=str(installed), PURGE="1")
    assert done.returncode == 0, done.stdout
    assert [path for path in installed.rglob("*") if not path.is_dir()] == []


def test_a_configuration_is_never_overwritten(installed: Path, project_root: Path) -> None:
    """A second install, as in an upgrade, keeps what the operator wrote."""
    config = installed / "etc/swiftbot/gateway.toml"
    config.write_text('id = "mine"\n')
    done = run("make", "install", cwd=project_root, DESTDIR=str(installed), WITHOUT_ENVIRONMENT="1")
    assert done.returncode == 0, done.stdout
    assert config.read_text() == 'id = "mine"\n'


def test_the_installed_configuration_is_valid(installed: Path) -> None:
    """What install writes is a configuration that the gateway accepts, with the folders that its unit may write."""
    config = load(installed / "etc/swiftbot/gateway.toml")
    assert config.id
    assert (config.data_dir, config.run_dir) == ("/var/lib/swiftbot/data", "/run/swiftbot")
    assert config.record.directory == "/var/lib/swiftbot/log"
