"""The small world of simulated robots: things of a site, who holds them, doors, devices, and the people about.

Every simulated robot has its own copy, made of the site's objects; what one robot does to a thing it puts on the
plane, and the others follow. A counter and the writer's name order two that act at once, so all copies
end equal (last writer wins, Lamport's order). Pure.
"""

import math
import re
from collections.abc import Iterable

import msgspec
from msgspec import Struct

from appliance.model import Box, Person, Pose, Site
from appliance.model.keys import Topic, Untyped
from appliance.model.site import bearing_deg, inside
from appliance.robots.verbs import RobotFailure

OPEN, CLOSED, ON, OFF = "open", "closed", "on", "off"
HEARING_M = 6.0
"""How far a robot's voice carries, and the answer."""
REACH_M = 1.5
"""How far the arm reaches from the robot's middle."""
_RING_M = 0.9
"""Things stand this far from the middle of their place, where robots stop."""
_TURNS = 12
_APART_M = 0.7
_WORD = re.compile(r"[a-z0-9]+")
_HERE = frozenset({"here", "floor", "ground"})


class Thing(Struct, frozen=True, kw_only=True):
    """A thing: metres, on the ground unless `holder` (a robot) has it. `counter` and `writer` order changes."""

    name: str
    colour: str
    size: float
    x: float
    y: float
    holder: str = ""
    state: str = ""
    """Of a door `open` or `closed`, of a device `on` or `off`; empty for what has no state."""
    condition: str = ""
    """What a robot made of it: `clean`, `cut`, `loose`, …"""
    counter: int = 0
    writer: str = ""


WORLD_OF = Topic(
    "robot/{robot}/world",
    Untyped,
    "nothing → the things a simulated robot knows of",
    form="query",
    writer="answered by a simulated robot",
    often="when another starts",
)
WORLD = Topic(
    "world/{thing}",
    Thing,
    writer="a simulated robot that picked it up or put it down",
    often="on change",
    kept="by simulated robots",
)


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
        for door in site.doors:
            x, y = sum(door.x) / 2, sum(door.y) / 2
            size = max(door.x[1] - door.x[0], door.y[1] - door.y[0])
            state = OPEN if door.open else CLOSED
            self._things[words(door.name)] = Thing(name=door.name, colour="brown", size=size, x=x, y=y, state=state)
        for device in site.devices:
            place = site.find(device.at)
            x, y = (0.0, 0.0) if place is None else (place.x, place.y)
            state = ON if device.on else OFF
            self._things[words(device.name)] = Thing(name=device.name, colour="grey", size=0.2, x=x, y=y, state=state)

    @property
    def shut(self) -> tuple[Box, ...]:
        """Doors that are shut: obstacles for who drives."""
        return tuple(
            Box(name=f"the shut {door.name}", x=door.x, y=door.y)
            for door in self.site.doors
            if self._things[words(door.name)].state == CLOSED
        )

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
        if thing is None or thing.state:
            movable = [each for each in self.things if not each.state]
            raise RobotFailure(
                "not-found", f"there is no {name[:60]!r} here to be picked", remedy=f"there are: {_names(movable)}"
            )
        if held is not None:
            raise RobotFailure(
                "precondition", f"{robot} already holds the {held.name}", remedy="place it first, it has one hand"
            )
        if thing.holder:
            raise RobotFailure("precondition", f"the {thing.name} is held by {thing.holder}", retryable=True)
        distance = math.hypot(thing.x - pose.x, thing.y - pose.y)
        if distance > REACH_M:
            near = self.nearest_place(thing.x, thing.y)
            raise RobotFailure(
                "precondition",
                f"the {thing.name} is {distance:.1f} m away, the arm reaches {REACH_M:g} m",
                remedy=f"drive to {near} first" if near else "drive there first",
            )
        return thing

    def pick(self, robot: str, thing: Thing) -> Thing:
        """Put the thing into the robot's hand; returns the change to tell the others."""
        return self._change(thing, robot, holder=robot)

    def load(self, robot: str, name: str, pose: Pose) -> Thing:
        """Have a robot hold a thing, one that is new here if need be; returns the change to tell the others."""
        thing = self._things.setdefault(
            words(name), Thing(name=name, colour=words(name).split(" ")[0], size=0.4, x=pose.x, y=pose.y)
        )
        return self.pick(robot, thing)

    def check_reach(self, robot: str, name: str, pose: Pose, *, what: str) -> Thing:
        """Return the thing of that name that the arm reaches, or holds; RobotFailure says why not."""
        thing = self.find(name, pose.x, pose.y)
        if thing is None:
            raise RobotFailure(
                "not-found", f"there is no {name[:60]!r} here to {what}", remedy=f"there are: {_names(self.things)}"
            )
        if thing.holder not in ("", robot):
            raise RobotFailure("precondition", f"the {thing.name} is held by {thing.holder}", retryable=True)
        distance = 0.0 if thing.holder else self._distance(thing, pose)
        if distance > REACH_M:
            near = self.nearest_place(thing.x, thing.y)
            raise RobotFailure(
                "precondition",
                f"the {thing.name} is {distance:.1f} m away, the arm reaches {REACH_M:g} m",
                remedy=f"drive to {near} first" if near else "drive there first",
            )
        return thing

    def become(self, robot: str, thing: Thing, condition: str) -> Thing:
        """Leave a thing in another condition; returns the change to tell the others."""
        return self._change(thing, robot, condition=condition)

    def check_place(self, robot: str, name: str, at: str, pose: Pose) -> tuple[Thing, float, float]:
        """Return the held thing and the spot to put it down; RobotFailure says why not."""
        held = self.held_by(robot)
        if held is None:
            raise RobotFailure("precondition", f"{robot} holds nothing", remedy=f"pick the {name[:60]} first")
        wanted = self.find(name, pose.x, pose.y)
        if words(name) not in words(held.name) and (wanted is None or wanted.name != held.name):
            raise RobotFailure("precondition", f"{robot} holds the {held.name}, not the {name[:60]}")
        x, y = self._destination(held, at, pose)
        distance = math.hypot(x - pose.x, y - pose.y)
        if distance > REACH_M:
            raise RobotFailure(
                "precondition",
                f"{at[:60]} is {distance:.1f} m away, the arm reaches {REACH_M:g} m",
                remedy=f"drive to {at[:60]} first",
            )
        return held, *self.free_spot(x, y)

    def place(self, robot: str, thing: Thing, x: float, y: float) -> Thing:
        """Put the thing down; returns the change to tell the others."""
        return self._change(thing, robot, x=round(x, 3), y=round(y, 3), holder="")

    def check_switch(self, name: str, pose: Pose, *, states: tuple[str, str]) -> Thing:
        """Return the door or device of that name that is within reach; RobotFailure says why not.

        Args:
            name: what it is called.
            pose: where the robot is.
            states: the states that such a thing can have.
        """
        fitting = [each for each in self.things if each.state in states]
        thing = self._things.get(words(name))
        if thing is None or thing not in fitting:
            wanted = set(words(name).split())
            near = [each for each in fitting if wanted and wanted <= set(words(each.name).split())]
            thing = min(near, key=lambda each: math.hypot(each.x - pose.x, each.y - pose.y), default=None)
        if thing is None:
            raise RobotFailure(
                "not-found", f"there is no {name[:60]!r} here for that", remedy=f"there are: {_names(fitting)}"
            )
        distance = self._distance(thing, pose)
        if distance > REACH_M:
            near_place = self.nearest_place(thing.x, thing.y)
            raise RobotFailure(
                "precondition",
                f"the {thing.name} is {distance:.1f} m away, the arm reaches {REACH_M:g} m",
                remedy=f"drive to {near_place} first" if near_place else "drive there first",
            )
        return thing

    def switch(self, robot: str, thing: Thing, state: str) -> Thing:
        """Bring a door or device into a state; returns the change to tell the others."""
        return self._change(thing, robot, state=state)

    def _distance(self, thing: Thing, pose: Pose) -> float:
        """Metres to a thing; to a door from its nearest edge."""
        door = next((each for each in self.site.doors if words(each.name) == words(thing.name)), None)
        if door is None:
            return math.hypot(thing.x - pose.x, thing.y - pose.y)
        x = max(door.x[0], min(door.x[1], pose.x))
        y = max(door.y[0], min(door.y[1], pose.y))
        return math.hypot(x - pose.x, y - pose.y)

    def person(self, name: str, pose: Pose, *, within: float = HEARING_M) -> Person:
        """Return the person of that name (none given: the nearest) within metres; RobotFailure says why not."""
        wanted = words(name)
        spots = [(each, self.site.find(each.at)) for each in self.site.people]
        near = {each.name: math.hypot(place.x - pose.x, place.y - pose.y) for each, place in spots if place is not None}
        chosen = [each for each, _ in spots if each.name in near and (not wanted or words(each.name) == wanted)]
        if not chosen:
            known = ", ".join(sorted(near)) or "nobody"
            raise RobotFailure("not-found", f"there is no {name[:60]!r} about", remedy=f"there are: {known}")
        person = min(chosen, key=lambda each: near[each.name])
        if near[person.name] > within:
            raise RobotFailure(
                "precondition",
                f"{person.name} is {near[person.name]:.1f} m away, {within:g} m are near enough",
                remedy=f"drive to {person.at} first",
            )
        return person

    def check_give(self, robot: str, name: str, to: str, pose: Pose) -> tuple[Thing, Person]:
        """Return the held thing and the person it is for; RobotFailure says why not."""
        held = self.held_by(robot)
        if held is None:
            raise RobotFailure("precondition", f"{robot} holds nothing", remedy=f"pick the {name[:60]} first")
        if words(name) not in words(held.name):
            raise RobotFailure("precondition", f"{robot} holds the {held.name}, not the {name[:60]}")
        return held, self.person(to, pose, within=2 * REACH_M)

    def give(self, robot: str, thing: Thing, person: Person) -> Thing:
        """Put the thing into a person's hands; returns the change to tell the others."""
        return self._change(thing, robot, holder=person.name)

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


def answer(person: Person, question: str) -> str:
    """Return what a person says to a question: the entry most of whose words are in it, "" when they have none."""
    asked = set(_WORD.findall(question.lower()))
    fitting = [key for key in person.answers if set(_WORD.findall(key.lower())) <= asked]
    best = max(fitting, key=lambda key: (len(_WORD.findall(key)), key), default=None)
    return "" if best is None else person.answers[best]


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
