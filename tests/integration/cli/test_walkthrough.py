"""Quickstart and tutorials, typed in as they stand on the page: every command works and prints what the page shows."""

import contextlib
import os
import re
import secrets
import shutil
import signal
import socket
import subprocess
import tempfile
from pathlib import Path

import pytest
from msgspec import Struct

pytestmark = [pytest.mark.podman, pytest.mark.long]

PAGES = ("quickstart.md", "tutorials/first-robot.md", "tutorials/first-skill.md")
BLOCK = re.compile(r"^```console\n(.*?)^```", re.DOTALL | re.MULTILINE)
ESCAPES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")
MARK = "@@ command"


class Command(Struct):
    """A command of a page, and the lines that the page shows under it."""

    text: str
    shown: list[str]


def commands(page: str) -> list[Command]:
    """Return the commands of the blocks marked `console`, in order: `$` begins one, `>` goes on with it."""
    found: list[Command] = []
    for block in BLOCK.findall(page):
        for line in block.splitlines():
            if line.startswith("$ "):
                found.append(Command(line[2:], []))
            elif line.startswith("> "):
                found[-1].text += f"\n{line[2:]}"
            else:
                found[-1].shown.append(line)
    return found


def missing(shown: list[str], printed: str) -> str:
    """Return the first word that the page shows and the command did not print after the one before; figures differ."""
    words = iter([word.strip(",:;") for word in ESCAPES.sub("", printed).split()])
    for line in shown:
        for word in line.split():
            if not re.search(r"\d", word) and word.strip(",:;") not in words:
                return f"{word!r} of {line!r}"
    return ""


@pytest.mark.parametrize("page", PAGES)
@pytest.mark.timeout(500)
def test_a_page_does_what_it_says(page: str, project_root: Path, folder: Path) -> None:
    """A newcomer who types in the commands of the page sees each succeed and print what is shown."""
    typed = commands((project_root / "docs" / page).read_text())
    assert len(typed) > 4
    fleet = f"walk-{secrets.token_hex(3)}"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = str(probe.getsockname()[1])
    (folder / "docs").symlink_to(project_root / "docs")
    text = "".join(f"echo; echo '{MARK}'\n{each.text}\n" for each in typed)
    text = text.replace("14550", port).replace("minimal_robot.py local", f"minimal_robot.py {fleet}")
    # Short, since the sockets of containers are in it.
    where = Path(tempfile.gettempdir()) / fleet
    environment = os.environ | {"SWIFTBOT_FLEET": fleet, "SWIFTBOT_DIR": str(where), "COLUMNS": "120"}
    try:
        printed = _bash(f"set -eu\n{text}", folder, environment)
    finally:
        _bash("swiftbot down || true", folder, environment)
        shutil.rmtree(where, ignore_errors=True)
    parts = printed.replace(fleet, "local").split(MARK)[1:]
    for command, part in zip(typed, parts, strict=False):
        assert not (lacks := missing(command.shown, part)), f"{command.text}: no {lacks} in\n{part}"
    assert len(parts) == len(typed), f"ended in {typed[len(parts) - 1].text}:\n{parts[-1]}"


def _bash(text: str, folder: Path, environment: dict[str, str]) -> str:
    """Run a script in a session of its own, and end what it has left there; returns what it printed."""
    process = subprocess.Popen(
        ("bash", "-c", text),
        cwd=folder,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        start_new_session=True,
    )
    try:
        return process.communicate(timeout=400)[0]
    except subprocess.TimeoutExpired as expired:
        pytest.fail(f"it did not end: {(expired.output or b'')[-3000:]!r}")
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
