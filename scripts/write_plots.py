"""Write the plots of docs/benchmarks.md from benchmarks/results: one SVG each into docs/plots.

A plot is a table of `PLOTS`: which rows of which file are its series, and where a row stands on the axes. Nothing is
computed but medians of several runs: the figures are those of the files.
"""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from xml.sax.saxutils import escape

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks" / "results"
PLOTS_FOLDER = ROOT / "docs" / "plots"
WIDTH, HEIGHT, LEFT, TOP, RIGHT, BOTTOM = 640, 320, 60, 34, 170, 44
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9")
"""Told apart by colour-blind people too (Okabe and Ito)."""


@dataclass(frozen=True)
class Series:
    """One line of a plot.

    Args:
        label: what stands beside it.
        claim: pattern of the rows' `claim`; its group is the position on the horizontal axis, where it has one.
        metric: their `metric`.
    """

    label: str
    claim: str
    metric: str


@dataclass(frozen=True)
class Plot:
    """One picture.

    Args:
        file: of results.
        command: how the rows' `command` begins.
        log: whether an axis goes by powers of ten: "", "x", "y".
        runs: whether the position is the number of the run; else that of the claim's group, with medians over runs.
    """

    title: str
    file: str
    command: str
    across: str
    up: str
    series: tuple[Series, ...]
    log: str = ""
    runs: bool = False


def dead(length: str) -> Series:
    """Return the share of lookups that fail with a list of so many successors."""
    return Series(f"{length} successors", r"failures at once, 10,000, (\d+) % dead", length)


PLOTS = {
    "lookup-hops": Plot(
        "Hops of a lookup (simulated)", "plane", "swiftbot bench dht --json", "members", "hops",
        (
            Series("½·log2 N (Chord)", r"([\d,]+) members, lookup", "½·log2 N (Chord's published mean)"),
            Series("p99", r"([\d,]+) members, lookup", "p99"),
            Series("mean", r"([\d,]+) members, lookup", "mean hops"),
        ),
        log="x",
    ),
    "lookup-failures": Plot(
        "Lookups that fail, of 10,000 members (simulated)", "plane", "swiftbot bench dht --json",
        "% of members that fail at once", "% of lookups", (dead("3"), dead("5"), dead("10"), dead("log2 N")),
    ),
    "startup": Plot(
        "Start of a run, p50 of each measured run", "pool", "swiftbot bench startup", "run, in order of time", "ms",
        (
            Series("cold", "cold", "p50"),
            Series("warm, on another gateway", "federated", "p50"),
            Series("warm, local", "local start", "p50"),
        ),
        log="y", runs=True,
    ),
}  # fmt: skip


def points(plot: Plot, series: Series) -> list[tuple[float, float]]:
    """Return the points of a series, from left to right."""
    found: dict[float, list[float]] = {}
    for line in (RESULTS / f"{plot.file}.jsonl").read_text(encoding="utf-8").splitlines():
        row = json.loads(line)
        claim = re.fullmatch(series.claim, row["claim"])
        if claim and row["metric"] == series.metric and row["command"].startswith(plot.command):
            at = len(found) + 1.0 if plot.runs else float(claim[1].replace(",", ""))
            found.setdefault(at, []).append(float(row["value"]))
    return sorted((at, median(values)) for at, values in found.items())


class Axis:
    """Places values between two edges, by themselves or by their powers of ten."""

    def __init__(self, values: list[float], begin: float, end: float, *, log: bool) -> None:
        self._log = log
        self._begin, self._end = begin, end
        if log:
            self._low, self._high = math.floor(math.log10(min(values))), math.ceil(math.log10(max(values)))
            self.ticks = [10.0**power for power in range(self._low, self._high + 1)]
        else:
            step = 10 ** math.floor(math.log10(max(values) or 1))
            step = step / 2 if max(values) / step < 4 else step
            self._low, self._high = 0.0, step * math.ceil(max(values) / step)
            self.ticks = [step * number for number in range(round(self._high / step) + 1)]

    def place(self, value: float) -> float:
        """Return where a value stands."""
        share = ((math.log10(value) if self._log else value) - self._low) / (self._high - self._low)
        return round(self._begin + share * (self._end - self._begin), 1)


def text(x: float, y: float, what: str, *, anchor: str = "middle", colour: str = "#444") -> str:
    """Return a text of the picture."""
    return f'<text x="{x}" y="{y}" text-anchor="{anchor}" fill="{colour}">{escape(what)}</text>'


def drawn(plot: Plot) -> str:
    """Return the picture."""
    lines = {series: points(plot, series) for series in plot.series}
    every = [point for line in lines.values() for point in line]
    right, bottom = WIDTH - RIGHT, HEIGHT - BOTTOM
    across = Axis([x for x, _ in every], LEFT, right, log="x" in plot.log)
    up = Axis([y for _, y in every], bottom, TOP, log="y" in plot.log)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" style="font: 12px sans-serif">',
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="#fff"/>',
        text(LEFT, 20, f"{plot.title}: {plot.up}", anchor="start", colour="#111"),
        text((LEFT + right) / 2, HEIGHT - 8, plot.across),
    ]
    parts += [text(across.place(tick), bottom + 18, f"{tick:,.10g}") for tick in across.ticks]
    for tick in up.ticks:
        y = up.place(tick)
        parts.append(f'<path d="M{LEFT} {y}H{right}" stroke="#ddd"/>')
        parts.append(text(LEFT - 8, y + 4, f"{tick:,.10g}", anchor="end"))
    for (series, line), colour in zip(lines.items(), COLOURS, strict=False):
        places = [(across.place(x), up.place(y)) for x, y in line]
        parts.append(
            f'<polyline points="{" ".join(f"{x},{y}" for x, y in places)}" fill="none" stroke="{colour}"'
            ' stroke-width="2"/>'
        )
        parts += [f'<circle cx="{x}" cy="{y}" r="3" fill="{colour}"/>' for x, y in places]
        x, y = places[-1]
        parts.append(text(x + 8, y + 4, series.label, anchor="start", colour=colour))
    return "\n".join([*parts, "</svg>", ""])


def main() -> None:
    """Write every plot."""
    PLOTS_FOLDER.mkdir(exist_ok=True)
    for name, plot in PLOTS.items():
        (PLOTS_FOLDER / f"{name}.svg").write_text(drawn(plot), encoding="utf-8")


if __name__ == "__main__":
    main()
