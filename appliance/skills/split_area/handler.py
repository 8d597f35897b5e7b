"""split_area: an area cut into strips of one size, one for each robot, across its longer side."""

from typing import Any, cast

from _lib import params, places
from _lib.context import Context

MOST = 64


def run(ctx: Context) -> dict[str, Any]:
    """Return zones (robot, name, x and y ranges in metres, square metres) and area."""
    area = params.text(ctx, "area")
    given = ctx.params.get("robots")
    listed = cast("list[object]", given) if isinstance(given, list) else []
    robots = list(dict.fromkeys(str(each).strip() for each in listed if str(each).strip()))
    if not 1 <= len(robots) <= MOST:
        raise ctx.CallError("payload", f"{len(robots)} robots are named", f"name 1 to {MOST} robots")
    x0, x1, y0, y1 = places.extent(ctx, area)
    wide = x1 - x0 >= y1 - y0
    zones: list[dict[str, Any]] = []
    for number, robot in enumerate(robots):
        low, high = number / len(robots), (number + 1) / len(robots)
        x = [round(x0 + (x1 - x0) * share, 2) for share in (low, high)] if wide else [x0, x1]
        y = [y0, y1] if wide else [round(y0 + (y1 - y0) * share, 2) for share in (low, high)]
        square = round((x[1] - x[0]) * (y[1] - y[0]), 2)
        zones.append({"robot": robot, "name": f"{area} {number + 1}", "x": x, "y": y, "square_m": square})
    ctx.progress(1.0, f"{area} is split among {len(robots)}")
    return {"zones": zones, "area": area}
