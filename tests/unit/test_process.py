"""The collector of cycles while the terminal UI runs, what the machine uses is read rarely, systemd is notified."""

import gc
import secrets
import socket
from pathlib import Path

import pytest

from appliance import process
from appliance.process import KEPT_S, THRESHOLDS, Vitals, gentle_collector


def test_what_is_there_is_left_alone_and_cycles_still_go() -> None:
    """The program's own objects are left out of collections, cycles that come later are found, and all is as before."""

    class Ring:
        """Refers to itself."""

        gone = 0

        def __init__(self) -> None:
            self.own = self

        def __del__(self) -> None:
            Ring.gone += 1

    before = gc.get_threshold()
    with gentle_collector():
        assert gc.get_freeze_count() > 1000
        assert gc.get_threshold() == THRESHOLDS
        Ring()
        gc.collect()
        assert Ring.gone == 1
    assert gc.get_threshold() == before
    assert gc.get_freeze_count() == 0


def test_a_reading_counts_for_half_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    """However often it is asked for, /proc is read twice a second at most."""
    readings: list[float | None] = []

    def cpu_percent(interval: float | None) -> float:
        readings.append(interval)
        return float(len(readings))

    monkeypatch.setattr(process.psutil, "cpu_percent", cpu_percent)
    now = 0.0
    it = Vitals(clock=lambda: now)
    first = it.read()
    assert first.memory_mb > 1
    for number in range(100):
        now = number / 20
        assert now - it.read().at < KEPT_S
    assert len(readings) == 10
    assert it.read().cpu_percent == 10.0


@pytest.mark.parametrize("abstract", [False, True])
def test_systemd_is_notified(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, abstract: bool) -> None:
    """Ready, alive and stopping arrive at the socket that systemd names, a file's or one that begins with @."""
    name = f"@swiftbot-{secrets.token_hex(8)}" if abstract else str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as heard:
        heard.bind("\0" + name[1:] if abstract else name)
        heard.settimeout(5)
        monkeypatch.setenv("NOTIFY_SOCKET", name)
        process.ready()
        process.alive()
        process.stopping()
        assert [heard.recv(100) for _ in range(3)] == [b"READY=1", b"WATCHDOG=1", b"STOPPING=1"]


def test_without_systemd_nothing_happens(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No socket is named, or nobody listens there: no error, since the work goes on."""
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    process.ready()
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "nobody"))
    process.ready()
