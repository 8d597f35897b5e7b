"""The floor's decisions for the log: which way a robot asked for, or what it waited for, with all that it rested on.

A case is one look at the floor: the robots as they were seen, the map, and who refused what on the way to the decision.
`way_again` makes it again from that alone. What those who grant answered is in cases of their own
(`plane.leases.GrantCase`).
"""

import hashlib
from collections.abc import Iterable, Sequence
from typing import Any

from msgspec import Struct
from msgspec.structs import replace

from appliance.floor.decide import Body, Floor, Go, Trip, Wait
from appliance.floor.mover import Mover
from appliance.model import Site
from appliance.model.floor import Point

NAME = "way"
"""Under which they are put: `gw/{gateway}/decided/way`."""


class Refusal(Struct, frozen=True):
    """Who has a part that was asked for."""

    holder: str
    part: str
    ended: bool
    """Whether its lease has ended."""


class WayCase(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One look at the floor and what came of it, put as `gw/{gateway}/decided/way`."""

    task: str
    trip: Trip
    now: float
    """Seconds of the gateway's own clock."""
    since: float | None = None
    """When the robot began to wait."""
    looked: float
    """When it looked for a way round others last."""
    site: Site
    """The map, without what the floor does not look at."""
    bodies: tuple[Body, ...]
    refusals: tuple[Refusal, ...] = ()
    way: tuple[Point, ...] = ()
    """The way that was reserved, or is wanted; metres."""
    wants: tuple[Point, ...] = ()
    yields: bool = False
    parts: str = ""
    """How many parts were reserved, and their digest."""
    waits_for: str = ""
    why: str = ""
    """What it waits for, in words; empty: it goes."""


def map_of(site: Site) -> Site:
    """Return a site without what the floor does not look at."""
    places = {name: replace(place, aliases=()) for name, place in site.places.items()}
    return replace(site, places=places, objects=(), doors=(), devices=(), people=())


def begun(mover: Mover, site: Site, bodies: Iterable[Body], now: float) -> WayCase:
    """Return what a decision will rest on; `site` by `map_of`."""
    return WayCase(
        task=mover.trip.task,
        trip=mover.trip,
        now=now,
        since=mover.since,
        looked=mover.looked,
        site=site,
        bodies=tuple(bodies),
    )


def decided(case: WayCase, step: Go | Wait, refusals: Sequence[Refusal]) -> WayCase:
    """Return a case with what came of it."""
    return replace(case, refusals=tuple(refusals), **_outcome(step))


def way_again(case: WayCase) -> dict[str, Any] | None:
    """Decide again; the decision by the fields of the case, None when the robot itself is not in it."""
    mover = Mover(Floor(case.site), case.trip)
    mover.since, mover.looked = case.since, case.looked
    bodies = {each.robot: each for each in case.bodies}
    if case.trip.robot not in bodies:
        return None
    step: Go | Wait = mover.ask(bodies, case.now)
    for refusal in case.refusals:
        if isinstance(step, Wait):
            break  # it asks for nothing now
        after = mover.refused(step, refusal.holder, refusal.part, bodies, case.now, ended=refusal.ended)
        step = after or mover.ask(bodies, case.now)
    return _outcome(step)


def _outcome(step: Go | Wait) -> dict[str, Any]:
    if isinstance(step, Wait):
        return {"way": _rounded(step.way), "wants": (), "yields": False, "parts": "", "waits_for": step.robot,
                "why": step.why}  # fmt: skip
    digest = hashlib.blake2b(" ".join(sorted(step.parts)).encode(), digest_size=6).hexdigest()
    return {"way": _rounded(step.way), "wants": _rounded(step.wants), "yields": step.yields,
            "parts": f"{len(step.parts)} {digest}", "waits_for": "", "why": ""}  # fmt: skip


def _rounded(way: Iterable[Point]) -> tuple[Point, ...]:
    return tuple((round(x, 3), round(y, 3), round(z, 3)) for x, y, z in way)
