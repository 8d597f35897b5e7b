"""A curve in a terminal: values over rounds as braille dots, several series on one scale. Pure."""

import math
from collections.abc import Sequence

from msgspec import Struct

from appliance.tui.widgets.map import Canvas, Line


class Series(Struct, frozen=True):
    """Values in their order, None where there is none, and the style of their dots."""

    values: tuple[float | None, ...]
    style: str


def plot(series: Sequence[Series], columns: int, rows: int) -> list[Line]:
    """Return the lines of a plot: all series side by side from the left edge to the right, on one vertical scale.

    What is not finite is left out. With more values than dots the mean of those that share a column is drawn.

    Args:
        series: those to draw, the later above the earlier.
        columns: cells in width.
        rows: cells in height.
    """
    canvas = Canvas(max(0, columns), max(0, rows))
    across, up = canvas.columns * 2, canvas.rows * 4
    known = [value for each in series for _, value in _numbers(each.values)]
    if not known or not across or not up:
        return canvas.lines()
    least, most = min(known), max(known)
    span = (most - least) or 1.0

    def height(value: float) -> int:
        return round((value - least) / span * (up - 1)) if most > least else up // 2

    for each in series:
        before: tuple[int, int] | None = None
        for column, value in _by_column(each.values, across):
            here = (column, height(value))
            _line(canvas, before or here, here, each.style)
            before = here
    return canvas.lines()


def _numbers(values: Sequence[float | None]) -> list[tuple[int, float]]:
    """Return places and values of what can be drawn."""
    return [(at, value) for at, value in enumerate(values) if value is not None and math.isfinite(value)]


def _by_column(values: Sequence[float | None], across: int) -> list[tuple[int, float]]:
    """Return column and value of what is to be drawn."""
    found: dict[int, list[float]] = {}
    last = max(1, len(values) - 1)
    for at, value in _numbers(values):
        found.setdefault(round(at / last * (across - 1)), []).append(value)
    return [(column, sum(each) / len(each)) for column, each in found.items()]


def _line(canvas: Canvas, start: tuple[int, int], end: tuple[int, int], style: str) -> None:
    steps = max(abs(end[0] - start[0]), abs(end[1] - start[1]), 1)
    for step in range(steps + 1):
        column = start[0] + round((end[0] - start[0]) * step / steps)
        canvas.dot(column, start[1] + round((end[1] - start[1]) * step / steps), style)
