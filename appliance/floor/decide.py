"""Decides whether a robot may go, by which way, or whom it waits for. Pure: what is seen comes in, decisions go out.

Rules, in the order in which they are looked at:

1. A place takes as many robots as its capacity says. Where one is there or on its way, the next ones wait; who has the
   lower ticket goes first. Robots of one task may share a place, side by side: its plan has ordered them.
2. A robot that stands keeps the ground under it, whether it has a task or not. Ways lead round it where there is room.
   One that moves without a reservation (by hand, by a pilot, unknown) has the ground that it can reach in `HAND_S` too.
   One that is lost keeps what was left of its way too, until it is heard again or forgotten.
3. A way is reserved before its robot moves, and freed behind it (`geometry.cells`). Where others move or want to on it,
   it is cut into stretches: each ends where the robot blocks no other's way, about `STRETCH_M` further on or behind
   what it would block, and is reserved as a whole, so that a robot never stops in an aisle that another wants to pass.
   Who is refused goes up to the part that another has, or looks for a way round the one that has it, or waits. The way
   of the one that has waited longest of all, for `PATIENCE_S` or more, is reserved by no other any more.
4. A robot that waits and stands in the way of another that waits for it gives way: it goes to the nearest spot that is
   in nobody's way. Where they wait for one another, in a ring of any length, only the one with the highest ticket does,
   of those that have such a spot.
"""

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import pairwise

from msgspec import Struct
from msgspec.structs import replace

from appliance.floor import geometry
from appliance.floor.geometry import Flat, Size
from appliance.model import Box, Site
from appliance.model.floor import FloorState, Point
from appliance.model.site import Place
from appliance.skills._lib import paths

PLACE_M = 1.0
"""A robot that stands so near to a place is at it."""
SIDE_M = 2.0
"""The same where several stand side by side."""
OUTSIDE_M = 5.0
"""So broad is what lies outside of the fence, to a search for a way: broader than its grid's border."""
PATIENCE_S = 60.0
"""After so long the way that a robot waits for is kept free of others that began to wait later."""
HAND_S = 2.0
"""How long a robot that nobody here moves is expected to go on as it does."""
APART_M = 0.1
"""Between robots side by side, beside their margins."""
DETOUR, DETOUR_M = 1.6, 4.0
"""A way round a robot that moves is taken when it is at most so many times, and metres, longer."""
LOST_M = 3.0
"""A robot that was lost on its way may still have so much reserved behind it."""
STRETCH_M = 10.0
"""So much of a way is reserved at a time, where a robot can stop so early without blocking another."""
SHORTEST_M = 2.0
"""A robot does not set off for less, nor stop for less before the end."""
YIELD_S = 2.0
"""How long robots stand in each other's way before one gives way."""
REFUGE_M = 14.0
"""How far a robot goes to give way."""
_REFUGES = 24
"""Spots that are looked at, the nearest first."""
_SINGLE = ("dock", "bay", "shelf", "charger", "charging", "helipad", "pad", "landing")
SEVERAL = 4
"""Robots at a place of which nothing says how many it takes, and that is none of those for one."""


class Body(Struct, frozen=True, kw_only=True):
    """A robot as it is seen."""

    robot: str
    at: Point
    size: Size
    speed_mps: float = 0.0
    stands: bool = True
    """It has not moved for a while; or nothing is heard of it, and that is where it was last."""
    fresh: bool = True
    """Whether it is heard."""
    state: FloorState | None = None
    """What the gateway says that moves it; None: nobody says anything."""

    @property
    def moved(self) -> bool:
        """Whether a run moves it under a reservation."""
        return self.state is not None and self.state.state == "moves"

    @property
    def lost(self) -> bool:
        """Whether it is not heard, and no gateway says that it moves it."""
        return not self.fresh and not self.moved

    @property
    def bound(self) -> tuple[Point, ...]:
        """The way that it has reserved, also when it was lost on it."""
        state = self.state
        return state.way if state is not None and state.state != "waits" and (self.moved or self.lost) else ()

    @property
    def waiting(self) -> FloorState | None:
        """What it waits for."""
        return self.state if self.state is not None and self.state.state == "waits" else None


class Trip(Struct, frozen=True, kw_only=True):
    """Where a command moves a robot."""

    robot: str
    task: str
    command: str
    points: tuple[Point, ...]
    """Without where it is."""
    flies: bool = False
    fixed: bool = False
    """Whether the robot follows just these points: they cannot be changed."""
    reach_m: float = 0.0
    """It has no goal: what it can reach around it is reserved, again and again."""
    beside: str = ""
    """The robot that it follows."""
    ticket: int = 0


class Go(Struct, frozen=True, kw_only=True):
    """Reserve these parts, then go this way, whose first point is where the robot is."""

    way: tuple[Point, ...]
    parts: frozenset[str]
    sweep: tuple[tuple[float, frozenset[str]], ...] = ()
    """The cells piece by piece (`geometry.sweep`)."""
    place: str = ""
    yields: bool = False
    """It gives way: the way does not end where the command ends."""
    wants: tuple[Point, ...] = ()
    """Where the robot goes on to: the way is one stretch only."""

    @property
    def ends(self) -> bool:
        """Whether the way ends where the command ends."""
        return not self.yields and not self.wants


class Wait(Struct, frozen=True, kw_only=True):
    """Wait, and say why."""

    robot: str
    """Whose leaving it waits for; empty: nobody's."""
    why: str
    place: str = ""
    way: tuple[Point, ...] = ()
    """The way that it wants."""
    in_line: bool = False
    """It waits for the place itself."""


class Floor:
    """The map, and how many robots its places take."""

    def __init__(self, site: Site) -> None:
        self.site = site
        self.capacity = {name: place.capacity or usual_capacity(name, place) for name, place in site.places.items()}
        outside = _outside(site.fence) if site.fence is not None else ()
        self._closed = [*outside, *(_rectangle(box) for box in (*site.forbidden, *site.obstacles))]
        self._forbidden = [*outside, *(_rectangle(box) for box in site.forbidden)]
        self._aisles = [paths.OneWay(_rectangle(each), each.one_way) for each in site.aisles]

    def problems(self, radius_m: float) -> tuple[str, ...]:
        """Return what about the map keeps robots of that radius from their places, in words."""
        found: list[str] = []
        places = list(self.site.places)
        for number, one in enumerate(places):
            for other in places[number + 1 :]:
                apart = math.dist(self._centre(one), self._centre(other))
                if apart < 2 * radius_m and self.site.places[one].z == self.site.places[other].z:
                    found.append(f"{one} and {other} are {apart:.1f} m apart: one robot stands at both")
            walls = [wall.name for wall in self._closed if wall.grown(radius_m).holds(self._centre(one))]
            if walls:
                found.append(f"{one} is nearer to {walls[0]} than {radius_m:g} m: a robot there touches it")
        for aisle in self.site.aisles:
            low, high = aisle.y if aisle.one_way in ("east", "west") else aisle.x
            if high - low < 2 * radius_m:
                found.append(f"{aisle.name} is {high - low:g} m wide: a robot of {radius_m:g} m radius is wider")
        return tuple(found)

    # --- may it go? -------------------------------------------------------------------------------------------

    def decide(self, trip: Trip, bodies: Mapping[str, Body], avoid: Collection[str] = ()) -> Go | Wait:
        """Return the way to ask for, or whom to wait for.

        Args:
            trip: where to.
            bodies: all robots that are seen, its own among them.
            avoid: robots that have the shortest way reserved: look for one round theirs.

        Returns:
            Go: the first stretch of the way, or all of it.
            Wait: whom it waits for.
        """
        me = bodies[trip.robot]
        others = [each for each in bodies.values() if each.robot != trip.robot and _meet(me, trip, each)]
        if trip.reach_m:
            return self._roam(trip, me, others)
        place, goal = "", trip.points[-1]
        if not trip.fixed:
            found = self.place_at(goal, trip)
            if found:
                place = found
                spot = self._spot(place, trip, me, others)
                if isinstance(spot, Wait):
                    return spot
                goal = spot
        points = (*trip.points[:-1], goal)
        standing = [each for each in others if not each.moved]
        straight: tuple[Point, ...] = (me.at, *points)
        if trip.fixed:
            way = straight if all(_clear(straight, each, me) for each in standing) else None
        else:
            walls = [wall for each in standing if (wall := _wall(each, me)) is not None]
            lost = _walls_of_lost(standing, me)
            way = self._route(me, points, [*walls, *lost], trip.flies) if lost else None
            # Where there is no way round them, those who grant know what a lost robot still has reserved.
            way = way or self._route(me, points, walls, trip.flies)
            if way is not None and avoid:
                way = self._round(me, points, walls, [bodies[each] for each in avoid if each in bodies], trip) or way
        if way is None and not standing:
            if not trip.flies and any(each.against(*leg) for each in self._aisles for leg in _legs(straight)):
                why = f"finds no way to ({goal[0]:g}, {goal[1]:g}) that keeps to the one-way aisles"
                return Wait(robot="", why=why, place=place, way=straight)
            way = straight  # the map closes it: the robot's side says so
        if way is None:
            nearest = min(standing, key=lambda each: geometry.from_way(each.at[:2], straight))
            return Wait(robot=nearest.robot, why=_moves(nearest), place=place, way=straight)
        whole = _go(way, me.size, place=place)
        # Who stands on ground that a lost robot has reserved may leave it.
        here = geometry.cells((me.at,), me.size) & _cells_of_lost(others)
        whole = replace(whole, parts=whole.parts - here)
        if place and self.capacity[place] == 1 and goal[:2] == self._centre(place):
            whole = replace(whole, parts=whole.parts | {f"place/{place}"})
        step = self._stretch(whole, trip, me, others)
        first = self._patient(trip, me, others, step.parts)
        if first is not None:
            # It is not in the way: nobody has to give way for that.
            return Wait(robot="", why=f"waits for {first}, which has waited longer", place=place, way=way)
        return step

    def _roam(self, trip: Trip, me: Body, others: Sequence[Body]) -> Go | Wait:
        """Return what a robot without a goal can reach, but for where others stand and the one that it follows is.

        Of those it keeps clear by its own sensors, and it is stopped before it comes too near to one that stands.
        """
        target = next((each for each in others if each.robot == trip.beside), None)
        if target is not None:
            between = (me.at, target.at)
            for each in others:
                if each is not target and not each.moved and not _clear(between, each, me):
                    return Wait(robot=each.robot, why=_moves(each), way=between)
        reached = replace(me.size, radius_m=me.size.radius_m + trip.reach_m)
        parts = geometry.cells((me.at,), reached)
        for each in others:
            if each is target:
                parts -= geometry.cells((each.at, *each.bound), each.size)
            elif each.stands:
                parts -= geometry.cells((each.at,), each.size)
        return Go(way=(me.at,), parts=parts | geometry.cells((me.at,), me.size))

    # --- stretches --------------------------------------------------------------------------------------------

    def up_to(self, go: Go, part: str, trip: Trip, bodies: Mapping[str, Body]) -> Go | None:
        """Return the stretch of a way that ends before a part that another has; None where there is none."""
        me = bodies[trip.robot]
        others = [each for each in bodies.values() if each.robot != trip.robot and _meet(me, trip, each)]
        ends = [end for end, cells in go.sweep if part in cells]
        if trip.fixed or go.yields or not ends:
            return None
        spots = [each for each in self._stops(go, me, others) if each < ends[0]]
        return _cut(go, spots[-1], me.size) if spots else None

    def _stretch(self, go: Go, trip: Trip, me: Body, others: Sequence[Body]) -> Go:
        """Return what of a way is reserved at first: all of it where no other wants to pass."""
        if trip.fixed or geometry.length(go.way) <= STRETCH_M:
            return go
        near = [
            wanted
            for each in others
            if (wanted := _wanted(each)) and geometry.ways_meet(go.way, wanted, me.size.kept_m + each.size.kept_m)
        ]
        spots = self._stops(go, me, others) if near else []
        if not spots:
            return go
        early = [each for each in spots if each <= STRETCH_M]
        return _cut(go, early[-1] if early else spots[0], me.size)

    def _stops(self, go: Go, me: Body, others: Sequence[Body]) -> list[float]:
        """Return how far along a way its robot can stop off all places and without blocking another, metres."""
        last = geometry.length(go.way) - SHORTEST_M
        found: list[float] = []
        for end, _ in go.sweep:
            if not SHORTEST_M <= end <= last:
                continue
            x, y, z = geometry.ahead(go.way, end)[-1]
            takes_off = z > me.at[2] and math.dist((x, y), me.at[:2]) < SHORTEST_M
            if not takes_off and self._clear_of_others((x, y), me, others):
                found.append(end)
        return found

    def _clear_of_others(self, spot: Flat, me: Body, others: Sequence[Body]) -> bool:
        kept = me.size.kept_m
        if any(math.dist(spot, self._centre(place)) < PLACE_M + 2 * kept for place in self.site.places):
            return False
        for each in others:
            apart = kept + each.size.kept_m + APART_M
            if math.dist(spot, each.at[:2]) < apart:
                return False
            wanted = _wanted(each)
            if wanted and geometry.from_way(spot, wanted) < apart:
                return False
        return True

    def _patient(self, trip: Trip, me: Body, others: Sequence[Body], parts: frozenset[str]) -> str | None:
        """Return the robot that has waited longest of all, too long, and would have to wait for this one too."""
        waiting = [(each.waiting, each) for each in others if each.waiting and each.waiting.waited_s >= PATIENCE_S]
        long = [(state, each) for state, each in waiting if not state.in_line and len(state.way) > 1 and state.ticket]
        if not long:
            return None
        state, first = min(long, key=lambda each: each[0].ticket)
        if state.waits_for == trip.robot or state.ticket > (trip.ticket or math.inf):
            return None
        wanted = geometry.cells(state.way, first.size)
        # Who stands in its way may leave it.
        leaves = not wanted.isdisjoint(geometry.cells((me.at,), me.size))
        return None if leaves or wanted.isdisjoint(parts) else first.robot

    def refused(self, go: Go, holder: str, part: str, bodies: Mapping[str, Body], *, ended: bool) -> Wait:
        """Return whom to wait for, and why, where another has reserved a part of the way."""
        other, place = bodies.get(holder), part.removeprefix("place/")
        if ended and (other is None or not other.fresh):
            where = "on its way here" if other is None or other.bound else "in the way"
            why = f"waits for {holder}, which was lost {where}: {remedy_of_lost(holder)}"
        elif ended:
            why = f"waits for {holder} to stand still"
        elif place != part:
            why = _leaves(other, holder, place)
        else:
            why = f"waits for {holder} to pass"
        return Wait(robot=holder, why=why, place=go.place, way=go.way, in_line=place != part)

    # --- places -----------------------------------------------------------------------------------------------

    def place_at(self, goal: Point, trip: Trip) -> str:
        """Return the place that a robot on the ground goes to; "" for a coordinate."""
        if trip.flies and goal[2] > PLACE_M:
            return ""
        near = {name: math.dist(goal[:2], self._centre(name)) for name in self.site.places}
        name = min(near, key=lambda each: near[each], default="")
        return name if name and near[name] <= 0.05 else ""

    def _centre(self, place: str) -> Flat:
        found = self.site.places[place]
        return found.x, found.y

    def _spot(self, place: str, trip: Trip, me: Body, others: Sequence[Body]) -> Point | Wait:
        """Return where to stand at a place, or whom to wait for."""
        there = [each for each in others if self._takes(place, each)]
        strangers = [each for each in there if not (trip.task and each.state and each.state.task == trip.task)]
        capacity, goal = self.capacity[place], trip.points[-1]
        way = (me.at, goal)
        if len(strangers) >= capacity:
            # The one that stands there is left for first.
            first = min(strangers, key=lambda each: (each.moved, each.robot))
            why = _leaves(first, first.robot, place)
            return Wait(robot=first.robot, why=why, place=place, way=way, in_line=True)
        if math.dist(me.at[:2], self._centre(place)) > PLACE_M:
            line = [state for each in others if (state := each.waiting) is not None and state.place == place]
            before = [each for each in line if each.in_line and 0 < each.ticket < (trip.ticket or math.inf)]
            if before and len(strangers) + len(before) >= capacity:
                first_in_line = min(before, key=lambda each: each.ticket)
                why = f"waits for {place}, after {first_in_line.robot}"
                return Wait(robot=there[0].robot if there else "", why=why, place=place, way=way, in_line=True)
        taken = [(each.bound[-1] if each.bound else each.at, each.size.kept_m) for each in others]
        lost = _walls_of_lost(others, me)
        spots = [
            (*spot, goal[2])
            for spot in self._spots(place, me.size, max(capacity, 1 + len(there)), off_cells=bool(lost))
            if all(math.dist(spot, end[:2]) >= me.size.kept_m + kept for end, kept in taken)
        ]
        if spots:
            off = (spot for spot in spots if all(wall.gap(spot[:2]) >= me.size.kept_m for wall in lost))
            return next(off, spots[0])
        near = min(others, key=lambda each: math.dist(each.at[:2], self._centre(place)))
        return Wait(robot=near.robot, why=_leaves(near, near.robot, place), place=place, way=way, in_line=True)

    def is_at(self, body: Body, place: str) -> bool:
        """Whether a robot stands at a place."""
        return math.dist(body.at[:2], self._centre(place)) <= PLACE_M

    def _takes(self, place: str, body: Body) -> bool:
        """Whether a robot is at a place, or has it reserved."""
        end = body.at
        if body.bound and body.state is not None:
            if body.state.place == place:
                return True
            end = body.bound[-1]
        if end[2] > PLACE_M:
            return False
        return math.dist(end[:2], self._centre(place)) <= (PLACE_M if self.capacity[place] == 1 else SIDE_M)

    def _spots(self, place: str, size: Size, count: int, *, off_cells: bool) -> Iterable[Flat]:
        """Yield spots to stand at a place: its centre, round it, and `off_cells` of one that stands in the centre."""
        x, y = self._centre(place)
        yield x, y
        angles = [math.tau * turn / 6 for turn in range(6)]
        rings = [(2 * size.kept_m + 3 * APART_M, count - 1)]  # a robot arrives within some centimetres
        if off_cells and count > 1:
            rings.append((2 * size.kept_m + 1.5 * geometry.CELL_M, len(angles)))
        for ring, most in rings:
            round_it = [(round(x + ring * math.sin(each), 3), round(y + ring * math.cos(each), 3)) for each in angles]
            yield from [spot for spot in round_it if self._open(spot, size)][:most]

    def _open(self, spot: Flat, size: Size) -> bool:
        fence = self.site.fence
        if fence is not None and not (
            fence.x[0] + size.radius_m <= spot[0] <= fence.x[1] - size.radius_m
            and fence.y[0] + size.radius_m <= spot[1] <= fence.y[1] - size.radius_m
        ):
            return False
        return not any(wall.grown(size.kept_m).holds(spot) for wall in self._closed)

    # --- ways -------------------------------------------------------------------------------------------------

    def _route(
        self, me: Body, points: Sequence[Point], walls: Sequence[paths.Rectangle], flies: bool
    ) -> tuple[Point, ...] | None:
        """Return a way through points, round robots; a point that a robot is at is left out, but for the last."""
        kept = me.size.kept_m
        near = [wall.grown(min(kept, 0.9 * wall.gap(me.at[:2]))) for wall in walls]
        map_walls = self._forbidden if flies else self._closed
        if any(wall.gap(points[-1][:2]) < 0.8 * kept for wall in walls):
            return None
        way: list[Point] = [me.at]
        for number, point in enumerate(points):
            if number < len(points) - 1 and any(wall.holds(point[:2]) for wall in near):
                continue
            if paths.straight(way[-1][:2], point[:2], [*near, *map_walls], () if flies else self._aisles):
                way.append(point)
                continue
            try:
                leg = self._plan(way[-1][:2], point[:2], walls, flies=flies, kept_m=kept)
            except paths.NoPath:
                return None
            way += [(round(x, 3), round(y, 3), point[2]) for x, y in leg]
        return tuple(way)

    def _plan(
        self, start: Flat, goal: Flat, walls: Sequence[paths.Rectangle], *, flies: bool, kept_m: float
    ) -> list[Flat]:
        aisles = () if flies else self._aisles
        try:
            return paths.plan(start, goal, [*self._closed, *walls], aisles=aisles, clearance=kept_m, tries=1)
        except paths.NoPath:
            if not flies:
                raise
            return paths.plan(start, goal, [*self._forbidden, *walls], clearance=kept_m, tries=1)

    def _round(
        self, me: Body, points: Sequence[Point], walls: Sequence[paths.Rectangle], avoid: Sequence[Body], trip: Trip
    ) -> tuple[Point, ...] | None:
        """Return a way round those that have reserved theirs; None where there is none, or it is too long."""
        theirs = [wall for each in avoid if each.state is not None for wall in _walls_along(each.state.way, each.size)]
        way = self._route(me, points, (*walls, *theirs), trip.flies)
        shortest = geometry.length((me.at, *points))
        longest = min(DETOUR * shortest, shortest + DETOUR_M) + 2 * me.size.kept_m
        return way if way is not None and geometry.length(way) <= longest else None

    # --- giving way -------------------------------------------------------------------------------------------

    def gives_way(self, trip: Trip, wait: Wait, bodies: Mapping[str, Body]) -> bool:
        """Whether a waiting robot is to give way: another waits for it, and of a ring it is the one to."""
        if not any(each.waiting and each.waiting.waits_for == trip.robot for each in bodies.values()):
            return False
        ring = _ring(trip.robot, wait.robot, bodies)
        rivals = [state for each in ring if (state := bodies[each].waiting) is not None and not state.stuck]
        return not any((each.ticket, each.robot) > (trip.ticket, trip.robot) for each in rivals)

    def refuges(self, trip: Trip, bodies: Mapping[str, Body]) -> Iterable[Go]:
        """Yield ways to spots where a robot stands in nobody's way, the nearest first."""
        me = bodies[trip.robot]
        others = [each for each in bodies.values() if each.robot != trip.robot and _meet(me, trip, each)]
        kept = me.size.kept_m
        looked = 0
        reach = int(REFUGE_M)
        offsets = sorted(
            ((dx, dy) for dx in range(-reach, reach + 1) for dy in range(-reach, reach + 1) if dx or dy),
            key=lambda each: (math.hypot(*each), each),
        )
        walls = [wall for each in others if not each.moved and (wall := _wall(each, me)) is not None]
        wants = [each for each in bodies.values() if each.waiting and each.robot != trip.robot]
        for dx, dy in offsets:
            spot = (me.at[0] + dx, me.at[1] + dy)
            if not self._open(spot, me.size) or any(
                math.dist(spot, self._centre(place)) < PLACE_M + kept for place in self.site.places
            ):
                continue
            if any(math.dist(spot, each.at[:2]) < kept + each.size.kept_m + APART_M for each in others):
                continue
            if any(
                (wanted := _wanted(each)) and geometry.from_way(spot, wanted) < kept + each.size.kept_m
                for each in (*wants, *(each for each in others if each.moved))
            ):
                continue
            looked += 1
            if looked > _REFUGES:
                return
            try:
                leg = self._plan(me.at[:2], spot, walls, flies=trip.flies, kept_m=kept)
            except paths.NoPath:
                continue
            way = (me.at, *((round(x, 3), round(y, 3), me.at[2]) for x, y in leg))
            yield replace(_go(way, me.size), yields=True)


def threat(way: Sequence[Point], me: Body, bodies: Iterable[Body]) -> Body | None:
    """Return a robot that the one that moves would come too near to on the next stretch of its way.

    Those that keep to reserved ways do not come so near; one that is too near already may be left.
    """
    for each in bodies:
        if each.robot == me.robot or not _heights_meet(way, me.size, each):
            continue
        apart = min(me.size.radius_m + each.size.radius_m, math.dist(me.at[:2], each.at[:2]) - 0.05)
        if geometry.from_way(each.at[:2], way) < apart:
            return each
    return None


def _legs(way: Sequence[Point]) -> Iterable[tuple[Flat, Flat]]:
    return ((start[:2], end[:2]) for start, end in pairwise(way))


def _go(way: tuple[Point, ...], size: Size, *, place: str = "") -> Go:
    sweep = geometry.sweep(way, size)
    return Go(way=way, parts=frozenset[str]().union(*(cells for _, cells in sweep)), sweep=sweep, place=place)


def _cut(go: Go, metres: float, size: Size) -> Go:
    """Return the first stretch of a way; the place at its end is reserved with the last one."""
    way = geometry.ahead(go.way, metres)
    first = _go(way, size, place=go.place)
    # `ahead` ends with a point of its own, on the leg to this one.
    return replace(first, parts=first.parts & go.parts, wants=(*go.way[len(way) - 1 :], *go.wants))


def _wanted(body: Body) -> tuple[Point, ...]:
    """Return the way that a robot is on, or waits for, with what comes after."""
    state = body.state
    if state is None or state.state == "stands" or len(state.way) < 2:
        return ()
    return (*state.way, *state.wants) if body.moved else state.way


def next_ticket(bodies: Iterable[Body]) -> int:
    """Return a ticket higher than all that are known."""
    return 1 + max((each.state.ticket for each in bodies if each.state is not None), default=0)


def usual_capacity(name: str, place: Place) -> int:
    """Return how many robots a place takes of which the site file does not say it."""
    words = {word for each in (name, *place.aliases) for word in each.split()}
    return 1 if words.intersection(_SINGLE) else SEVERAL


def _rectangle(box: Box) -> paths.Rectangle:
    return paths.Rectangle(box.name, box.x[0], box.x[1], box.y[0], box.y[1])


def _outside(fence: Box) -> Iterable[paths.Rectangle]:
    """Yield what lies round a fence."""
    (x0, x1), (y0, y1) = fence.x, fence.y
    for x, y in (
        ((x0 - OUTSIDE_M, x0), (y0 - OUTSIDE_M, y1 + OUTSIDE_M)),
        ((x1, x1 + OUTSIDE_M), (y0 - OUTSIDE_M, y1 + OUTSIDE_M)),
        ((x0, x1), (y0 - OUTSIDE_M, y0)),
        ((x0, x1), (y1, y1 + OUTSIDE_M)),
    ):
        yield paths.Rectangle(fence.name, *x, *y)


def _wall(body: Body, me: Body) -> paths.Rectangle | None:
    """Return the ground that a robot keeps; of one that overlaps `me` so much that this one can leave."""
    half = body.size.radius_m + (0.0 if body.stands else body.speed_mps * HAND_S)
    off = max(abs(body.at[0] - me.at[0]), abs(body.at[1] - me.at[1]))
    half = min(half, off - 0.01)
    if half <= 0.02:
        return None
    x, y = body.at[:2]
    return paths.Rectangle(body.robot, x - half, x + half, y - half, y + half)


def _walls_of_lost(bodies: Iterable[Body], me: Body) -> list[paths.Rectangle]:
    """Return the cells that lost robots may still have reserved, but for those that `me` is in: it can leave."""
    return [
        wall
        for each in bodies
        if each.lost
        for edges in geometry.covered(_left_of(each), each.size)
        if not (wall := paths.Rectangle(each.robot, *edges)).holds(me.at[:2])
    ]


def _left_of(body: Body) -> tuple[Point, ...]:
    """Return what is left of the way that a robot was lost on, and a bit behind it; else where it stands."""
    return (body.at, *geometry.rest(body.bound, body.at[:2], 0, LOST_M)[1]) if body.bound else (body.at,)


def _cells_of_lost(bodies: Iterable[Body]) -> frozenset[str]:
    return frozenset[str]().union(*(geometry.cells(_left_of(each), each.size) for each in bodies if each.lost))


def _walls_along(way: Sequence[Point], size: Size) -> list[paths.Rectangle]:
    """Return rectangles that cover a reserved way."""
    walls: list[paths.Rectangle] = []
    for start, end in pairwise(way):
        pieces = max(1, math.ceil(min(abs(start[0] - end[0]), abs(start[1] - end[1]))))
        for piece in range(pieces):
            ends = [
                [one + (piece + step) / pieces * (other - one) for one, other in zip(start, end, strict=True)]
                for step in (0, 1)
            ]
            (x0, x1), (y0, y1) = (sorted(each[axis] for each in ends) for axis in (0, 1))
            walls.append(paths.Rectangle("a reserved way", x0, x1, y0, y1).grown(size.kept_m))
    return walls


def _clear(way: Sequence[Point], body: Body, me: Body) -> bool:
    """Whether a way keeps clear of a robot, or at least gets no nearer to one that is too near already."""
    needed = me.size.kept_m + body.size.radius_m
    return geometry.from_way(body.at[:2], way) >= min(needed, math.dist(me.at[:2], body.at[:2]) - 0.05)


def _meet(me: Body, trip: Trip, body: Body) -> bool:
    return _heights_meet((me.at, *trip.points), me.size, body)


def _heights_meet(way: Sequence[Point], size: Size, body: Body) -> bool:
    """Whether a robot is in a band of height that another goes through."""
    heights = [each[2] for each in way]
    low, high = geometry.bands(min(heights), max(heights), size)
    theirs = [body.at[2], *(each[2] for each in body.bound)]
    other_low, other_high = geometry.bands(min(theirs), max(theirs), body.size)
    return low <= other_high and other_low <= high


def remedy_of_lost(robot: str) -> str:
    """Return what helps against a lost robot in the way."""
    return f"find it, or `swiftbot robots forget {robot}` when it is gone for good"


def _leaves(body: Body | None, robot: str, place: str) -> str:
    if body is not None and body.lost:
        where = "on its way to" if body.bound else "at"
        return f"waits for {robot}, which was lost {where} {place}: {remedy_of_lost(robot)}"
    if body is not None and body.moved and body.state is not None and body.state.place == place:
        return f"waits for {robot}, which goes to {place}"
    return f"waits for {robot} to leave {place}{_itself(body)}"


def _moves(body: Body) -> str:
    if not body.stands:
        return f"waits for {body.robot}, which moves without a reservation"
    if not body.fresh:
        return f"waits for {body.robot}, which was lost in the way: {remedy_of_lost(body.robot)}"
    return f"waits for {body.robot} to move out of the way{_itself(body)}"


def _itself(body: Body | None) -> str:
    if body is None or body.waiting is None or not body.waiting.waits_for:
        return ""
    return f" (it waits for {body.waiting.waits_for})"


def _ring(robot: str, waits_for: str, bodies: Mapping[str, Body]) -> tuple[str, ...]:
    """Return those that wait for one another in a ring with a robot, without itself; none where there is no ring."""
    ring: list[str] = []
    current = waits_for
    while current != robot:
        body = bodies.get(current)
        if body is None or body.waiting is None or current in ring:
            return ()
        ring.append(current)
        current = body.waiting.waits_for
    return tuple(ring)
