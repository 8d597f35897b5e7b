"""merge_maps: the maps that several robots made as one, and what they detected as one list."""

import math
from collections.abc import Iterator
from typing import Any

from _lib import mapping, params
from _lib.context import Context


def run(ctx: Context) -> dict[str, Any]:
    """Return map, a picture of it, merged (how many maps) and detections; ctx.Fail when there is no map."""
    references = [table for result in ctx.inputs.values() for table in _maps(result)]
    if not references:
        raise ctx.Fail("there is no map to merge", "map an area first")
    grids = [mapping.read(ctx, each) for each in references]
    cell = min(each.resolution for each in grids)
    x0, y0 = min(each.x0 for each in grids), min(each.y0 for each in grids)
    x1 = max(each.x0 + each.cells.shape[1] * each.resolution for each in grids)
    y1 = max(each.y0 + each.cells.shape[0] * each.resolution for each in grids)
    width, height = math.ceil((x1 - x0) / cell - 1e-6), math.ceil((y1 - y0) / cell - 1e-6)
    if width * height > mapping.MAX_CELLS:
        raise ctx.Fail(f"the maps lie {x1 - x0:.0f} x {y1 - y0:.0f} m apart", "merge maps of one place")
    whole = mapping.Grid(x0, y0, width, height, cell)
    for number, grid in enumerate(grids, start=1):
        whole.lay_over(grid)
        ctx.progress(0.9 * number / len(grids), f"map {number} of {len(grids)}")
    rows = [row for result in ctx.inputs.values() for row in params.rows(result.get("detections"))]
    ctx.progress(1.0, f"{len(grids)} maps, {100 * whole.known:.0f} % known")
    merged = {"map": whole.keep(ctx, "merged map"), "annotated": [whole.picture(ctx, "merged map")]}
    return {**merged, "merged": len(grids), "detections": rows, "count": len(rows)}


def _maps(result: dict[str, Any]) -> Iterator[dict[str, Any]]:
    found = params.table(result.get("map"))
    if isinstance(found.get("artifact"), str) and found.get("media_type") == mapping.KIND:
        yield found
