"""The scripts around the product: what they run keeps its exit status, its arguments and its signals."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest


def as_user(project_root: Path, *command: str) -> subprocess.CompletedProcess[str]:
    """Run a command by scripts/as_user.sh."""
    return subprocess.run(
        [str(project_root / "scripts" / "as_user.sh"), *command], capture_output=True, text=True, check=False
    )


def test_exit_status_is_the_commands_own(project_root: Path) -> None:
    """What the command ends with is what as_user.sh ends with."""
    assert as_user(project_root, "sh", "-c", "exit 7").returncode == 7


def test_arguments_arrive_as_given(project_root: Path) -> None:
    """Quotes, dollars, backquotes, spaces and newlines in an argument are only text."""
    hostile = 'say "it\'s $HOME `id`"; rm -rf x\n*'
    assert as_user(project_root, "printf", "%s", hostile).stdout == hostile


def test_relative_paths_are_those_of_the_caller(project_root: Path, tmp_path: Path) -> None:
    """A file is found from the folder that the command is called in; in the project from the same place of its tree."""
    (tmp_path / "log.mcap").write_text("here")
    script = str(project_root / "scripts" / "as_user.sh")
    for folder, name in ((tmp_path, "./log.mcap"), (project_root / "docs", "tui.md"), (project_root, "docs/tui.md")):
        done = subprocess.run([script, "cat", name], cwd=folder, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        assert done.stdout == (folder / name).read_text()


def test_environment_is_the_working_users(project_root: Path) -> None:
    """Home and runtime folder are the working user's, and nothing of a caller's Python or Podman is taken along."""
    done = subprocess.run(
        [str(project_root / "scripts" / "as_user.sh"), "env"],
        capture_output=True,
        text=True,
        check=True,
        env={"PATH": "/usr/bin:/bin", "HOME": "/tmp", "PYTHONPATH": "/x", "CONTAINER_HOST": "tcp://x"},
    )
    seen = dict(line.partition("=")[::2] for line in done.stdout.splitlines())
    assert seen["XDG_RUNTIME_DIR"].startswith("/run/user/")
    assert "PYTHONPATH" not in seen
    assert "CONTAINER_HOST" not in seen


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signals_reach_the_command(project_root: Path, number: signal.Signals) -> None:
    """SIGTERM and SIGINT are the command's own, with its own time to end: no process stands between."""
    script = (
        "import signal, sys, time\n"
        f"signal.signal({number}, lambda *_: (time.sleep(0.1), sys.exit(9)))\n"
        "print('up', flush=True)\n"
        "time.sleep(60)\n"
    )
    with subprocess.Popen(
        [str(project_root / "scripts" / "as_user.sh"), "python3", "-c", script], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "up\n"
        process.send_signal(number)
        assert process.wait(timeout=30) == 9


LATE_ONCE = """
from pathlib import Path

import pytest


@pytest.mark.fleet
def test_late() -> None:
    mark = Path(__file__).with_suffix(".ran")
    ran = mark.exists()
    mark.touch()
    assert ran, "late"


def test_well() -> None:
    pass
"""
FAILS = "import pytest\n\n\n@pytest.mark.fleet\ndef test() -> None:\n    assert 0\n"
SIDE_BY_SIDE = """
import pathlib
import pytest

def note(word):
    with pathlib.Path(__file__).with_name("ran").open("a") as ran:
        ran.write(word + "\\n")

@pytest.mark.alone
def test_alone(worker_id):
    assert worker_id == "master"
    note("alone")

def test_beside(worker_id):
    assert worker_id.startswith("gw")
    note("beside")
"""


def suite(project_root: Path, folder: Path, test: str) -> subprocess.CompletedProcess[str]:
    """Run scripts/whole_suite.sh on one test file."""
    (folder / "test_it.py").write_text(test)
    return subprocess.run(
        [str(project_root / "scripts" / "whole_suite.sh"), str(folder)],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHON": sys.executable},
    )


@pytest.mark.parametrize(("test", "status"), [(LATE_ONCE, 0), (FAILS, 1)])
def test_a_fleet_that_fails_is_run_once_more_by_itself(
    project_root: Path, tmp_path: Path, test: str, status: int
) -> None:
    """A test of a fleet that was late once is named and passes by itself; one that fails again fails the suite."""
    done = suite(project_root, tmp_path, test)
    assert done.returncode == status, done.stdout + done.stderr
    assert "are run once more" in done.stdout
    assert ("at the second run only" in done.stdout) == (status == 0)


def test_what_starts_no_fleet_has_no_second_run(project_root: Path, tmp_path: Path) -> None:
    """A race in a unit test fails the suite, though it would pass when run again."""
    done = suite(project_root, tmp_path, LATE_ONCE.replace("@pytest.mark.fleet\n", ""))
    assert done.returncode == 1, done.stdout + done.stderr
    assert "not run a second time" in done.stderr
    assert (tmp_path / "test_it.ran").exists()


def test_what_is_marked_alone_runs_beside_nothing(project_root: Path, tmp_path: Path) -> None:
    """Integration tests run in several processes, but for those marked `alone`, which run in one after all others."""
    folder = tmp_path / "integration"
    folder.mkdir()
    done = suite(project_root, folder, SIDE_BY_SIDE)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (folder / "ran").read_text().split() == ["beside", "alone"]


def test_an_unknown_argument_of_setup_is_refused(project_root: Path) -> None:
    """setup.sh changes nothing when it is not understood, and says how it is used."""
    done = subprocess.run(
        [str(project_root / "scripts" / "setup.sh"), "everything"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert "usage: scripts/setup.sh" in done.stderr


def test_hostile_instructions_reach_the_demo_whole(project_root: Path) -> None:
    """`make demo ASK=…` hands the text on as one argument, whatever stands in it."""
    hostile = 'fetch "it\'s" $HOME $(id) `id`; # x'
    done = subprocess.run(
        ["make", "--silent", "-o", "setup", "demo", f"ASK={hostile}", "RUN=printf '<%s>'"],
        cwd=project_root,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.endswith(f"<--ask={hostile}>")
