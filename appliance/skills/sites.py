"""Sites: the maps that give names in instructions a meaning, read strictly from TOML.

Why it exists: a place that is mistyped in a site file would otherwise show up as a robot that drives to the
wrong spot. So names, aliases and coordinates are checked before anything moves.
"""

import math
import re
import tomllib
from itertools import combinations
from pathlib import Path
from typing import Any, cast

import msgspec
import tomli_w

from appliance.errors import ConfigError
from appliance.model import Aisle, Box, Device, Door, Person, Place, Site, SiteObject
from appliance.model.site import inside
from appliance.skills.catalogue import SKILLS, convert

SITES = SKILLS / "sites"
"""The sites that come with the product."""

_REMEDY = "see docs/skills.md, Sites"
_BUILT_IN = re.compile(r"[a-z][a-z0-9_-]*")


def load_site(where: str | Path) -> Site:
    """Load a site: the name of one that comes with the product, or the path of a TOML file.

    Raises:
        ConfigError: naming the file and the key; unknown keys, wrong types, names that two places share,
            boxes without extent and objects at places that are not there are all refused.
    """
    built_in = isinstance(where, str) and _BUILT_IN.fullmatch(where) is not None
    file = SITES / f"{where}.toml" if built_in else Path(where)
    if not file.is_file():
        known = ", ".join(sorted(each.stem for each in SITES.glob("*.toml")))
        raise ConfigError(f"there is no site {str(where)!r}", remedy=f"give a TOML file, or one of: {known}")
    try:
        table = tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(f"{file}: cannot be read: {error}", remedy="mend the TOML there") from error
    _check_keys(file, table)
    site = convert(file, table, Site, rows={"places": Place})
    _check_places(file, site)
    _check_things(file, site)
    return site


def differs(where: str | Path, site: Site) -> str:
    """Return how a site's file differs from the site that was loaded of it; empty: it does not."""
    try:
        found = load_site(where)
    except ConfigError as error:
        return f"the site's file cannot be loaded any more ({error.message}): the site from before is used"
    return "" if found == site else "the site's file has changed: the site from before is used until a restart"


def site_text(site: Site) -> str:
    """Return a site as a TOML file has it."""
    return tomli_w.dumps(msgspec.to_builtins(site))


def plain_name(name: str) -> str:
    """Return a name as instructions and sites compare it: lower case, single spaces, no articles."""
    return " ".join(word for word in name.lower().replace("_", " ").split() if word not in ("the", "a", "an"))


_LISTS: tuple[tuple[str, type[msgspec.Struct]], ...] = (
    ("obstacles", Box),
    ("forbidden", Box),
    ("aisles", Aisle),
    ("objects", SiteObject),
    ("doors", Door),
    ("devices", Device),
    ("people", Person),
)


def _check_keys(file: Path, table: dict[str, Any]) -> None:
    """Refuse keys that no struct has; the structs themselves are lenient, for the wire's sake."""
    rows: list[tuple[str, Any, type[msgspec.Struct]]] = [("", table, Site)]
    places = table.get("places")
    if isinstance(places, dict):
        rows += [(f"places.{name}.", row, Place) for name, row in cast("dict[str, Any]", places).items()]
    if isinstance(table.get("fence"), dict):
        rows.append(("fence.", table["fence"], Box))
    for key, kind in _LISTS:
        many = table.get(key)
        if isinstance(many, list):
            rows += [(f"{key}[{index}].", row, kind) for index, row in enumerate(cast("list[Any]", many))]
    for at, row, kind in rows:
        if isinstance(row, dict):
            for key in cast("dict[str, Any]", row):
                if key not in kind.__struct_fields__:
                    raise _wrong(file, f"{at}{key}", "unknown key")


def _check_places(file: Path, site: Site) -> None:
    if not site.places:
        raise _wrong(file, "places", "a site needs at least one place")
    owner: dict[str, str] = {}
    for name, place in site.places.items():
        for key, each in ((f"places.{name}", name), *((f"places.{name}.aliases", alias) for alias in place.aliases)):
            if not each or each != plain_name(each):
                raise _wrong(file, key, f"{each!r} is not plain: lower case, single spaces, no article")
            if owner.setdefault(each, name) != name:
                raise _wrong(file, key, f"{each!r} means {owner[each]!r} too")
        for axis, value in (("x", place.x), ("y", place.y), ("z", place.z)):
            if not math.isfinite(value):
                raise _wrong(file, f"places.{name}.{axis}", f"{value} is no coordinate")
        if place.capacity is not None and not 1 <= place.capacity <= 16:
            raise _wrong(file, f"places.{name}.capacity", f"{place.capacity} is not between 1 and 16")
        if not 0 <= place.z <= site.altitude_limit_m:
            raise _wrong(file, f"places.{name}.z", f"{place.z} m is not between 0 and altitude_limit_m")
        if site.fence is not None and not inside(site.fence, place.x, place.y, 1e-6):
            raise _wrong(file, f"places.{name}", f"lies outside {site.fence.name!r}, which no robot may leave")
        for box in (*site.obstacles, *site.forbidden, *site.doors):
            if box.x[0] < place.x < box.x[1] and box.y[0] < place.y < box.y[1]:
                raise _wrong(file, f"places.{name}", f"lies inside {box.name!r}, where no robot may go")


def _check_things(file: Path, site: Site) -> None:
    for key, value in (("altitude_limit_m", site.altitude_limit_m), ("speed_limit_mps", site.speed_limit_mps)):
        if not (math.isfinite(value) and value > 0):
            raise _wrong(file, key, f"{value} is not more than 0")
    if not (-90 <= site.latitude_deg <= 90 and -180 <= site.longitude_deg <= 180):
        raise _wrong(file, "latitude_deg", f"{site.latitude_deg}, {site.longitude_deg} is nowhere on Earth")
    fence = () if site.fence is None else (site.fence,)
    for key, boxes in (
        ("obstacles", site.obstacles),
        ("forbidden", site.forbidden),
        ("aisles", site.aisles),
        ("doors", site.doors),
        ("fence", fence),
    ):
        for index, box in enumerate(boxes):
            for axis, (low, high) in (("x", box.x), ("y", box.y)):
                if not (math.isfinite(low) and math.isfinite(high) and low < high):
                    raise _wrong(file, f"{key}[{index}].{axis}", f"{box.name!r}: [{low}, {high}] is no extent")
    _check_aisles(file, site)
    names: set[str] = set()
    for index, thing in enumerate(site.objects):
        if thing.name in names:
            raise _wrong(file, f"objects[{index}].name", f"there are two of {thing.name!r}")
        names.add(thing.name)
        if site.find(thing.at) is None:
            raise _wrong(file, f"objects[{index}].at", f"there is no place {thing.at!r}")
        if not 0 < thing.size <= 10:
            raise _wrong(file, f"objects[{index}].size", f"{thing.size} m is not a size of 0 to 10 m")
    for key, each in (*(("devices", each) for each in site.devices), *(("people", each) for each in site.people)):
        if site.find(each.at) is None:
            raise _wrong(file, f"{key}.{each.name}.at", f"there is no place {each.at!r}")
    for key, each in (*(("doors", each) for each in site.doors), *(("devices", each) for each in site.devices)):
        if each.name in names:
            raise _wrong(file, f"{key}.{each.name}", "something else has that name")
        names.add(each.name)


def _check_aisles(file: Path, site: Site) -> None:
    opposite = {"north": "south", "south": "north", "east": "west", "west": "east"}
    for (first, one), (second, other) in combinations(enumerate(site.aisles), 2):
        if one.name == other.name:
            raise _wrong(file, f"aisles[{second}].name", f"there are two of {one.name!r}")
        shared = all(max(a[0], b[0]) < min(a[1], b[1]) for a, b in ((one.x, other.x), (one.y, other.y)))
        if shared and other.one_way == opposite[one.one_way]:
            what = f"{other.name!r} overlaps {one.name!r} (aisles[{first}]), which goes the other way"
            raise _wrong(file, f"aisles[{second}]", f"{what}: draw two lanes side by side")


def _wrong(file: Path, key: str, what: str) -> ConfigError:
    return ConfigError(f"{file}: {key}: {what}", remedy=_REMEDY)
