"""map_area: drive through an area and build an occupancy grid of it with the robot's range finder."""

from typing import Any

from _lib import mapping, params
from _lib.context import Context


def run(ctx: Context) -> dict[str, Any]:
    """Return map (PGM and where it lies), a picture of it, area, stops and path_m."""
    result = mapping.survey(ctx, params.text(ctx, "area"))
    ctx.progress(1.0, f"{result['area']}: {100 * result['map']['known_share']:.0f} % mapped")
    return result
