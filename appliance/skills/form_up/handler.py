"""form_up: spots of a formation around the middle of the robots, shared among them; all go there together."""

import math
from collections.abc import Callable
from typing import Any

from _lib import joint, moves, params, paths
from _lib.context import Context
from _lib.places import Spot

Offsets = list[tuple[float, float]]


def _line(count: int) -> Offsets:
    return [((number - (count - 1) / 2) * joint.APART_M, 0.0) for number in range(count)]


def _column(count: int) -> Offsets:
    return [(y, x) for x, y in _line(count)]


def _circle(count: int) -> Offsets:
    radius = joint.APART_M / (2 * math.sin(math.pi / count))
    return [
        (radius * math.cos(2 * math.pi * number / count), radius * math.sin(2 * math.pi * number / count))
        for number in range(count)
    ]


def _wedge(count: int) -> Offsets:
    """The first in front, to the north; the others behind it, left and right by turns."""
    back = joint.APART_M / math.sqrt(2) * (count // 2) / 2
    return [
        (
            (-1) ** number * -(-number // 2) * joint.APART_M / math.sqrt(2),
            back - -(-number // 2) * joint.APART_M / math.sqrt(2),
        )
        for number in range(count)
    ]


FORMATIONS: dict[str, Callable[[int], Offsets]] = {
    "line": _line,
    "row": _line,
    "abreast": _line,
    "column": _column,
    "file": _column,
    "queue": _column,
    "circle": _circle,
    "ring": _circle,
    "wedge": _wedge,
    "v": _wedge,
    "arrow": _wedge,
}
"""By the words that name them: from east to west, from north to south, around the middle, open to the south."""


def run(ctx: Context) -> dict[str, Any]:
    """Return formation, robots: by name pose and path_m."""
    asked = params.text(ctx, "formation")
    words = asked.lower().replace("-", " ").split()
    name = next((each for each in words if each in FORMATIONS), None)
    if name is None:
        raise ctx.CallError("payload", f"the formation {asked[:60]!r} is not known", f"known: {', '.join(FORMATIONS)}")
    before = joint.states(ctx)
    count = len(before)
    x, y = (sum(each[axis] for each in before.values()) / count for axis in (0, 1))
    closed = [*paths.rectangles(ctx.site.get("obstacles") or ()), *paths.rectangles(ctx.site.get("forbidden") or ())]
    fence = params.table(ctx.site.get("fence"))
    spots = [
        Spot(f"{name} {number}", x + east, y + north) for number, (east, north) in enumerate(FORMATIONS[name](count), 1)
    ]
    blocked = [each.name for each in spots if not joint.standable(each.x, each.y, closed, fence)]
    if blocked:
        raise ctx.CallError(
            "precondition",
            f"there is no room for a {name} of {count} around ({x:.1f}, {y:.1f}): {', '.join(blocked)}",
            "have the robots meet at a place with more room first",
        )
    robots = joint.go(ctx, before, joint.shared(before, spots), speed_mps=moves.speed(ctx), what=f"form a {name}")
    return {"formation": name, "robots": robots}
