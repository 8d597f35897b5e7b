"""Places: what a text names on a site, and whether a robot may go there. Pure.

One parser reads coordinates for plans, missions, the policy and the skills in their containers: two numbers, or three
with a height, in metres of the site (`skills/_lib/coordinates.py`).
"""

import math
import re
from collections.abc import Iterable, Sequence
from typing import Any, TypeGuard

from appliance.model import Box, Place, Site, Subtask
from appliance.model.site import off_site
from appliance.skills._lib.coordinates import COORDINATE, read
from appliance.skills.sites import plain_name

SAME_SPOT_M = 1.0
"""A coordinate as near as this to a place is that place: a robot that stands there is in its way."""
MOST_PARTS = 64
GEOGRAPHIC_DEG = 0.5
"""A pair of numbers as near as this to the site's latitude and longitude is meant as such, where it has decimals."""
_IN_BRACKETS = re.compile(r"\([^()]*\)")
_NUMBER = r"[-+−]?\d{1,6}(?:\.\d+)?"
_PAIR = re.compile(rf"(?:^|[(;>]|\b(?:to|via|at|from|through|then|and)\s)\s*({_NUMBER})\s*,\s*({_NUMBER})(?![\w.])")
"""A pair of figures that a route names as a point."""
_PLAIN = re.compile(r"[a-z0-9_.-]{1,40}")
_SPLIT = re.compile(r"[,;]|->|→|\b(?:then|and|via|to|from)\b")
"""What stands between the places of a route, as the skills read it."""


def coordinate(text: str) -> Place | None:
    """Return the point that a text such as "12.5, 7", "(3, 4, 8)" or "x=3 y=4" names, metres; None for any other."""
    point = read(text)
    return None if point is None else Place(x=point[0], y=point[1], z=point[2])


def locate(name: str, site: Site) -> Place | None:
    """Return the place a text names: a place of the site, or a coordinate."""
    return site.find(name) or coordinate(name)


def spot_of(name: str, site: Site | None) -> Place | None:
    """Return the place or coordinate that a text names, read as leniently as the skills do."""
    found = coordinate(name)
    return found if found is not None or site is None else locate(bare(name), site)


def known_as(name: str, site: Site | None) -> tuple[str, ...]:
    """Return all names of the place that a text names: its key on the site first, its aliases, the text itself.

    A coordinate has the names of the places within `SAME_SPOT_M`, the nearest first. A text that names no place of the
    site has itself alone.
    """
    own = bare(name)
    spot = spot_of(name, site)
    if site is None or spot is None:
        return (own,)
    near = sorted(
        (away, key)
        for key, each in site.places.items()
        if (away := math.hypot(each.x - spot.x, each.y - spot.y)) <= SAME_SPOT_M
    )
    # A place that is named is that place, whatever lies beside it.
    keys = [key for _, key in near if site.places[key] is spot] or [key for _, key in near]
    return tuple(dict.fromkeys((*(each for key in keys for each in (key, *site.places[key].aliases)), own)))


def parts_of(text: str) -> list[str]:
    """Return what a text names: itself, and the places of it if it is a route such as "goal 1, aisle then (12, 7)"."""
    parts = [text, *_IN_BRACKETS.findall(text), *(f"{each[0]}, {each[1]}" for each in _PAIR.findall(text))]
    if not COORDINATE.fullmatch(text.strip()):
        parts += _SPLIT.split(_IN_BRACKETS.sub(";", text))
    return list(dict.fromkeys(name for each in parts[:MOST_PARTS] if (name := bare(each))))


def bare(name: str) -> str:
    """Return a name as the site's keys are written, without marks around it."""
    return plain_name(name.strip(" .!?\"'"))


def nearest(name: str, site: Site) -> str:
    """Return the known name that is most like an unknown one; "" when none is like it."""
    import difflib  # noqa: PLC0415 - only for a plan that is refused

    names = [each for key, place in site.places.items() for each in (key, *place.aliases)]
    found = difflib.get_close_matches(bare(name), names, n=1, cutoff=0.6)
    return found[0] if found else ""


def outside(place: Place, site: Site) -> str:
    """Return why a point cannot be gone to: outside the fence, or above or below what the site allows; "" if it can."""
    found = off_site(site, place)
    return "" if found is None else found.why


def geographic(place: Place, text: str, site: Site) -> bool:
    """Whether a pair of numbers is a latitude and longitude: near the site's own, with the decimals of degrees."""
    decimals = [len(each.partition(".")[2]) for each in re.findall(r"\d+\.\d+", text)]
    near = abs(place.x - site.latitude_deg) < GEOGRAPHIC_DEG and abs(place.y - site.longitude_deg) < GEOGRAPHIC_DEG
    swapped = abs(place.y - site.latitude_deg) < GEOGRAPHIC_DEG and abs(place.x - site.longitude_deg) < GEOGRAPHIC_DEG
    # A large site has points in metres that are as near: nobody tells a place on Earth to a tenth of a degree.
    return ((near or swapped) and max(decimals, default=0) >= 2) or (len(decimals) >= 2 and min(decimals) >= 4)


def place_problems(subtask: Subtask, site: Site, *, moves: bool = True) -> Iterable[str]:
    """Return what is wrong with where a subtask goes, and with its height and speed, each with a remedy."""
    params = subtask.params
    place = params.get("place")
    if moves and isinstance(place, str) and place:
        yield from _place(place, site)
    for key in ("path", "area", "target", "asset"):
        text = params.get(key)
        if moves and isinstance(text, str):
            for part in parts_of(text):
                found = coordinate(part)
                if found is not None:
                    yield from _point(found, part, site)
    radius = params.get("radius_m")
    around = locate(str(params.get("target", "")), site)
    if _number(radius) and site.fence is not None:
        fence = site.fence
        near = around or Place(x=sum(fence.x) / 2, y=sum(fence.y) / 2)
        edges = [
            (near.x - radius, near.y),
            (near.x + radius, near.y),
            (near.x, near.y - radius),
            (near.x, near.y + radius),
        ]
        if any(outside(Place(x=x, y=y), site) for x, y in edges):
            yield f"a radius of {radius:g} m leads outside the fence {fence.name}: ask for less"
    altitude = params.get("altitude_m")
    if _number(altitude) and altitude > site.altitude_limit_m:
        yield f"altitude {altitude:g} m is above this site's limit of {site.altitude_limit_m:g} m"
    speed = params.get("speed_mps")
    if _number(speed) and speed > site.speed_limit_mps:
        yield f"speed {speed:g} m/s is above this site's limit of {site.speed_limit_mps:g} m/s"


def _place(name: str, site: Site) -> Iterable[str]:
    found = locate(name, site)
    if found is None:
        like = nearest(name, site)
        hint = f"; nearest name: {like}" if like else ""
        known = ", ".join(sorted(site.places)[:12])
        yield f"there is no place {shown(name)} on site {site.name}{hint}: it knows {known}"
        return
    yield from _point(found, name, site)


def _point(found: Place, name: str, site: Site) -> Iterable[str]:
    if coordinate(name) is not None and geographic(found, name, site):
        yield f"place {shown(name)} looks like latitude and longitude: give metres of the site, or a place's name"
    elif coordinate(name) is not None and (why := outside(found, site)):
        yield f"place {shown(name)} {why}: choose a point on the site"
    elif (box := inside(found, site.forbidden)) is not None:
        yield f"place {shown(name)} lies in the forbidden area {box.name}: choose another"
    elif (box := inside(found, site.obstacles)) is not None:
        yield f"place {shown(name)} lies inside {box.name}: choose a free one"


def inside(place: Place, boxes: Sequence[Box]) -> Box | None:
    """Return the first box that a point lies in, or None."""
    for box in boxes:
        if box.x[0] <= place.x <= box.x[1] and box.y[0] <= place.y <= box.y[1]:
            return box
    return None


def _number(value: Any) -> TypeGuard[float]:
    return (
        isinstance(value, int | float)
        and not isinstance(value, bool)
        and math.isfinite(float(value) if abs(value) < 1e15 else math.inf)
    )


def shown(value: Any) -> str:
    """Show a value of unknown size and kind safely; plain names stand without quotes."""
    if isinstance(value, str):
        return value if _PLAIN.fullmatch(value) else ascii(value[:60] + ("..." if len(value) > 60 else ""))
    if value is None or isinstance(value, bool | float) or (isinstance(value, int) and abs(value) <= 10**12):
        return str(value)
    return "a huge number" if isinstance(value, int) else f"a {type(value).__name__}"
