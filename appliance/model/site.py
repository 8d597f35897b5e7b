"""The site: what names of places in instructions mean."""

from msgspec import Struct, field


class Place(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A named place in site coordinates, metres."""

    x: float
    y: float
    z: float = 0.0
    aliases: tuple[str, ...] = ()


class Box(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """An axis-aligned rectangle on the ground, metres: an obstacle or a forbidden area."""

    name: str
    x: tuple[float, float]
    y: tuple[float, float]


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

    def find(self, name: str) -> Place | None:
        """Return the place of that name or alias (case and articles ignored), or None."""
        wanted = " ".join(word for word in name.lower().replace("_", " ").split() if word not in ("the", "a", "an"))
        for key, place in self.places.items():
            if wanted == key or wanted in place.aliases:
                return place
        return None
