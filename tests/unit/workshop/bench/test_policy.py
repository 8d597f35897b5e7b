"""The benchmark of pool policies: its comparisons are right, and a small one runs to the end."""

from pathlib import Path

import pytest

from appliance import cli
from appliance.errors import ConfigError
from workshop.bench.policy import (
    BY_NUMBER,
    DEFAULT,
    FLEET,
    FLEET_TRACES,
    KEEP_ALIVE,
    Point,
    cold_at,
    compare,
    in_a_fleet,
    on_frontier,
    on_traces,
    over_gateways,
    run,
)
from workshop.simulators.pool.traces import plain, write_trace


def point(budget_mb: int, cold_percent: float, wasted_gb: float) -> Point:
    """A point of a curve."""
    return Point(
        budget_mb=budget_mb,
        cold_percent=cold_percent,
        wasted_gb=wasted_gb,
        cold_ms_per_run=0.0,
        p99_ms=0.0,
        evictions=0,
        prewarmed=0,
        unused=0,
    )


def test_a_curve_between_and_beyond_its_points() -> None:
    """Linear between points; never better than its best nor cheaper than its cheapest."""
    curve = [point(1, 40.0, 1.0), point(2, 20.0, 2.0)]
    assert cold_at(curve, 1.5) == 30.0
    assert cold_at(curve, 0.1) == 40.0
    assert cold_at(curve, 9.0) == 20.0


def test_how_the_default_stands() -> None:
    """Fewer cold starts at equal budget and at equal waste, and whether another policy is better in both."""
    curves = {
        DEFAULT: [point(1, 20.0, 1.0), point(2, 10.0, 2.0)],
        KEEP_ALIVE: [point(1, 40.0, 1.0), point(2, 20.0, 3.0)],
        "other": [point(1, 25.0, 1.0), point(2, 8.0, 1.9)],
    }
    stands = compare(curves)
    assert stands["1"] == {"fewer_at_budget": 50.0, "fewer_at_waste": 50.0, "on_frontier": True}
    assert stands["2"] == {"fewer_at_budget": 50.0, "fewer_at_waste": 66.7, "on_frontier": False}


def test_other_gateways_spare_cold_starts() -> None:
    """With the same policies and load, a federated pool starts fewer containers cold than a local one."""
    stands = over_gateways((3,), seed=1, budget_mb=1024, duration_s=1800.0)["3"]
    assert stands["cold"]["cold_percent"] == 100.0
    assert stands["federated"]["cold_percent"] < 0.7 * stands["local"]["cold_percent"]


def test_the_command_on_a_recorded_trace(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Whatever its file is called, it becomes a table of the policies with each budget."""
    file = tmp_path / "[bold] name.jsonl"
    write_trace(plain("poisson", rate=0.1, duration_s=600.0, images=2), file)
    with pytest.raises(SystemExit) as ended:
        cli.main(["bench", "policy", "--trace", str(file), "--budgets", "1024", "--gateways", "0"])
    told = capsys.readouterr()
    assert ended.value.code == 0
    assert "[bold] name: clairvoyant" in told.err
    assert "| cold starts in percent / GB held idle | 1 GB |" in told.out
    assert "| `default` | " in told.out


def test_an_unknown_trace_is_refused() -> None:
    """The message names those that are known."""
    with pytest.raises(ConfigError, match="nonsense"):
        run(traces=("nonsense",))


def test_the_shipped_default_beside_keep_alive_in_a_fleet(monkeypatch: pytest.MonkeyPatch) -> None:
    """With equal memory on every gateway the federated default has fewer cold starts, and holds less idle."""
    trace = plain("bursts", seed=1, rate=0.5 * FLEET, duration_s=900.0, gateways=FLEET)
    monkeypatch.setitem(FLEET_TRACES, "bursts", lambda _: trace)
    line = in_a_fleet(("bursts",), (1024,), seed=1)["bursts"]["1024"]
    assert line["fewer_at_budget"] >= 30
    assert line[DEFAULT]["wasted_gb"] <= line["keep_alive"]["wasted_gb"]
    assert 0 < line["bound"] <= line["keep_alive"]["cold_percent"]
    assert {"lru", "greedy-dual", "histogram", "learned"} < set(line)
    assert isinstance(line["on_frontier"], bool)


def test_what_counts_as_the_frontier() -> None:
    """Better in one at about the same of the other, with no more memory for containers; less than 0.1 % is chance."""
    mine = point(2048, 10.0, 1.0)
    assert on_frontier(mine, [])
    assert not on_frontier(mine, [point(2048, 9.0, 1.01)])
    assert not on_frontier(mine, [point(1024, 10.1, 0.9)])
    assert on_frontier(mine, [point(4096, 9.0, 1.01)]), "it may hold more"
    assert on_frontier(mine, [point(2048, 9.0, 1.1), point(2048, 11.0, 0.5), point(2048, 9.8, 0.99)])
    assert on_frontier(point(2048, 0.2, 1.0), [point(2048, 0.12, 1.0)])


@pytest.mark.thorough
def test_points_are_means_over_several_draws() -> None:
    """Two draws of a trace: runs add up, points are means; each draw's verdict, and what is possible, are there too."""
    drawn = [plain("poisson", seed=seed, rate=0.5, duration_s=1200.0) for seed in (1, 2)]
    one, other, both = (on_traces(each, (1024,)) for each in (drawn[:1], drawn[1:], drawn))
    assert both["runs"] == one["runs"] + other["runs"]
    cold = [each["curves"][DEFAULT][0]["cold_percent"] for each in (one, other, both)]
    assert cold[2] == pytest.approx((cold[0] + cold[1]) / 2, abs=0.001)
    possible = both["possible"]["1024"]
    assert possible["bound"] >= possible["foresight"] > 0
    assert possible["bound"] >= possible[BY_NUMBER] > 0
    assert both["default_each_draw"] == one["default_each_draw"] + other["default_each_draw"]


def test_no_draws_are_refused() -> None:
    """None at all is an error of the one who asks."""
    with pytest.raises(ConfigError, match="0 draws"):
        run(traces=("poisson",), draws=0)
