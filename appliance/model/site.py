"""The site: what names of places in instructions mean, and its metres on the globe.

Vehicles think in latitude and longitude, plans in x and y. Between them: a local tangent plane at the site's origin
on the WGS 84 ellipsoid: metres east from the prime vertical radius of curvature N, metres north from the meridian
radius M (standard geodesy, e.g. Groves, Principles of GNSS, 2.4). Within 10 km of the origin the error of the flat
plane is below 1e-3 of the distance, far under what GPS gives. Pure functions; angles in degrees at the door, metres
everywhere.
"""

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

from msgspec import Struct, field


class Place(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A named place in site coordinates, metres."""

    x: float
    y: float
    z: float = 0.0
    aliases: tuple[str, ...] = ()
    capacity: int | None = None
    """How many robots may be there at a time, 1 to 16; None: 1 at docks, shelves, chargers and landing pads, 4
    elsewhere."""


class Box(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """An axis-aligned rectangle on the ground, metres: an obstacle or a forbidden area."""

    name: str
    x: tuple[float, float]
    y: tuple[float, float]


class Aisle(Box, frozen=True, kw_only=True, omit_defaults=True):
    """An aisle, or a lane of one, that robots on the ground go along in one direction only; across it is free."""

    one_way: Literal["north", "east", "south", "west"]


class SiteObject(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A thing that the simulated world holds: colour name, size in metres, where it is at first."""

    name: str
    colour: str
    at: str
    size: float = 0.4


class Door(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A door of the simulated world: shut it is an obstacle of that extent, metres."""

    name: str
    x: tuple[float, float]
    y: tuple[float, float]
    open: bool = False


class Device(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A light, pump or machine of the simulated world that is switched at a place."""

    name: str
    at: str
    on: bool = False


class Person(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Somebody in the simulated world who answers when a robot near by asks.

    `answers` maps words to what is said when all of them are in the question; the entry with most words wins, and an
    entry with the empty key answers all else.
    """

    name: str
    at: str
    answers: dict[str, str] = field(default_factory=dict[str, str])
    delay_s: float = 2.0
    """Time to think, simulated seconds."""


class Site(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The map of a site: places by name (lower case), obstacles, forbidden areas, and its geographic origin."""

    name: str = "site"
    latitude_deg: float = 47.397742
    longitude_deg: float = 8.545594
    altitude_m: float = 488.0
    places: dict[str, Place] = field(default_factory=dict[str, Place])
    obstacles: tuple[Box, ...] = ()
    forbidden: tuple[Box, ...] = ()
    aisles: tuple[Aisle, ...] = ()
    """One-way aisles and lanes."""
    objects: tuple[SiteObject, ...] = ()
    altitude_limit_m: float = 60.0
    speed_limit_mps: float = 8.0
    fence: Box | None = None
    """The area that no robot may leave; none: only the forbidden areas bind."""
    doors: tuple[Door, ...] = ()
    """Doors of the simulated world."""
    devices: tuple[Device, ...] = ()
    """What can be switched in the simulated world."""
    people: tuple[Person, ...] = ()
    """People of the simulated world."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of places and their aliases, objects, doors, devices and people."""
        places = [name for key, place in self.places.items() for name in (key, *place.aliases)]
        things = (*self.objects, *self.doors, *self.devices, *self.people)
        return (*places, *(each.name for each in things))

    @property
    def chargers(self) -> dict[str, Place]:
        """The places where robots charge: by a word of their name or aliases."""
        return {
            name: place
            for name, place in self.places.items()
            if any("charg" in each.casefold() for each in (name, *place.aliases))
        }

    def find(self, name: str) -> Place | None:
        """Return the place of that name or alias (case and articles ignored), or None."""
        wanted = " ".join(word for word in name.lower().replace("_", " ").split() if word not in ("the", "a", "an"))
        for key, place in self.places.items():
            if wanted == key or wanted in place.aliases:
                return place
        return None


_A = 6_378_137.0  # WGS 84 semi-major axis, metres
_E2 = 6.694_379_990_14e-3  # first eccentricity squared
MAX_EXTENT_M = 10_000.0
"""Beyond this from the origin a point is no point of the site."""


FAR_M = 200.0
"""Without a fence a coordinate further than this from all mapped places is taken for a mistake, as the skills do."""


class OffSite(NamedTuple):
    """Why a point is none of the site: along which axis it leaves it, and a clause such as `lies outside the fence`."""

    axis: Literal["x", "y", "z"]
    why: str


def off_site(site: Site, place: Place) -> OffSite | None:
    """Return why a point cannot be gone to: outside the fence, above the altitude limit, underground; None if it can.

    Plans and uploaded missions are both held to this, so that what one accepts the other does not refuse.
    """
    if (beyond := _beyond(site, place)) is not None:
        return beyond
    why = off_height(site, place.z)
    return OffSite("z", why) if why else None


def off_height(site: Site, z: float) -> str:
    """Return why a height over the site's ground, metres, is none that a robot may be sent to; "" if it is one."""
    if z > site.altitude_limit_m:
        return f"is {z:g} m up, above this site's limit of {site.altitude_limit_m:g} m"
    if z < 0:
        return f"is {-z:g} m under the ground"
    return ""


def _beyond(site: Site, place: Place) -> OffSite | None:
    fence = site.fence
    if fence is not None:
        inside_x = fence.x[0] <= place.x <= fence.x[1]
        if inside_x and fence.y[0] <= place.y <= fence.y[1]:
            return None
        extent = f"(x {fence.x[0]:g} to {fence.x[1]:g} m, y {fence.y[0]:g} to {fence.y[1]:g} m)"
        return OffSite("y" if inside_x else "x", f"lies outside the fence {fence.name} {extent}")
    for axis, at, mapped in (
        ("x", place.x, [each.x for each in site.places.values()] or [0.0]),
        ("y", place.y, [each.y for each in site.places.values()] or [0.0]),
    ):
        if not min(mapped) - FAR_M <= at <= max(mapped) + FAR_M:
            return OffSite("x" if axis == "x" else "y", f"lies more than {FAR_M:g} m outside the site")
    return None


def _metres_per_degree(latitude_deg: float, altitude_m: float) -> tuple[float, float]:
    latitude = math.radians(latitude_deg)
    root = math.sqrt(1.0 - _E2 * math.sin(latitude) ** 2)
    meridian = _A * (1.0 - _E2) / root**3
    prime_vertical = _A / root
    per_latitude = math.radians(1.0) * (meridian + altitude_m)
    per_longitude = math.radians(1.0) * (prime_vertical + altitude_m) * math.cos(latitude)
    return per_latitude, per_longitude


def to_globe(site: Site, x: float, y: float, z: float = 0.0) -> tuple[float, float, float]:
    """Return latitude and longitude in degrees and altitude in metres above mean sea level of a site point."""
    per_latitude, per_longitude = _metres_per_degree(site.latitude_deg, site.altitude_m)
    longitude = (site.longitude_deg + x / per_longitude + 180.0) % 360.0 - 180.0
    return site.latitude_deg + y / per_latitude, longitude, site.altitude_m + z


def to_site(site: Site, latitude_deg: float, longitude_deg: float, altitude_m: float) -> tuple[float, float, float]:
    """Return x (east), y (north), z (up) in metres from the site's origin; inverse of `to_globe`."""
    per_latitude, per_longitude = _metres_per_degree(site.latitude_deg, site.altitude_m)
    # The shorter way round, so that a site on the date line is one site.
    east_deg = (longitude_deg - site.longitude_deg + 180.0) % 360.0 - 180.0
    return east_deg * per_longitude, (latitude_deg - site.latitude_deg) * per_latitude, altitude_m - site.altitude_m


def bearing_deg(x: float, y: float) -> float:
    """Return the compass bearing of the vector (x east, y north): 0 north, 90 east, below 360."""
    return math.degrees(math.atan2(x, y)) % 360.0


def turn_deg(current: float, wanted: float) -> float:
    """Return the smallest turn from one heading to another, -180 to 180, clockwise positive."""
    return (wanted - current + 180.0) % 360.0 - 180.0


def inside(box: Box, x: float, y: float, margin: float = 0.0) -> bool:
    """Tell whether a point lies in a box grown by `margin` metres (negative: shrunk)."""
    return box.x[0] - margin < x < box.x[1] + margin and box.y[0] - margin < y < box.y[1] + margin


def core(box: Box, rim_m: float) -> Box:
    """Return a box without a rim of `rim_m` metres; of a narrow one the middle half of its width is kept.

    So an edge may be grazed, and yet no wall is so thin that nothing of it is in the way.
    """

    def middle(low: float, high: float) -> tuple[float, float]:
        rim = min(rim_m, (high - low) / 4)
        return low + rim, high - rim

    return Box(name=box.name, x=middle(*box.x), y=middle(*box.y))


GRAZE_M = 0.05
"""The edge of a box may be grazed by so much, so that a planner that keeps to the edge is not refused."""


def crosses(box: Box, start: tuple[float, float], end: tuple[float, float], rim_m: float = GRAZE_M) -> bool:
    """Tell whether a straight leg meets the `core` of a box, its edge included (Liang-Barsky clipping; exact)."""
    within = core(box, rim_m)
    low, high = 0.0, 1.0
    for begin, stop, (near, far) in ((start[0], end[0], within.x), (start[1], end[1], within.y)):
        length = stop - begin
        if abs(length) < 1e-9:
            if not near <= begin <= far:
                return False
            continue
        one, other = (near - begin) / length, (far - begin) / length
        low, high = max(low, min(one, other)), min(high, max(one, other))
        if low > high:
            return False
    return True


def rings(box: Box, centre: tuple[float, float], radius_m: float, rim_m: float = GRAZE_M) -> bool:
    """Tell whether a circle passes through the `core` of a box: its nearest point is nearer, its farthest farther."""
    within = core(box, rim_m)
    gaps = [(low - at, at - high) for at, (low, high) in zip(centre, (within.x, within.y), strict=True)]
    nearest = math.hypot(*(max(*gap, 0.0) for gap in gaps))
    farthest = math.hypot(*(max(abs(gap[0]), abs(gap[1])) for gap in gaps))
    return nearest <= radius_m <= farthest


def blocked_leg(
    boxes: Sequence[Box], start: tuple[float, float], points: Sequence[tuple[float, float]]
) -> tuple[int, Box] | None:
    """Return index and box of the first leg through a box, None when the way is free.

    A box that holds the start is left out until the way has left it: a robot that stands in one must be able to
    drive out of it, and may not come back.
    """
    around: set[int] = {index for index, box in enumerate(boxes) if inside(box, *start)}
    here = start
    for leg, point in enumerate(points):
        for index, box in enumerate(boxes):
            if index not in around and crosses(box, here, point):
                return leg, box
        around -= {index for index in around if not inside(boxes[index], *point)}
        here = point
    return None
