"""Figures as SVG, by matplotlib (extra `report`)."""

import importlib
import importlib.util
from pathlib import Path
from typing import Any

from appliance.errors import PrerequisiteError
from workshop.bench.paper.series import Figure

REMEDY = "install the extra `report`, as pinned in locks/report.txt"
SIZE_INCHES = (7.0, 4.2)


def check() -> None:
    """Raise PrerequisiteError where matplotlib is not there: better before hours of measuring than after."""
    if importlib.util.find_spec("matplotlib") is None:
        raise PrerequisiteError("figures are drawn with matplotlib, which is not installed", remedy=REMEDY)


def draw(figure: Figure, path: Path) -> None:
    """Write a figure as SVG, the same bytes for the same data; OSError where it cannot be written."""
    check()
    matplotlib: Any = importlib.import_module("matplotlib")
    matplotlib.use("svg")
    matplotlib.rcParams["svg.hashsalt"] = figure.name
    pyplot: Any = importlib.import_module("matplotlib.pyplot")
    canvas, axes = pyplot.subplots(figsize=SIZE_INCHES, layout="constrained")
    try:
        _fill(figure, axes)
        canvas.savefig(path, metadata={"Date": None})
    finally:
        pyplot.close(canvas)


def _fill(figure: Figure, axes: Any) -> None:
    for line in figure.lines:
        if line.published:
            axes.plot(line.x, line.y, linestyle=":", marker="x", color="grey")
            place = {"xytext": (2, 4), "textcoords": "offset points", "rotation": 35, "ha": "left"}
            axes.annotate(line.label, (line.x[-1], line.y[-1]), fontsize=7, color="grey", **place)
        else:
            axes.plot(line.x, line.y, marker="." if len(line.x) < 60 else "", label=line.label)
    labels = list(dict.fromkeys(violin.label for violin in figure.violins))
    for number, label in enumerate(labels):
        mine = [violin for violin in figure.violins if violin.label == label]
        width = 5.0 / len(labels)
        places = [violin.x + (number - (len(labels) - 1) / 2) * width for violin in mine]
        bodies = axes.violinplot([violin.values for violin in mine], positions=places, widths=width, showmedians=True)
        axes.plot([], [], color=bodies["bodies"][0].get_facecolor()[0], linewidth=6, label=label)
    for place in figure.at:
        axes.axvline(place, linestyle="--", color="grey", linewidth=0.8)
    axes.set_xscale(figure.scale)
    if figure.violins:
        axes.set_xticks(sorted({violin.x for violin in figure.violins}))
        axes.set_ylim(bottom=0.0)
    axes.set(title=figure.title, xlabel=figure.x, ylabel=figure.y)
    axes.legend(fontsize=7)
    axes.grid(alpha=0.3)
