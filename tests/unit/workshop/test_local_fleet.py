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


@pytest.mark.parametrize(
    ("drones", "processes"), [(0, []), (8, [f"drone_{n + 1}" for n in range(8)]), (64, ["drones"])]
)
def test_many_vehicles_are_simulated_in_one_process(
    drones: int, processes: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A few have a process each, which a test may kill; each has a link of its own and the next system id."""
    started: list[tuple[str, tuple[str, ...]]] = []

    def spawn(name: str, command: tuple[str, ...], log_file: Path) -> Process:
        started.append((name, command))
        return Process(name=name, pid=1, started=0.0, log=str(log_file))

    monkeypatch.setattr(local_fleet, "spawn", spawn)
    order = Order(directory=tmp_path, gateways=2, mavlink=drones, zenoh=0)
    state = local_fleet._Starting(order).start_all(lambda _: None)
    assert state.robots == tuple(f"drone_{number + 1}" for number in range(drones))
    simulated = [(name, command) for name, command in started if "mavlink" in command]
    assert [name for name, _ in simulated] == processes
    to = [word for _, command in simulated for word in command if word.startswith("udp://")]
    assert len(set(to)) == drones
    for number, (_, command) in enumerate(simulated):
        assert command[command.index("--system") + 1] == str(number + 1)


async def test_more_vehicles_than_mavlink_has_systems_are_refused(tmp_path: Path) -> None:
    """Before anything is started."""
    with pytest.raises(ConfigError, match="300 MAVLink vehicles"):
        await local_fleet.up(Order(directory=tmp_path, mavlink=300), progress=lambda _: None)
