"""What one command does next on the floor: ask for a way, wait, give way. Pure; `keeper` carries it out."""

import math
from collections.abc import Mapping
from typing import Any

from msgspec.structs import replace

from appliance.floor import geometry
from appliance.floor.decide import PATIENCE_S, YIELD_S, Body, Floor, Go, Trip, Wait, next_ticket, threat
from appliance.model.floor import MOST_POINTS, FloorState, Point

BEHIND_M = 0.3
"""How much of the way behind a robot stays reserved."""
LOOK_S, LOOK_M = 1.5, 0.5
"""A robot looks so far ahead for what has no reservation."""
_STILL_M = 0.02
DETOUR_S = 4.0
"""How often a robot that waits for others to pass looks for a way round them."""


class Mover:
    """One command of one robot."""

    def __init__(self, floor: Floor, trip: Trip) -> None:
        self.trip = trip
        self.go: Go | None = None
        """The way that it has reserved and is on."""
        self.wait: Wait | None = None
        """What it waits for."""
        self.place = ""
        """The place that it goes, or went, to."""
        self.stuck = False
        self._floor = floor
        self._leg = 0
        self.since: float | None = None
        """When it began to wait."""
        self._before: Point | None = None
        self._avoid: tuple[str, ...] = ()
        self.looked = -DETOUR_S
        """When it looked for a way round others last."""
        self._decided: dict[tuple[Any, ...], Go | Wait] = {}
        """Decisions on what is seen at present: a search for a way takes tens of milliseconds."""
        self._seen: tuple[Any, ...] = ()

    # --- before it goes ---------------------------------------------------------------------------------------

    def begin(self) -> None:
        """Look at it anew: what was in the way may have gone."""
        self._avoid = ()

    def ask(self, bodies: Mapping[str, Body], now: float) -> Go | Wait:
        """Return the way to reserve, or whom it waits for; `now` in seconds."""
        seen = _signature(self.trip, bodies, self._avoid)
        decided = self._decided.get(seen)
        if decided is None:
            if seen[1:] != self._seen:
                self._decided.clear()
            self._seen = seen[1:]
            decided = self._decided[seen] = self._floor.decide(self.trip, bodies, self._avoid)
        return decided if isinstance(decided, Go) else self._waits(decided, bodies, now)

    def refused(
        self, go: Go, holder: str, part: str, bodies: Mapping[str, Body], now: float, *, ended: bool
    ) -> Go | Wait | None:
        """Return what follows when another has a part of the way; None: ask again for a way round it."""
        nearer = self._floor.up_to(go, part, self.trip, bodies)
        if nearer is not None:
            return nearer
        wait = self._floor.refused(go, holder, part, bodies, ended=ended)
        again = not (go.yields or self.trip.fixed or wait.in_line or self._avoid) and holder in bodies
        if again and now - self.looked >= DETOUR_S:
            self._avoid, self.looked = (holder,), now
            return None
        return self._waits(wait, bodies, now, may_yield=not go.yields)

    def _waits(self, wait: Wait, bodies: Mapping[str, Body], now: float, *, may_yield: bool = True) -> Go | Wait:
        since = self.since = now if self.since is None else self.since
        if not self.trip.ticket:
            self.trip = replace(self.trip, ticket=next_ticket(bodies.values()))
        self.wait = wait
        yields = may_yield and not self.trip.fixed and now - since >= YIELD_S
        if yields and self._floor.gives_way(self.trip, wait, bodies):
            refuge = next(iter(self._floor.refuges(self.trip, bodies)), None)
            self.stuck = refuge is None
            return refuge or wait
        return wait

    # --- on its way -------------------------------------------------------------------------------------------

    def started(self, go: Go) -> None:
        """Note that it has a way reserved, and goes."""
        self.go, self.wait, self.stuck, self._leg, self.place = go, None, False, 0, go.place
        if go.ends:
            self.since = None

    def stopped(self, at: Point) -> None:
        """Note that it was stopped on its way: it goes on from there."""
        if self.go is not None and not self.go.yields and not self.trip.fixed:
            left = self.rest(at)[1:]
            # The end of a stretch is no point of the trip.
            self.goes_on((*left[:-1], *self.go.wants) if self.go.wants else left)
        self.go = None

    def arrived(self) -> None:
        """Note that it is at the end of its way, or of a stretch."""
        if self.go is not None and self.go.wants:
            self.goes_on(self.go.wants)
        self.go = None

    def goes_on(self, wants: tuple[Point, ...]) -> None:
        """Note that it has the way behind it that comes before these points."""
        self.trip = replace(self.trip, points=(*wants[:-1], self.trip.points[-1]))

    def rest(self, at: Point) -> tuple[Point, ...]:
        """Return what is left of its way."""
        if self.go is None:
            return (at,)
        self._leg, left = geometry.rest(self.go.way, at[:2], self._leg, BEHIND_M)
        return left

    def parts(self, body: Body) -> frozenset[str]:
        """Return what it still needs."""
        if self.go is None:
            return geometry.cells((body.at,), body.size)
        behind = geometry.length(self.go.way) - geometry.length(self.rest(body.at))
        left = [cells for end, cells in self.go.sweep if end >= behind - 1e-6]
        places = frozenset(part for part in self.go.parts if part.startswith("place/"))
        return places.union(geometry.cells((body.at,), body.size), *left)

    def threat(self, body: Body, bodies: Mapping[str, Body]) -> Body | None:
        """Return a robot that it would come too near to if it went on."""
        if self.trip.reach_m:
            return self._ahead(body, bodies)
        left = self.rest(body.at)
        start = (body.at, *left[1:]) if len(left) > 1 else (body.at,)
        stretch = geometry.ahead(start, LOOK_M + LOOK_S * body.speed_mps)
        return threat(stretch, body, bodies.values())

    def _ahead(self, body: Body, bodies: Mapping[str, Body]) -> Body | None:
        """Return a robot that one without a goal would come too near to if it went on as it does."""
        before, self._before = self._before, body.at
        gone = math.dist(before, body.at) if before is not None else 0.0
        if before is None or gone < _STILL_M:
            return None
        look = (LOOK_M + LOOK_S * body.speed_mps) / gone
        x, y, z = (here + look * (here - there) for here, there in zip(body.at, before, strict=True))
        others = (each for each in bodies.values() if each.robot != self.trip.beside)
        return threat((body.at, (x, y, z)), body, others)

    def state(self, gateway: str, command: str, now: float) -> FloorState:
        """Return what others are told."""
        trip, wait, go = self.trip, self.wait, self.go
        way = go.way if go is not None else wait.way if wait is not None else ()
        return FloorState(
            robot=trip.robot,
            gateway=gateway,
            task=trip.task,
            command=command,
            state="moves" if go is not None else "waits" if wait is not None else "stands",
            place=go.place if go is not None else wait.place if wait is not None else "",
            way=way[:MOST_POINTS],
            wants=go.wants[:MOST_POINTS] if go is not None else (),
            waits_for=wait.robot if wait is not None and go is None else "",
            why=wait.why if wait is not None and go is None else "",
            ticket=trip.ticket,
            waited_s=round(now - self.since, 1) if self.since is not None and go is None else 0.0,
            in_line=wait is not None and wait.in_line,
            stuck=self.stuck,
        )


def _signature(trip: Trip, bodies: Mapping[str, Body], avoid: tuple[str, ...]) -> tuple[Any, ...]:
    """Return all that a decision rests on: the position of a robot that keeps to a reserved way is no part of it."""
    seen = [
        (
            each.robot,
            None if each.moved and each.robot != trip.robot else tuple(round(value, 1) for value in each.at),
            each.stands,
            each.fresh,
            each.state.state if each.state is not None else "",
            (each.bound, each.state.wants) if each.bound and each.state is not None else (),
            (
                waiting.place,
                waiting.ticket,
                waiting.in_line,
                waiting.waits_for,
                waiting.way,
                waiting.waited_s >= PATIENCE_S,
            )
            if (waiting := each.waiting)
            else (),
        )
        for each in bodies.values()
    ]
    return avoid, trip, tuple(seen)
