"""Logging: what cannot be written is counted, and fails nothing."""

import errno
import io
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import structlog

from appliance import logs


@pytest.fixture(autouse=True)
def as_before() -> Iterator[None]:
    """Have logging as it was."""
    before = structlog.get_config()
    yield
    structlog.configure(**before)


def test_a_line_that_cannot_be_written_fails_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a full disk lines are lost, the work goes on, and the next line that can be written tells how many."""
    full = True
    written: list[str] = []

    class Disk(io.StringIO):
        def write(self, text: str) -> int:
            if full:
                raise OSError(errno.ENOSPC, "No space left on device")
            written.append(text)
            return len(text)

    monkeypatch.setattr(sys, "stderr", Disk())
    logs.configure(style="json")
    log = structlog.get_logger("test")
    for _ in range(3):
        log.warning("something happened")
    full = False
    log.warning("there is room")
    assert written[0] == "3 log lines could not be written\n"
    assert "there is room" in written[1]


def test_a_process_whose_log_is_full_does_its_work() -> None:
    """The same with a real device that is full."""
    script = (
        "import structlog; from appliance import logs; logs.configure();"
        " structlog.get_logger().error('lost', exc_info=ValueError('x')); print('done')"
    )
    with Path("/dev/full").open("w") as full:
        command = [sys.executable, "-c", script]
        found = subprocess.run(command, stdout=subprocess.PIPE, stderr=full, check=False, timeout=60)
    assert found.stdout == b"done\n"
