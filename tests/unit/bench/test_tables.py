"""Results of benchmarks as Markdown."""

from pathlib import Path

import pytest

from appliance import cli
from appliance.bench.tables import markdown

SUMMARY = {"count": 3, "p50": 1.234, "p90": 20.04, "p99": None, "max": 1234.56}


def test_distributions_stand_in_one_table_and_the_rest_below() -> None:
    """Nested ones are named by their path, curves are left out, and what is not known is a dash."""
    text = markdown({"unit": "ms", "local": SUMMARY, "ray": {"start": SUMMARY, "version": "2"}, "cdf": {"x": [1]}})
    assert text == (
        "| way | count | p50 ms | p90 ms | p99 ms | max ms |\n"
        "| --- | --- | --- | --- | --- | --- |\n"
        "| `local` | 3 | 1.23 | 20.0 | – | 1,234.6 |\n"
        "| `ray.start` | 3 | 1.23 | 20.0 | – | 1,234.6 |\n"
        "\n- `unit`: ms\n- `ray.version`: 2\n"
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
    file.write_text("[1")
    for path in (file, tmp_path / "none.json"):
        with pytest.raises(SystemExit) as ended:
            cli.main(["bench", "table", str(path)])
        assert ended.value.code not in (0, 1, None)
