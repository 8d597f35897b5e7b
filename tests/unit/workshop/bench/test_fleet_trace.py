"""Arrival traces out of fleets' logs."""

from pathlib import Path

import pytest

from appliance.errors import ConfigError
from appliance.pool.settings import PoolConfig
from workshop.bench.policy import read_any
from workshop.simulators.pool import simulate

LOGS = Path(__file__).parents[3] / "replay" / "logs"


def test_a_log_becomes_a_trace_that_can_be_played() -> None:
    """Every run of the demonstration's log is an arrival with its image, and the simulator accounts for each."""
    trace = read_any(LOGS / "demo.mcap")
    assert trace.arrivals[0].at_s == 0.0
    assert {each.image for each in trace.arrivals} <= {"base", "vision", "speech"}
    outcome = simulate(trace, PoolConfig(), tick_s=1.0)
    assert outcome.runs == len(trace.arrivals) > 0
    assert outcome.local + outcome.remote + outcome.cold + outcome.lost == outcome.runs


def test_a_file_without_arrivals_is_refused(tmp_path: Path) -> None:
    """An empty JSONL file is reported as such."""
    path = tmp_path / "empty.jsonl"
    path.write_text("")
    with pytest.raises(ConfigError, match="no arrivals"):
        read_any(path)
