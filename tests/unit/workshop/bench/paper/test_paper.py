"""The paper's evaluation: which cells there are, what figures are drawn from, and the page that holds them."""

import importlib.util
from pathlib import Path
from typing import Any

import msgspec
import pytest

from appliance.errors import PrerequisiteError
from workshop.bench.learning.cells import Cell
from workshop.bench.learning.store import Kept
from workshop.bench.learning.store import write as keep
from workshop.bench.paper import draw, report, series
from workshop.bench.paper.published import CLIENTS, KILLED_AT
from workshop.bench.paper.steps import EXTENTS, cells

RESULTS: dict[str, dict[str, Any]] = {
    "table": {"all": {"decomposition": 97.1, "parallel_recall": 96.0}, "latency_ms": {"p50": 1.5}},
    "startup": {
        "cdf": {way: [[value, 0.5], [2 * value, 0.9], [None, 1.0]] for way, value in
                (("cold_ordered", 140.0), ("ordered", 1.0), ("federated", 4.0))},
        "cold_over_federated": 35.0,
    },
    "rate": {"ladders": [
        {"mode": mode, "cells": {"2": {"start": {"p99": 8.0}}, "5": {"start": {"p99": None}}}}
        for mode in ("cold", "local", "federated")
    ]},
    "virtual": {"curve": [{"round": 1, "accuracy": 0.4, "loss": 2.0}, {"round": 2, "accuracy": 0.6, "loss": 1.0}]},
    "clients": {"killed": {"2": 2}, "loss": [2.0, 1.0], "calm_loss": [2.0, 1.1], "most_apart": 0.1, "longest": 1.2},
}  # fmt: skip


def kept(cell: Cell) -> Kept:
    """A cell's file with results as the benchmarks write them."""
    result = RESULTS.get(cell.kind)
    if result is None:  # decided: with offloading a round takes a third of the time
        result = {"took_s": [9.0, *(2.0 if cell.settings["mode"] == "offload" else 6.0 for _ in range(9))]}
    return Kept(
        cell=cell.name, kind=cell.kind, settings=cell.settings, result=result, finished="", took_s=1.0, load=(0, 0),
        cores=2,
    )  # fmt: skip


def test_the_cells_are_those_of_the_papers_figures() -> None:
    """Both workloads with 8 to 32 clients, failing clients in its rounds, startup, rates, Table I; names once."""
    for size in EXTENTS:
        names = [cell.name for cell in cells(size)]
        assert len(set(names)) == len(names)
    found = cells("short")
    for workload in ("clips", "words"):
        mine = [cell for cell in found if cell.settings.get("workload") == workload]
        assert {cell.settings["clients"] for cell in mine if cell.kind == "virtual"} == set(CLIENTS)
        (failing,) = (cell for cell in mine if cell.kind == "clients")
        assert failing.settings["killed_at"] == list(KILLED_AT)
    assert {"table", "startup", "rate"} <= {cell.kind for cell in found}


def test_figures_have_the_papers_values_beside_what_was_measured() -> None:
    """Each figure once; a time that no run reached is left out; the ratio of rounds is that of the medians."""
    found = {figure.name: figure for figure in series.figures([kept(cell) for cell in cells("short")])}
    assert set(found) == {
        "startup", "rate", *(f"{name}-{workload}" for workload in ("clips", "words")
                             for name in ("accuracy", "loss", "rounds", "failing"))
    }  # fmt: skip
    published = {line.label: (line.x, line.y) for line in found["startup"].lines if line.published}
    assert published["federated, the paper's median"] == ((120.0,), (0.5,))
    assert [line.x for line in found["startup"].lines if line.label == "federated"] == [(4.0, 8.0)]
    assert [line.x for line in found["rate"].lines if line.label == "federated"] == [(2.0,)]
    assert "16 clients 0.33" in found["rounds-clips"].note
    assert "the paper with 16 clients: 0.40" in found["rounds-clips"].note
    assert {violin.x for violin in found["rounds-words"].violins} == set(map(float, CLIENTS))
    assert found["failing-words"].at == (2.0,)
    assert series.figures([]) == []


def test_table_one_has_the_tiers_and_the_published_rows() -> None:
    """What was not measured has no row; the paper's are always there."""
    rows = series.table([kept(cell) for cell in cells("smoke")])
    assert rows[0] == ("SwiftBot, rules", "97.1", "96.0", "1.5")
    assert ("GPT-4o (the paper)", "94.3", "91.5", "1,280") in rows
    assert len(series.table([])) == 4


def test_the_page_names_what_is_not_measured() -> None:
    """And has each figure with its data."""
    found = series.figures([kept(cell) for cell in cells("smoke")])
    text = report.page("smoke", found, series.table([]), ["rate"])
    assert "## Not measured\n\nrate" in text
    for figure in found:
        assert f"(figures/{figure.name}.svg)" in text
        assert f"(figures/{figure.name}.json)" in text


@pytest.mark.anyio
async def test_a_report_is_drawn_of_what_is_there_or_says_what_it_needs(tmp_path: Path) -> None:
    """With the extra `report` each figure is an SVG, the same again; without it the command names the extra at once."""
    for cell in cells("smoke")[:-1]:
        keep(tmp_path / "cells", cell, kept(cell).result, took_s=1.0, load=(0, 0))

    async def drawn() -> dict[str, Any]:
        return await report.run(tmp_path, "smoke", only_read=True, progress=print)

    if importlib.util.find_spec("matplotlib") is None:
        with pytest.raises(PrerequisiteError, match="matplotlib") as refused:
            await drawn()
        assert refused.value.remedy == draw.REMEDY
        assert not (tmp_path / "report.md").exists()
        return
    result = await drawn()
    assert result["missing"] == [cells("smoke")[-1].name]
    first = {name: (tmp_path / "figures" / f"{name}.svg").read_bytes() for name in result["figures"]}
    assert all(b"<svg" in data for data in first.values())
    await drawn()
    for name, data in first.items():
        assert (tmp_path / "figures" / f"{name}.svg").read_bytes() == data
        figure = msgspec.json.decode((tmp_path / "figures" / f"{name}.json").read_bytes(), type=series.Figure)
        assert figure.name == name
