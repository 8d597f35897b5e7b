"""match_scene: which picture of some data sets shows the scene, and where that was taken.

A data set is a folder of the gateway's folder `scenes`: pictures, and `poses.csv` with `file,x,y,heading_deg` for each.
Pictures are compared by the correlation of their brightness (normalised: light does not count), at a few offsets
to either side: a robot that looks past it a little still finds it.
"""

import csv
import math
import time
from pathlib import Path
from typing import Any, cast

import numpy as np
from _lib import changes, params, pictures
from _lib.context import Context
from numpy.typing import NDArray

MOST = 2000
"""Pictures of all data sets that are looked at."""
SURE = 0.6
"""Correlation from which on it is the same scene."""
OFFSETS = (0, -8, 8, -16, 16)
"""Pixels to the side, of 160."""


def run(ctx: Context) -> dict[str, Any]:
    """Return pose (metres, degrees), dataset, file, correlation (-1 to 1) and how many pictures were compared."""
    given = ctx.params.get("datasets")
    names = [str(each).strip() for each in cast("list[object]", given)] if isinstance(given, list) else []
    window_s = params.number(ctx, "window_ms", default=60_000.0, low=50.0, high=600_000.0) / 1e3
    folders = _folders(ctx, names)
    images = list(pictures.references(ctx.inputs, "image/"))
    if not images:
        raise ctx.Fail("there is no picture to match", "photograph the scene first")
    scene = changes.small(ctx, ctx.get_artifact(images[-1]), "the picture").mean(axis=2)
    until = time.monotonic() + window_s
    best: tuple[float, str, str, dict[str, float]] | None = None
    seen = 0
    for name, folder in folders.items():
        for file, pose in _poses(ctx, name, folder):
            if seen >= MOST or (seen and time.monotonic() > until):
                break
            seen += 1
            found = _correlation(scene, changes.small(ctx, (folder / file).read_bytes(), f"{name}/{file}").mean(axis=2))
            if best is None or found > best[0]:
                best = (found, name, file, pose)
        ctx.progress(0.9, f"{seen} pictures")
    if best is None or best[0] < SURE:
        score = "" if best is None else f", the nearest ({best[1]}/{best[2]}) by {best[0]:.2f}"
        raise ctx.Fail(f"none of {seen} pictures shows the scene{score}", "take it from another side, or add pictures")
    ctx.progress(1.0, f"as {best[1]}/{best[2]}, {best[0]:.2f}")
    return {"pose": best[3], "dataset": best[1], "file": best[2], "correlation": round(best[0], 3), "compared": seen}


def _folders(ctx: Context, names: list[str]) -> dict[str, Path]:
    root = ctx.host_folder("scenes")
    there = {each.name: each for each in sorted(root.iterdir()) if (each / "poses.csv").is_file()}
    chosen = {
        name: folder for name, folder in there.items() if params.slug(name) in {params.slug(each) for each in names}
    }
    if not names or len(chosen) < len({params.slug(each) for each in names}):
        raise ctx.CallError(
            "not-found",
            f"data sets {', '.join(names) or 'none'}: {len(chosen)} are here",
            f"there are: {', '.join(there) or 'none'} (a folder with poses.csv in the gateway's folder scenes)",
        )
    return chosen


def _poses(ctx: Context, name: str, folder: Path) -> list[tuple[str, dict[str, float]]]:
    found: list[tuple[str, dict[str, float]]] = []
    with (folder / "poses.csv").open(newline="") as lines:
        for number, row in enumerate(csv.reader(lines), start=1):
            try:
                file, x, y, heading = row[0], *(float(each) for each in row[1:4])
            except (ValueError, IndexError):
                if number == 1:
                    continue  # a heading
                raise ctx.Fail(
                    f"{name}/poses.csv, line {number}: {','.join(row)[:80]!r}", "file,x,y,heading_deg"
                ) from None
            if "/" in file or file.startswith(".") or not all(math.isfinite(each) for each in (x, y, heading)):
                raise ctx.Fail(
                    f"{name}/poses.csv, line {number}: {file[:80]!r} is not a picture beside it", "mend the line"
                )
            if not (folder / file).is_file():
                raise ctx.Fail(
                    f"{name}/poses.csv, line {number}: there is no {file[:80]}", "add it, or take the line out"
                )
            found.append((file, {"x": x, "y": y, "heading_deg": heading}))
    return found


def _correlation(one: "NDArray[np.float64]", other: "NDArray[np.float64]") -> float:
    """Return the best normalised correlation over `OFFSETS`."""
    width = one.shape[1]
    best = -1.0
    for offset in OFFSETS:
        left, right = (
            one[:, max(0, offset) : width + min(0, offset)],
            other[:, max(0, -offset) : width - max(0, offset)],
        )
        a, b = left - left.mean(), right - right.mean()
        scale = math.sqrt(float((a * a).sum()) * float((b * b).sum()))
        if scale > 1e-9:
            best = max(best, float((a * b).sum()) / scale)
    return best
