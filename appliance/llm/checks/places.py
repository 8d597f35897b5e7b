"""All names of a place that a text names: whoever forbids one of them means the place, however it is called. Pure."""

import math
import re

from appliance.llm.checks.schema import locate
from appliance.model import Place, Site
from appliance.skills.sites import plain_name

SAME_SPOT_M = 1.0
"""A coordinate as near as this to a place is that place: a robot that stands there is in its way."""
MOST_PARTS = 64
_NUMBER = r"[-+]?\d{1,6}(?:\.\d+)?"
_COORDINATE = re.compile(
    rf"\(?\s*x?\s*=?\s*({_NUMBER})\s*[,; ]\s*y?\s*=?\s*({_NUMBER})(?:\s*[,; ]\s*z?\s*=?\s*({_NUMBER}))?\s*\)?"
)
_IN_BRACKETS = re.compile(r"\([^()]*\)")
_SPLIT = re.compile(r"[,;]|->|→|\b(?:then|and|via|to|from)\b")
"""What stands between the places of a route, as the skills read it."""


def spot_of(name: str, site: Site | None) -> Place | None:
    """Return the place or coordinate that a text names, read as leniently as the skills do."""
    if match := _COORDINATE.fullmatch(name.strip()):
        return Place(x=float(match[1]), y=float(match[2]), z=float(match[3] or 0.0))
    return None if site is None else locate(_bare(name), site)


def known_as(name: str, site: Site | None) -> tuple[str, ...]:
    """Return all names of the place that a text names: its key on the site first, its aliases, the text itself.

    A coordinate has the names of the places within `SAME_SPOT_M`, the nearest first. A text that names no place of the
    site has itself alone.
    """
    own = _bare(name)
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
    parts = [text, *_IN_BRACKETS.findall(text)]
    if not _COORDINATE.fullmatch(text.strip()):
        parts += _SPLIT.split(_IN_BRACKETS.sub(";", text))
    return list(dict.fromkeys(name for each in parts[:MOST_PARTS] if (name := _bare(each))))


def _bare(name: str) -> str:
    return plain_name(name.strip(" .!?\"'"))
