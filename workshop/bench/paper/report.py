"""Measures what is missing, draws the figures, and writes the report."""

import os
import platform
import time
from pathlib import Path
from typing import Any

import anyio.to_thread
import msgspec
import psutil

from workshop.bench.learning import store
from workshop.bench.learning.run import Progress
from workshop.bench.paper import draw, series
from workshop.bench.paper.series import Figure
from workshop.bench.paper.steps import PaperBench, Size, cells
from workshop.bench.tables import table

REPORT = "report.md"
_ABOUT = """Measured by `swiftbot bench paper` on {machine}, {cores} cores, {memory:.0f} GiB, {date}; setting `{size}`.

The paper's testbed has 42 cores and a GPU, real data sets and larger models: compare ratios, not times. Data are
stand-ins here; times of rounds are those of emulated devices in virtual time, 1/8 of the clients 5 times and 1/8 3
times slower than the others. What the paper gives is grey in figures. The machine's load while a cell was measured is
in its file."""


async def run(
    out: Path, size: Size, *, again: bool = False, only_read: bool = False, progress: Progress
) -> dict[str, Any]:
    """Measure the cells of a size that are not there, and write `report.md` with its figures.

    Args:
        out: folder of the report, its figures and cells; a run that was cut short goes on there.
        size: how large the measurements are.
        again: measure all cells again.
        only_read: measure nothing, draw what is there.
        progress: told what is being done.

    Returns:
        `report`: its path; `figures`: names; `missing`: cells that are not measured; `table`: rows of Table I.

    Raises:
        PrerequisiteError: matplotlib, Podman or an image is not there.
        PoolError, UnreachableError, DeadlineError: a cell cannot be measured.
        OSError: the folder cannot be written.
    """
    draw.check()
    wanted = cells(size)
    if not only_read:
        await PaperBench(out, progress).measure(wanted, again=again)
    kept = {cell.name: store.read(out / "cells", cell) for cell in wanted}
    there = [each for each in kept.values() if each is not None]
    found, rows, lacking = series.figures(there), series.table(there), series.missing(kept)
    await anyio.to_thread.run_sync(_write, out, size, found, rows, lacking)
    return {
        "report": str(out / REPORT),
        "figures": [figure.name for figure in found],
        "missing": lacking,
        "table": [list(row) for row in rows],
    }


def _write(out: Path, size: Size, found: list[Figure], rows: list[series.Row], lacking: list[str]) -> None:
    folder = out / "figures"
    folder.mkdir(parents=True, exist_ok=True)
    for figure in found:
        (folder / f"{figure.name}.json").write_bytes(msgspec.json.format(msgspec.json.encode(figure)) + b"\n")
        draw.draw(figure, folder / f"{figure.name}.svg")
    new = out / f".{REPORT}.new"
    new.write_text(page(size, found, rows, lacking))
    new.replace(out / REPORT)


def page(size: Size, found: list[Figure], rows: list[series.Row], lacking: list[str]) -> str:
    """Return the report as Markdown."""
    about = _ABOUT.format(
        machine=_machine(), cores=os.cpu_count(), memory=psutil.virtual_memory().total / 2**30,
        date=time.strftime("%Y-%m-%d", time.gmtime()), size=size,
    )  # fmt: skip
    header = ("planner", "decomposition accuracy, %", "parallelisation recall, %", "latency, ms")
    parts = ["# The paper's evaluation on this machine", about, "## Table I: decomposition", table(header, rows)]
    parts.append("Latency is the median here, the mean in the paper, whose instructions are others.")
    for figure in found:
        parts += [f"## {figure.title}", f"![{figure.title}](figures/{figure.name}.svg)"]
        parts.append(f"{figure.note}{'. ' if figure.note else ''}[Data](figures/{figure.name}.json)")
    if lacking:
        parts += ["## Not measured", ", ".join(lacking)]
    return "\n\n".join(parts) + "\n"


def _machine() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())
