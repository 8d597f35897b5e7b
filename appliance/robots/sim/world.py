"""The small world of simulated robots: things of a site, who holds them, and what may be done with them.

Every simulated robot has its own copy, made of the site's objects; what one robot does to a thing it puts on the
plane, and the others follow. Two that act at once are told apart by a counter and the writer's name, so all copies
end equal (last writer wins, Lamport's order). Pure.
"""

import math
from collections.abc import Iterable

import msgspec
from msgspec import Struct

from appliance.model import Box, Pose, Site
from appliance.robots.geo import bearing_deg, inside
from appliance.robots.verbs import RobotFailure

REACH_M = 1.5
"""How far the arm reaches from the robot's middle."""
_RING_M = 0.9
"""Things stand this far from the middle of their place, where robots stop."""
_TURNS = 12
_APART_M = 0.7
_HERE = frozenset({"here", "floor", "ground"})


class Thing(Struct, frozen=True, kw_only=True):
    """A thing: metres, on the ground unless `holder` (a robot) has it. `counter` and `writer` order changes."""

    name: str
    colour: str
    size: float
    x: float
    y: float
    holder: str = ""
    counter: int = 0
    writer: str = ""


class Things(Struct, frozen=True):
    """All things of a world, as answered to a latecomer."""

    things: tuple[Thing, ...]


def words(name: str) -> str:
    """Bring a name to the form that is compared: lower case, no articles, no underscores."""
    return " ".join(
        word for word in name.lower().replace("_", " ").replace("-", " ").split() if word not in ("the", "a", "an")
    )


class World:
    """Things of one site as one robot knows them."""

    def __init__(self, site: Site) -> None:
        self.site = site
        self._things: dict[str, Thing] = {}
        for item in site.objects:
            place = site.find(item.at)
            x, y = (0.0, 0.0) if place is None else self.free_spot(place.x, place.y)
            self._things[words(item.name)] = Thing(name=item.name, colour=item.colour, size=item.size, x=x, y=y)

    @property
    def things(self) -> tuple[Thing, ...]:
        """All things."""
        return tuple(self._things.values())

    def held_by(self, robot: str) -> Thing | None:
        """Return what a robot holds."""
        return next((thing for thing in self._things.values() if thing.holder == robot), None)

    def find(self, name: str, x: float, y: float) -> Thing | None:
        """Return the thing of that name; of several that the words fit ("box") the nearest to (x, y)."""
        wanted = words(name)
        exact = self._things.get(wanted)
        if exact is not None:
            return exact
        fitting = [thing for key, thing in self._things.items() if wanted and set(wanted.split()) <= set(key.split())]
        return min(fitting, key=lambda thing: math.hypot(thing.x - x, thing.y - y), default=None)

    def obstacle(self, name: str) -> Box | None:
        """Return the obstacle or forbidden area of that name."""
        wanted = words(name)
        return next((box for box in (*self.site.obstacles, *self.site.forbidden) if words(box.name) == wanted), None)

    def take_in(self, change: Thing) -> bool:
        """Follow another robot's change; returns whether it was news."""
        key = words(change.name)
        known = self._things.get(key)
        if known is None or (change.counter, change.writer) <= (known.counter, known.writer):
            return False
        self._things[key] = change
        return True

    def check_pick(self, robot: str, name: str, pose: Pose) -> Thing:
        """Return the thing that can be picked; RobotFailure says why not."""
        held = self.held_by(robot)
        thing = self.find(name, pose.x, pose.y)
        if thing is None:
            raise RobotFailure(
                "not-found", f"there is no {name[:60]!r} here", remedy=f"there are: {_names(self.things)}"
            )
        if held is not None:
            raise RobotFailure(
                "robot", f"{robot} already holds the {held.name}", remedy="place it first, it has one hand"
            )
        if thing.holder:
            raise RobotFailure("robot", f"the {thing.name} is held by {thing.holder}", retryable=True)
        distance = math.hypot(thing.x - pose.x, thing.y - pose.y)
        if distance > REACH_M:
            near = self.nearest_place(thing.x, thing.y)
            raise RobotFailure(
                "robot",
                f"the {thing.name} is {distance:.1f} m away, the arm reaches {REACH_M:g} m",
                remedy=f"drive to {near} first" if near else "drive there first",
            )
        return thing

    def pick(self, robot: str, thing: Thing) -> Thing:
        """Put the thing into the robot's hand; returns the change to tell the others."""
        return self._change(thing, robot, holder=robot)

    def check_place(self, robot: str, name: str, at: str, pose: Pose) -> tuple[Thing, float, float]:
        """Return the held thing and the spot to put it down; RobotFailure says why not."""
        held = self.held_by(robot)
        if held is None:
            raise RobotFailure("robot", f"{robot} holds nothing", remedy=f"pick the {name[:60]} first")
        wanted = self.find(name, pose.x, pose.y)
        if words(name) not in words(held.name) and (wanted is None or wanted.name != held.name):
            raise RobotFailure("robot", f"{robot} holds the {held.name}, not the {name[:60]}")
        x, y = self._destination(held, at, pose)
        distance = math.hypot(x - pose.x, y - pose.y)
        if distance > REACH_M:
            raise RobotFailure(
                "robot",
                f"{at[:60]} is {distance:.1f} m away, the arm reaches {REACH_M:g} m",
                remedy=f"drive to {at[:60]} first",
            )
        return held, *self.free_spot(x, y)

    def place(self, robot: str, thing: Thing, x: float, y: float) -> Thing:
        """Put the thing down; returns the change to tell the others."""
        return self._change(thing, robot, x=round(x, 3), y=round(y, 3), holder="")

    def carry(self, robot: str, pose: Pose) -> None:
        """Let what a robot holds move with it; the others hear of it when it is put down."""
        held = self.held_by(robot)
        if held is not None:
            self._things[words(held.name)] = msgspec.structs.replace(held, x=pose.x, y=pose.y)

    def nearest_place(self, x: float, y: float) -> str:
        """Return the name of the nearest place, empty where the site has none."""
        places = self.site.places
        return min(places, key=lambda name: math.hypot(places[name].x - x, places[name].y - y), default="")

    def free_spot(self, x: float, y: float) -> tuple[float, float]:
        """Return a spot beside (x, y) that is in no obstacle and, where possible, clear of other things."""
        boxes = (*self.site.obstacles, *self.site.forbidden)
        second: tuple[float, float] | None = None
        for turn in range(_TURNS):
            angle = math.tau * turn / _TURNS
            spot = (round(x + _RING_M * math.sin(angle), 3), round(y + _RING_M * math.cos(angle), 3))
            if any(inside(box, *spot, margin=0.2) for box in boxes):
                continue
            if all(math.hypot(thing.x - spot[0], thing.y - spot[1]) > _APART_M for thing in self._standing()):
                return spot
            second = second or spot
        return second or (x, y)

    def _standing(self) -> Iterable[Thing]:
        return (thing for thing in self._things.values() if not thing.holder)

    def _destination(self, held: Thing, at: str, pose: Pose) -> tuple[float, float]:
        if words(at) in _HERE:
            return pose.x, pose.y
        place = self.site.find(at)
        if place is not None:
            return place.x, place.y
        box = self.obstacle(at)
        if box is not None:  # its nearest edge
            return max(box.x[0], min(box.x[1], pose.x)), max(box.y[0], min(box.y[1], pose.y))
        other = self.find(at, pose.x, pose.y)
        if other is not None and other.name != held.name:
            return other.x, other.y
        raise RobotFailure(
            "not-found", f"the site has no place {at[:60]!r}", remedy=f"places: {', '.join(sorted(self.site.places))}"
        )

    def _change(self, thing: Thing, writer: str, **changes: object) -> Thing:
        change = msgspec.structs.replace(thing, counter=thing.counter + 1, writer=writer, **changes)
        self._things[words(thing.name)] = change
        return change


class Aim(Struct, frozen=True):
    """Where a camera looks: compass bearing and elevation in degrees; `known` False: straight ahead."""

    bearing_deg: float
    elevation_deg: float
    distance_m: float
    known: bool


def aim(world: World, target: str, pose: Pose, eye_m: float) -> Aim:
    """Choose where to look for a target: a thing, a place (or what stands there), an obstacle; else ahead."""
    point = _target_point(world, target, pose)
    if point is None:
        return Aim(pose.heading_deg, 0.0, 0.0, known=words(target) in {words(name) for name in world.site.places})
    x, y, z = point
    distance = math.hypot(x - pose.x, y - pose.y)
    elevation = math.degrees(math.atan2(z - eye_m, max(distance, 0.1)))
    return Aim(bearing_deg(x - pose.x, y - pose.y), max(-60.0, min(30.0, elevation)), distance, known=True)


def _target_point(world: World, target: str, pose: Pose) -> tuple[float, float, float] | None:
    thing = world.find(target, pose.x, pose.y)
    if thing is not None:
        return thing.x, thing.y, thing.size / 2
    place = world.site.find(target)
    if place is not None:
        if math.hypot(place.x - pose.x, place.y - pose.y) > REACH_M:
            return place.x, place.y, 0.5
        # Standing there already: look at what stands there.
        near = [each for each in world.things if math.hypot(each.x - place.x, each.y - place.y) <= 2 * REACH_M]
        nearest = min(near, key=lambda each: math.hypot(each.x - pose.x, each.y - pose.y), default=None)
        return None if nearest is None else (nearest.x, nearest.y, nearest.size / 2)
    box = world.obstacle(target)
    if box is not None:
        return (box.x[0] + box.x[1]) / 2, (box.y[0] + box.y[1]) / 2, 1.0
    return None


def _names(things: Iterable[Thing]) -> str:
    return ", ".join(sorted(thing.name for thing in things)) or "none"
