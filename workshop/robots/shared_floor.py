"""Robots on one floor in virtual time: the decider, the grantors and the sight of the product, and rovers that drive.

Each robot goes to random places, one after the other, and stays a while at each. Three ways to share the floor are
compared: `reserved` as the product does it, `alone` with one robot on its way at a time, `none` without coordination.
In `reserved`, one of the three grantors is down for `down_s` of each minute, in turn, and what it granted is forgotten.
"""

import math
import random
from collections.abc import Mapping
from itertools import combinations
from typing import Literal

from msgspec import Struct

from appliance.errors import RefusedError
from appliance.floor import geometry
from appliance.floor.decide import Body, Floor, Go, Trip, Wait
from appliance.floor.mover import Mover
from appliance.floor.settings import FloorConfig
from appliance.floor.sight import Sight
from appliance.model import RobotInfo, Site
from appliance.model.floor import Point
from appliance.model.plane_api import Granted, LeaseAsk, LeaseEnd
from appliance.plane.leases import Grantor, granted
from appliance.skills._lib import paths
from workshop.robots.driving import Driving
from workshop.robots.mavlink import start_point

Mode = Literal["reserved", "alone", "none"]
TICK_S = 0.1
SEE_S = 0.2
ASK_S = 1.0
RENEW_S = 1.0
TTL_S = 10.0
DWELL_S = 5.0
STUCK_S = 120.0
"""A ring of waiting robots that lasts longer counts as a deadlock."""
GRANTORS = 3


class Outcome(Struct, frozen=True, kw_only=True):
    """What came of one run."""

    robots: int
    mode: Mode
    seconds: float
    visits: int
    """Places reached."""
    collisions: int
    """Times that two robots came nearer than the sum of their radii."""
    nearest_m: float
    """The least distance of two robots."""
    deadlocks: int
    """Rings of robots that wait for one another, at the end, for longer than `STUCK_S`."""
    gave_way: int
    longest_wait_s: float
    waiting: float
    """Share of the robots' time."""

    @property
    def per_hour(self) -> float:
        """Places reached in an hour."""
        return self.visits * 3600.0 / self.seconds


class _Robot:
    def __init__(self, name: str, at: tuple[float, float]) -> None:
        self.name = name
        self.driving = Driving(*at)
        self.mover: Mover | None = None
        self.free_at = 0.0
        self.ask_at = 0.0
        self.renew_at = 0.0
        self.fence = 0
        self.way: list[tuple[float, float]] = []
        self.waits_since: float | None = None
        self.number = 0


class FloorSimulation:
    """One run."""

    def __init__(self, site: Site, *, robots: int, mode: Mode = "reserved", seed: int = 1, down_s: float = 0.0) -> None:
        self.site = site
        self.mode: Mode = mode
        self._down_s = down_s
        self._random = random.Random(seed)  # noqa: S311 - no secret
        self._floor = Floor(site)
        self._sight = Sight(FloorConfig())
        self._grantors = [Grantor(fence=0, now=0.0) for _ in range(GRANTORS)]
        self._fence = 0
        self._closed = paths.rectangles(
            [{"name": box.name, "x": box.x, "y": box.y} for box in (*site.obstacles, *site.forbidden)]
        )
        self._aisles = [
            paths.OneWay(paths.Rectangle(each.name, *each.x, *each.y), each.one_way) for each in site.aisles
        ]
        start = "charger" if "charger" in site.places else next(iter(site.places), "")
        self.robots = [_Robot(f"rover_{number + 1}", start_point(site, start, spot=number)) for number in range(robots)]
        self.now = 0.0
        self.visits = self.collisions = self.gave_way = 0
        self.nearest_m = math.inf
        self.longest_wait_s = self.waited_s = 0.0
        self._touching: set[tuple[str, str]] = set()
        self._down: int | None = None

    def run(self, seconds: float) -> Outcome:
        """Simulate for so long."""
        next_look = 0.0
        while self.now < seconds:
            self._cut_grantors()
            if self.now >= next_look:
                next_look = self.now + SEE_S
                self._observe()
            for robot in self.robots:
                self._step(robot)
                robot.driving.battery_percent = 100.0
                robot.driving.step(TICK_S)
            self._measure()
            self.now = round(self.now + TICK_S, 6)
        return Outcome(
            robots=len(self.robots),
            mode=self.mode,
            seconds=seconds,
            visits=self.visits,
            collisions=self.collisions,
            nearest_m=round(self.nearest_m, 3),
            deadlocks=self._deadlocks(),
            gave_way=self.gave_way,
            longest_wait_s=round(self.longest_wait_s, 1),
            waiting=round(self.waited_s / (seconds * len(self.robots)), 3),
        )

    # --- the world --------------------------------------------------------------------------------------------

    def _cut_grantors(self) -> None:
        if not self._down_s:
            return
        minute, second = divmod(self.now, 60.0)
        down = int(minute) % GRANTORS if 0 < second <= self._down_s else None
        if self._down is not None and down is None:
            # Restarted: it knows its highest fence, and grants nothing for as long as the longest lease.
            self._grantors[self._down] = Grantor(fence=self._grantors[self._down].fence, now=self.now)
        self._down = down

    def _observe(self) -> None:
        for robot in self.robots:
            info = RobotInfo(id=robot.name, kind="zenoh", pose=robot.driving.pose)
            self._sight.observe(info, self.now)
            if robot.mover is not None:
                self._tell(robot)

    def _tell(self, robot: _Robot) -> None:
        if robot.mover is not None:
            self._sight.hear(robot.mover.state("gw-1", f"{robot.name}/{robot.number}", self.now), self.now)

    def _measure(self) -> None:
        for one, other in combinations(self.robots, 2):
            apart = math.hypot(one.driving.x - other.driving.x, one.driving.y - other.driving.y)
            self.nearest_m = min(self.nearest_m, apart)
            pair = one.name, other.name
            if apart >= 2 * FloorConfig().radius_m:
                self._touching.discard(pair)
            elif pair not in self._touching:
                self._touching.add(pair)
                self.collisions += 1
        for robot in self.robots:
            if robot.waits_since is not None:
                self.waited_s += TICK_S
                self.longest_wait_s = max(self.longest_wait_s, self.now - robot.waits_since)

    def _deadlocks(self) -> int:
        waits = {each.name: each.mover.wait.robot for each in self.robots if each.mover and each.mover.wait}
        rings: set[frozenset[str]] = set()
        for robot in self.robots:
            if robot.waits_since is None or self.now - robot.waits_since < STUCK_S:
                continue
            seen: list[str] = []
            current = robot.name
            while current in waits and current not in seen:
                seen.append(current)
                current = waits[current]
            if current in seen:
                rings.add(frozenset(seen[seen.index(current) :]))
        return len(rings)

    # --- one robot --------------------------------------------------------------------------------------------

    def _step(self, robot: _Robot) -> None:
        if robot.mover is None:
            if self.now >= robot.free_at:
                self._begin(robot)
            return
        go = robot.mover.go
        if go is None:
            if self.now >= robot.ask_at:
                robot.ask_at = self.now + ASK_S
                self._ask(robot, robot.mover)
            return
        if not robot.driving.moving:
            self._arrived(robot, robot.mover, go)
            return
        if self.mode == "reserved":
            self._on_its_way(robot, robot.mover)

    def _begin(self, robot: _Robot) -> None:
        here = (robot.driving.x, robot.driving.y)
        places = [each for each in self.site.places.values() if math.dist(here, (each.x, each.y)) > 2.0]
        place = self._random.choice(places)
        robot.number += 1
        try:
            way = paths.plan(here, (place.x, place.y), self._closed, aisles=self._aisles)
        except paths.NoPath:
            robot.free_at = self.now + 1.0
            return
        points: tuple[Point, ...] = tuple((x, y, 0.0) for x, y in way)
        command = f"{robot.name}/{robot.number}"
        robot.mover = Mover(self._floor, Trip(robot=robot.name, task=command, command=command, points=points))
        robot.ask_at = self.now

    def _arrived(self, robot: _Robot, mover: Mover, go: Go) -> None:
        mover.arrived()
        if self.mode == "reserved":
            self._stand(robot, mover)
        self._tell(robot)
        if go.wants:
            robot.ask_at = self.now + 2 * SEE_S  # it is seen there by then
            return
        if go.yields:
            robot.waits_since = robot.waits_since or self.now
            robot.ask_at = self.now + ASK_S
            return
        self.visits += 1
        robot.mover = None
        robot.free_at = self.now + DWELL_S

    def _ask(self, robot: _Robot, mover: Mover) -> None:
        if self.mode == "none" or (self.mode == "alone" and not any(each.driving.moving for each in self.robots)):
            way = ((robot.driving.x, robot.driving.y, 0.0), *mover.trip.points)
            self._go(robot, mover, Go(way=way, parts=frozenset()))
            return
        if self.mode == "alone":
            return
        mover.begin()
        step: Go | Wait | None = None
        while True:
            bodies = self._sight.bodies(self.now)
            step = step or mover.ask(bodies, self.now)
            if isinstance(step, Wait):
                break
            holder, part, ended = self._claim(robot, step.parts)
            if not holder:
                self._go(robot, mover, step)
                return
            after = mover.refused(step, holder, part, bodies, self.now, ended=ended)
            if isinstance(after, Wait):
                break
            step = after
        robot.waits_since = self.now if robot.waits_since is None else robot.waits_since
        self._tell(robot)

    def _go(self, robot: _Robot, mover: Mover, go: Go) -> None:
        mover.started(go)
        self.gave_way += go.yields
        if not go.yields:
            robot.waits_since = None
        robot.driving.go([(x, y) for x, y, _ in go.way[1:]], None)
        robot.renew_at = self.now + RENEW_S
        self._tell(robot)

    def _on_its_way(self, robot: _Robot, mover: Mover) -> None:
        bodies = self._sight.bodies(self.now)
        body = bodies[robot.name]
        if mover.threat(body, bodies) is not None:
            robot.driving.halt()
            mover.stopped((robot.driving.x, robot.driving.y, 0.0))
            self._stand(robot, mover)
            robot.ask_at = self.now + ASK_S
            self._tell(robot)
        elif self.now >= robot.renew_at:
            robot.renew_at = self.now + RENEW_S
            self._claim(robot, mover.parts(body), after=robot.fence)

    def _stand(self, robot: _Robot, mover: Mover) -> None:
        size = self._sight.bodies(self.now)[robot.name].size
        at = (robot.driving.x, robot.driving.y, 0.0)
        body = Body(robot=robot.name, at=at, size=size)
        parts = geometry.cells((at,), size)
        if self._floor.capacity.get(mover.place) == 1 and self._floor.is_at(body, mover.place):
            parts |= {f"place/{mover.place}"}
        self._claim(robot, parts, after=robot.fence)

    def _claim(self, robot: _Robot, parts: frozenset[str], after: int = 0) -> tuple[str, str, bool]:
        """Ask the grantors; returns who is in the way, the part, and whether its lease has ended; "" where granted."""
        self._fence += 1
        cleared = tuple(sorted(self._sight.cleared(self.now) - {robot.name}))
        asked = LeaseAsk(
            key="floor", holder=robot.name, fence=self._fence, ttl_s=TTL_S, voters="", parts=tuple(sorted(parts)),
            after=after, cleared=cleared,
        )  # fmt: skip
        answers: dict[int, Granted] = {}
        for number, grantor in enumerate(self._grantors):
            if number != self._down:
                try:
                    answers[number] = grantor.grant(asked, self.now)
                except RefusedError:
                    continue  # restarted lately
        if granted(list(answers.values()), GRANTORS):
            robot.fence = asked.fence
            return "", "", False
        for number, answer in answers.items():
            if answer.granted:
                end = LeaseEnd(key="floor", holder=robot.name, fence=asked.fence, voters="")
                self._grantors[number].release(end)
        others = [answer for answer in answers.values() if answer.holder]
        if not others:
            return "the grantors", "", False
        other = max(others, key=lambda answer: (answer.left_s, answer.part))
        return other.holder, other.part, other.left_s <= 0.0


def run(site: Site, *, robots: int, mode: Mode, seconds: float, seed: int = 1, down_s: float = 0.0) -> Outcome:
    """Simulate one fleet in one mode."""
    return FloorSimulation(site, robots=robots, mode=mode, seed=seed, down_s=down_s).run(seconds)


def states(simulation: FloorSimulation) -> Mapping[str, str]:
    """Return what each robot of a simulation waits for, in words."""
    return {
        each.name: each.mover.wait.why
        for each in simulation.robots
        if each.mover is not None and each.mover.wait is not None and each.mover.go is None
    }
