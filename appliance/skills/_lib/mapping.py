"""Occupancy grids: what of an area is free, what is not, and what nobody has seen. Covers an area stop by stop.

A robot's range finder answers `scan`: distances in metres, `step_deg` apart, the first towards `from_deg` (compass
degrees), null where there is no echo within `most_m`. Each beam frees the cells that it crosses and marks the one where
it ends; a cell that was marked once stays marked. Files are PGM as ROS map_server writes them: 0 is taken, 254 is free,
205 is unknown, the top row is north. Needs numpy and Pillow, which image `vision` has.
"""

import io
import math
from collections.abc import Callable
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from . import moves, params, paths, places
from .context import Context
from .places import Spot

UNKNOWN, FREE, TAKEN = 205, 254, 0
RESOLUTION_M = 0.25
MAX_CELLS = 4_000_000
STOP_M = 4.0
"""Distance of stops: less than the reach of a usual range finder."""
MAX_STOPS = 80
KIND = "application/x-portable-graymap"
"""Not an image, so that nobody looks for things in it."""


class Grid:
    """An area in cells; `cells` has the southernmost row first.

    Args:
        x0: its western edge, metres.
        y0: its southern edge.
        width: cells from west to east.
        height: cells from south to north.
        resolution: size of a cell, metres.
    """

    def __init__(self, x0: float, y0: float, width: int, height: int, resolution: float = RESOLUTION_M) -> None:
        self.x0, self.y0, self.resolution = x0, y0, resolution
        self.cells: NDArray[np.uint8] = np.full((height, width), UNKNOWN, dtype=np.uint8)

    @property
    def known(self) -> float:
        """Share of the cells that something is known about, 0 to 1."""
        return float((self.cells != UNKNOWN).mean())

    def add(self, x: float, y: float, scan: dict[str, Any]) -> int:
        """Take in what a range finder at (x, y) saw; returns how many of its beams could be used."""
        most = _number(scan.get("most_m"), 10.0)
        first, step = _number(scan.get("from_deg"), 0.0), _number(scan.get("step_deg"), 1.0)
        given: object = scan.get("ranges_m")
        ranges = cast("list[object]", given) if isinstance(given, list) else []
        used = 0
        taken: list[tuple[float, float]] = []
        for number, value in enumerate(ranges):
            length = most if value is None else _number(value, -1.0)
            if not 0.0 <= length <= most:
                continue
            used += 1
            bearing = math.radians(first + number * step)
            along = np.arange(0.0, length, self.resolution / 2)
            self._mark(x + along * math.sin(bearing), y + along * math.cos(bearing), FREE)
            if length < most:
                taken.append((x + length * math.sin(bearing), y + length * math.cos(bearing)))
        if taken:
            ends = np.array(taken)
            self._mark(ends[:, 0], ends[:, 1], TAKEN)
        return used

    def _mark(self, x: "NDArray[np.float64]", y: "NDArray[np.float64]", what: int) -> None:
        height, width = self.cells.shape
        column = np.floor((x - self.x0) / self.resolution).astype(int)
        row = np.floor((y - self.y0) / self.resolution).astype(int)
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        row, column = row[inside], column[inside]
        if what == FREE:
            free = self.cells[row, column] != TAKEN
            row, column = row[free], column[free]
        self.cells[row, column] = what

    def lay_over(self, other: "Grid") -> None:
        """Take in another grid of the same resolution, whose cells lie where they are: taken over free over unknown."""
        height, width = other.cells.shape
        y, x = np.mgrid[0:height, 0:width]
        for what in (FREE, TAKEN):
            here = other.cells == what
            at_x = other.x0 + (x[here] + 0.5) * other.resolution
            self._mark(at_x, other.y0 + (y[here] + 0.5) * other.resolution, what)

    def keep(self, ctx: Context, name: str) -> dict[str, Any]:
        """Keep it as a file; returns the reference with what is needed to read it again."""
        height, width = self.cells.shape
        data = f"P5\n{width} {height}\n255\n".encode() + self.cells[::-1].tobytes()
        about = {"resolution_m": self.resolution, "origin": [self.x0, self.y0], "width": width, "height": height}
        return ctx.put_artifact(f"{params.slug(name)}.pgm", data, KIND) | about | {"known_share": round(self.known, 4)}

    def picture(self, ctx: Context, name: str) -> dict[str, Any]:
        """Keep a picture for people."""
        out = io.BytesIO()
        Image.fromarray(self.cells[::-1]).save(out, "PNG")
        return ctx.put_artifact(f"{params.slug(name)}.png", out.getvalue(), "image/png")


def read(ctx: Context, reference: dict[str, Any]) -> Grid:
    """Return a grid that was kept; ctx.Fail when the file is none."""
    data = ctx.get_artifact(reference)
    head = data[:64].split(b"\n", 3)
    name = str(reference.get("name", "the map"))[:80]
    size = head[1].split() if len(head) == 4 and head[0] == b"P5" and head[2] == b"255" else []
    if len(size) != 2 or not all(each.isdigit() for each in size):
        raise ctx.Fail(f"{name} is no map that can be read", "make it again")
    width, height = int(size[0]), int(size[1])
    start = len(b"\n".join(head[:3])) + 1
    if not 0 < width * height <= MAX_CELLS or len(data) - start != width * height:
        raise ctx.Fail(f"{name} is cut: {len(data) - start:,} bytes for {width} x {height} cells", "make it again")
    given: object = reference.get("origin")
    origin = cast("list[object]", given) if isinstance(given, list) else []
    x0, y0 = (_number(each, 0.0) for each in origin) if len(origin) == 2 else (0.0, 0.0)
    resolution = _number(reference.get("resolution_m"), RESOLUTION_M)
    if not 0.01 <= resolution <= 10.0:
        raise ctx.Fail(f"{name} has cells of {resolution:g} m", "make it again")
    grid = Grid(x0, y0, width, height, resolution)
    grid.cells = np.frombuffer(data, dtype=np.uint8, offset=start).reshape(height, width)[::-1].copy()
    return grid


def survey(ctx: Context, area: str, at_stop: Callable[[int], dict[str, Any]] = lambda _: {}) -> dict[str, Any]:
    """Drive through an area and map it; `at_stop` gets each stop's number and returns what a checkpoint is to hold too.

    Returns:
        `map`, `annotated` (a picture), `area`, `stops`, `skipped` (stops without a way there) and `path_m`.
    """
    x0, x1, y0, y1 = places.extent(ctx, area)
    width, height = (math.ceil((high - low) / RESOLUTION_M) for low, high in ((x0, x1), (y0, y1)))
    if width * height > MAX_CELLS:
        raise ctx.CallError("payload", f"{area} is {x1 - x0:.0f} x {y1 - y0:.0f} m", "map it in several parts")
    saved = ctx.resume or {}
    grid = read(ctx, saved["map"]) if "map" in saved else Grid(x0, y0, width, height)
    stops = _stops(ctx, (x0, x1, y0, y1))
    if not 1 <= len(stops) <= MAX_STOPS:
        raise ctx.CallError("payload", f"{area} takes {len(stops)} stops, 1 to {MAX_STOPS} are possible", "split it")
    speed = moves.speed(ctx)
    skipped, metres = int(saved.get("skipped", 0)), float(saved.get("path_m", 0.0))
    first = int(saved.get("next", 0))
    for number in range(first, len(stops)):
        share = 0.9 / len(stops)
        if not moves.reachable(ctx, moves.state(ctx), stops[number]):
            skipped += 1
            continue
        way = moves.go(ctx, [stops[number]], speed_mps=speed, done=number * share, share=share)
        metres += way["path_m"]
        scan = ctx.command("scan", timeout_s=30)
        pose = params.table(scan.get("pose")) or way["pose"]
        if not grid.add(float(pose["x"]), float(pose["y"]), scan):
            raise ctx.Fail(f"{ctx.robot} sent a scan without a distance", "look at its range finder", retryable=True)
        seen = at_stop(number + 1)
        ctx.partial({"area": area, "stops": number + 1, "known_share": round(grid.known, 3)})
        if ctx.checkpoint_due():
            kept = grid.keep(ctx, f"{area} so far")
            ctx.checkpoint({"next": number + 1, "map": kept, "skipped": skipped, "path_m": metres, **seen})
    if skipped == len(stops):
        raise ctx.CallError("precondition", f"no part of {area} can be driven to", "is it walled off on the map?")
    return {
        "map": grid.keep(ctx, area),
        "annotated": [grid.picture(ctx, area)],
        "area": area,
        "stops": len(stops) - skipped,
        "skipped": skipped,
        "path_m": round(metres, 2),
    }


def _stops(ctx: Context, box: tuple[float, float, float, float]) -> list[Spot]:
    """Return points that cover a box lane by lane, but those in what is closed on the map."""
    x0, x1, y0, y1 = box
    columns, rows = (max(1, math.ceil((high - low) / STOP_M)) for low, high in ((x0, x1), (y0, y1)))
    closed = [*(ctx.site.get("obstacles") or ()), *(ctx.site.get("forbidden") or ())]
    walls = [each.grown(paths.CLEARANCE_M) for each in paths.rectangles(closed)]
    stops: list[Spot] = []
    for row in range(rows):
        lane = range(columns) if row % 2 == 0 else reversed(range(columns))
        for column in lane:
            x = x0 + (column + 0.5) * (x1 - x0) / columns
            y = y0 + (row + 0.5) * (y1 - y0) / rows
            if not any(wall.holds((x, y)) for wall in walls):
                stops.append(Spot(f"stop {len(stops) + 1}", round(x, 3), round(y, 3)))
    return stops


def _number(value: object, default: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return default
    return float(value)
