"""Results of benchmarks as Markdown."""

import math
from pathlib import Path

import pytest

from appliance import cli
from workshop.bench.figures import CDF_SHARES, cdf
from workshop.bench.tables import SHARES, markdown

SUMMARY = {"count": 3, "p50": 1.234, "p90": 20.04, "p99": None, "max": 1234.56}


def test_distributions_stand_in_one_table_and_the_rest_below() -> None:
    """Nested ones are named by their path, and what is not known is a dash."""
    text = markdown({"unit": "ms", "local": SUMMARY, "ray": {"start": SUMMARY, "version": "2"}})
    assert text == (
        "| way | count | p50 ms | p90 ms | p99 ms | max ms |\n"
        "| --- | --- | --- | --- | --- | --- |\n"
        "| `local` | 3 | 1.23 | 20.0 | – | 1,234.6 |\n"
        "| `ray.start` | 3 | 1.23 | 20.0 | – | 1,234.6 |\n"
        "\n- `unit`: ms\n- `ray.version`: 2\n"
    )


def test_curves_have_a_table_of_their_own() -> None:
    """A row for each, also for those of Ray's side, in the tail as well; unserved runs are a dash, no curve no row."""
    curve = cdf([float(each) for each in range(1, 1001)])
    text = markdown(
        {"cdf": {"local": curve, "lost": cdf([1.0, math.inf]), "none": []}, "ray": {"cdf": {"start": curve}}}
    )
    assert text == (
        "| so many were within, ms | 5 % | 10 % | 25 % | 50 % | 75 % | 90 % | 95 % | 99 % | 99.9 % | 100 % |\n"
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |\n"
        "| `local` | 50.0 | 100.0 | 250.0 | 500.0 | 750.0 | 900.0 | 950.0 | 990.0 | 999.0 | 1,000.0 |\n"
        "| `lost` | 1 | 1 | 1 | 1 | – | – | – | – | – | – |\n"
        "| `ray.start` | 50.0 | 100.0 | 250.0 | 500.0 | 750.0 | 900.0 | 950.0 | 990.0 | 999.0 | 1,000.0 |\n"
    )
    assert set(SHARES) <= set(CDF_SHARES)


def test_policies_stand_in_a_table_for_each_trace() -> None:
    """Each policy with each budget, then the default beside keep-alive, then what could be had at all."""
    point = {"budget_mb": 1024, "cold_percent": 12.345, "wasted_gb": 0.5}
    stands = {"fewer_at_budget": 31.0, "fewer_at_waste": None, "on_frontier": True}
    trace = {"runs": 1000, "curves": {"lru": [point, point]}, "default": {"1024": stands, "2560": stands}}
    text = markdown({"traces": {"timer": trace | {"possible": {"1024": {"bound": 44.2}, "2560": {"bound": 5.0}}}}})
    assert text == (
        "`timer`, 1,000 runs:\n\n"
        "| cold starts in percent / GB held idle | 1 GB | 2.5 GB |\n"
        "| --- | --- | --- |\n"
        "| `lru` | 12.35 / 0.50 | 12.35 / 0.50 |\n"
        "| percent fewer than keep-alive: default | 31.0 | 31.0 |\n"
        "| the same at equal idle memory | – | – |\n"
        "| default on the frontier | yes | yes |\n"
        "| percent fewer than keep-alive: bound | 44.2 | 5 |\n"
    )


def test_a_ladder_says_where_it_broke() -> None:
    """One row a rate, and below it why the last was too much; one that held says so."""
    cell = {"start": SUMMARY, "phases": {"local warm": 3}, "unserved": {"refused": 1}, "cpu": 0.5}
    ladder = {"mode": "local", "spread": "even", "service_ms": 0.0, "cells": {"5": cell}}
    text = markdown({"ladders": [ladder | {"breaking": {"holds": None, "breaks": 5.0, "why": ["queue", "CPU"]}}]})
    assert text.startswith("local, even arrivals, 0 ms of work:\n\n| runs/s |")
    assert "| 5 | 3 | 1.23 | 20.0 | – | 1 | 3 local warm | 50% |" in text
    assert text.endswith("Breaks at 5/s: queue; CPU.\n")
    text = markdown({"ladders": [ladder | {"breaking": {"holds": 5.0, "breaks": None, "why": []}}]})
    assert text.endswith("Carried to 5/s, the highest rate offered.\n")


def test_heaps_are_named_by_size_and_kind() -> None:
    """A row for each kind of start, and what is no distribution below."""
    text = markdown({"heaps": [{"kind": "objects", "size_mb": 200, "fork": SUMMARY, "rss_mb": 210.5}]})
    assert "| `200 MB of objects.fork` | 3 | 1.23 | 20.0 | – | 1,234.6 |" in text
    assert text.endswith("- `200 MB of objects.rss_mb`: 210.5\n")


def test_a_census_shows_before_and_after() -> None:
    """Counts side by side; a pipe within a cell does not end it."""
    text = markdown({"census": {"before": {"a|b": 1}, "after": {"a|b": 2}}})
    assert text == "| held | before | after |\n| --- | --- | --- |\n| a\\|b | 1 | 2 |\n"


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A file of JSON is rendered; one that is none, or not there, is an error with its reason."""
    file = tmp_path / "result.json"
    file.write_text('{"local": {"count": 1, "p50": 2.0}}')
    with pytest.raises(SystemExit) as ended:
        cli.main(["bench", "table", str(file)])
    assert ended.value.code == 0
    assert "| `local` | 1 | 2 |" in capsys.readouterr().out
    for number, text in enumerate(("[1", '{"ladders": [1]}', '{"cdf": {"x": [1]}}', '{"traces": {"x": {}}}')):
        (tmp_path / f"{number}.json").write_text(text)
    for path in (*(tmp_path / f"{number}.json" for number in range(4)), tmp_path / "none.json"):
        with pytest.raises(SystemExit) as ended:
            cli.main(["bench", "table", str(path)])
        assert ended.value.code not in (0, 1, None)
