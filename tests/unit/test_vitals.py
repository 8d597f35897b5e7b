"""What the machine uses is read rarely."""

import pytest

from appliance import process


def test_a_reading_counts_for_half_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    """However often it is asked for, /proc is read twice a second at most."""
    readings: list[float | None] = []

    def cpu_percent(interval: float | None) -> float:
        readings.append(interval)
        return float(len(readings))

    monkeypatch.setattr(process.psutil, "cpu_percent", cpu_percent)
    now = 0.0
    it = process.Vitals(clock=lambda: now)
    first = it.read()
    assert first.memory_mb > 1
    for number in range(100):
        now = number / 20
        assert now - it.read().at < process.KEPT_S
    assert len(readings) == 10
    assert it.read().cpu_percent == 10.0
