"""What names of places mean: the site's map, its aliases, and plain coordinates."""

import math
import re
from typing import Any, NamedTuple

from . import coordinates, params
from .context import Context

_SPLIT = re.compile(r"\s*(?:[,;]|->|→|\band then\b|\bthen\b|\band\b|\bvia\b|\bto\b|\bfrom\b)\s*")
_FAR_M = 200.0
"""A coordinate further than this outside the mapped area is taken for a mistake."""


class Spot(NamedTuple):
    """A point with a name; `z` is 0 where no height is meant."""

    name: str
    x: float
    y: float
    z: float = 0.0


def plain(name: str) -> str:
    """Return a name as the site's keys are written: lower case, single spaces, no articles (model.Site.find)."""
    words = name.lower().replace("_", " ").strip(" .!?\"'").split()
    return " ".join(word for word in words if word not in ("the", "a", "an"))


def resolve(ctx: Context, name: str) -> Spot:
    """Return where a place or coordinate is; ctx.Fail with the known places when the site has no such place."""
    point = coordinates.read(name)
    if point is not None:
        x, y, z = point
        _check_within(ctx, name, x, y)
        return Spot(f"({x:g}, {y:g})", x, y, z)
    places = params.table(ctx.site.get("places"))
    wanted = plain(name)
    for key, place in places.items():
        if wanted == key or wanted in (place.get("aliases") or ()):
            return Spot(key, float(place.get("x", 0.0)), float(place.get("y", 0.0)), float(place.get("z", 0.0)))
    known = ", ".join(sorted(places)) or "none: the site's map is empty"
    raise ctx.CallError("not-found", f"the site has no place {wanted[:80]!r}", f"known places: {known}")


def route(ctx: Context, text: str) -> list[Spot]:
    """Return the places of a route such as "goal 1, aisle then (12, 7)"; coordinates need their brackets."""
    kept: list[str] = []

    def keep(match: re.Match[str]) -> str:
        kept.append(match.group(0))
        return f" ;#{len(kept) - 1}; "

    parts = _SPLIT.split(re.sub(r"\([^()]*\)", keep, text.lower()))
    return [
        resolve(ctx, kept[int(part[1:])] if re.fullmatch(r"#\d+", part) else part)
        for part in (each.strip() for each in parts)
        if part
    ]


def area(ctx: Context, name: str) -> tuple[float, float, float, float] | None:
    """Return (x0, x1, y0, y1) of the obstacle or forbidden area of that name, None when there is none."""
    wanted = plain(name)
    for box in (*(ctx.site.get("obstacles") or ()), *(ctx.site.get("forbidden") or ())):
        if plain(str(box.get("name", ""))) == wanted:
            return float(box["x"][0]), float(box["x"][1]), float(box["y"][0]), float(box["y"][1])
    return None


AROUND_M = 5.0
"""What is meant around a place that is a point on the map, metres each way."""


def extent(ctx: Context, name: str) -> tuple[float, float, float, float]:
    """Return (x0, x1, y0, y1) of an area to be covered: mapped, or around a place; within the fence. Never empty."""
    found = area(ctx, name)
    if found is None:
        fence = params.table(ctx.site.get("fence"))
        if plain(name) in ("site", "everything", "whole site", "yard", plain(str(fence.get("name", "site")))) and fence:
            found = (float(fence["x"][0]), float(fence["x"][1]), float(fence["y"][0]), float(fence["y"][1]))
        else:
            spot = resolve(ctx, name)
            found = (spot.x - AROUND_M, spot.x + AROUND_M, spot.y - AROUND_M, spot.y + AROUND_M)
    fence = params.table(ctx.site.get("fence"))
    if fence:
        x, y = fence["x"], fence["y"]
        found = (max(found[0], x[0]), min(found[1], x[1]), max(found[2], y[0]), min(found[3], y[1]))
    if found[0] >= found[1] or found[2] >= found[3]:
        raise ctx.CallError("payload", f"{name} lies outside the site's fence", "name an area within it")
    return found


def _check_within(ctx: Context, name: str, x: float, y: float) -> None:
    places: list[dict[str, Any]] = list(params.table(ctx.site.get("places")).values())
    xs = [float(each.get("x", 0.0)) for each in places] or [0.0]
    ys = [float(each.get("y", 0.0)) for each in places] or [0.0]
    inside = min(xs) - _FAR_M <= x <= max(xs) + _FAR_M and min(ys) - _FAR_M <= y <= max(ys) + _FAR_M
    if not (inside and math.isfinite(x) and math.isfinite(y)):
        raise ctx.CallError(
            "payload",
            f"{name.strip()} lies more than {_FAR_M:g} m outside the site",
            f"the site's places span x {min(xs):g} to {max(xs):g}, y {min(ys):g} to {max(ys):g}",
        )
