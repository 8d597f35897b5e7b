"""explore: cover an area, mapping it, and say what coloured things are seen in it on the way."""

from typing import Any

from _lib import colours, mapping, params, pictures
from _lib.context import Context


def run(ctx: Context) -> dict[str, Any]:
    """Return map, area, stops, path_m, and detections with the pictures that show them."""
    area = params.text(ctx, "area")
    saved = ctx.resume or {}
    found = params.rows(saved.get("detections"))
    images: list[pictures.Reference] = params.rows(saved.get("images"))

    def look(stop: int) -> dict[str, Any]:
        data, _ = pictures.take(ctx, area)
        rows = colours.detections(colours.decode(ctx, data, f"stop {stop}"), "things", ctx.site)
        if rows:
            images.append(pictures.keep(ctx, area, data, stop))
            found.extend({**row, "stop": stop, "image": images[-1]["artifact"]} for row in rows)
        return {"detections": found, "images": images}

    result = mapping.survey(ctx, area, look)
    ctx.progress(1.0, f"{area}: {len(found)} things seen at {result['stops']} stops")
    return {**result, "detections": found, "count": len(found), "images": images}
