"""The collector of cycles while the terminal UI runs, and what the machine uses is read rarely."""

import gc

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
