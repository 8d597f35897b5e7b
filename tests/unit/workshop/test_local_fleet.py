"""A fleet on this machine: what must not end a stranger's process, and errors that say what to do."""

import os
import signal
from pathlib import Path

import psutil
import pytest

from appliance.connection import Process
from appliance.errors import ConfigError
from workshop import local_fleet
from workshop.local_fleet import Order

pytestmark = pytest.mark.anyio


async def test_a_place_that_cannot_be_written_is_an_error_with_a_remedy(tmp_path: Path) -> None:
    """A file where the directory should be: no traceback, and nothing is started."""
    (tmp_path / "fleet").write_text("a file")
    with pytest.raises(ConfigError, match="cannot be") as caught:
        await local_fleet.up(Order(directory=tmp_path / "fleet"), progress=lambda _: None)
    assert caught.value.remedy


def test_a_process_that_ends_just_now_needs_no_signal(monkeypatch: pytest.MonkeyPatch) -> None:
    """Between looking and signalling it may be gone; `down` goes on."""

    def gone(pid: int, number: int) -> None:
        raise ProcessLookupError(pid)

    monkeypatch.setattr(os, "kill", gone)
    mine = psutil.Process()
    local_fleet._signal(Process(name="me", pid=mine.pid, started=mine.create_time(), log=""), signal.SIGTERM)


def test_another_process_of_the_same_number_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """A number that was given to somebody else meanwhile is not signalled."""
    sent: list[int] = []
    monkeypatch.setattr(os, "kill", lambda pid, _: sent.append(pid))
    mine = psutil.Process()
    local_fleet._signal(Process(name="me", pid=mine.pid, started=mine.create_time() - 60, log=""), signal.SIGTERM)
    assert not sent
