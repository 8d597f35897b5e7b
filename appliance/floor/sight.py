"""What is seen of robots: where each was heard last, whether it stands, and what moves it. Pure: time is passed in."""

import math
from typing import NamedTuple

from msgspec.structs import replace

from appliance.floor.decide import Body
from appliance.floor.geometry import Size
from appliance.floor.settings import FloorConfig
from appliance.model import RobotInfo
from appliance.model.floor import FloorState, Point

FRESH_S = 2.5
"""A robot that is not heard for so long is not seen any more, and counts as standing where it was."""
STANDS_S = 1.5
"""One that has not moved for so long stands."""
STATE_S = 6.0
"""What a gateway says of a robot that it moves holds for so long; it says it again before."""
_MOST = 4096
_HEIGHT_M, _DRONE_HEIGHT_M = 1.5, 0.5


class _Track(NamedTuple):
    info: RobotInfo
    at: Point
    heard: float
    since: float
    """It has been near its anchor for so long."""
    anchor: Point
    speed: float


class Sight:
    """The robots as one gateway sees them."""

    def __init__(self, config: FloorConfig) -> None:
        self._config = config
        self._tracks: dict[str, _Track] = {}
        self._states: dict[str, tuple[FloorState, float]] = {}
        self._forgotten: set[str] = set()

    def observe(self, info: RobotInfo, now: float) -> None:
        """Take in what a robot says of itself; one that does not know where it is stays where it was."""
        if info.pose is None:
            return
        self._forgotten.discard(info.id)
        at = (info.pose.x, info.pose.y, max(0.0, info.pose.z))
        before = self._tracks.get(info.id)
        if before is None:
            if len(self._tracks) < _MOST:
                self._tracks[info.id] = _Track(info, at, now if info.online else -math.inf, now, at, 0.0)
            return
        if not info.online:
            self._tracks[info.id] = before._replace(info=info, heard=-math.inf)
            return
        near = math.dist(at, before.anchor) <= self._tolerance(info)
        passed = max(1e-3, now - before.heard)
        speed = math.dist(at, before.at) / passed if math.isfinite(passed) else 0.0
        # The greater of two steps: reports that come late in pairs would make it slow.
        smoothed = max(speed, 0.5 * before.speed) if not near else 0.0
        self._tracks[info.id] = _Track(
            info, at, now, before.since if near else now, before.anchor if near else at, smoothed
        )

    def lost(self, robot: str) -> None:
        """Note that a robot is offline."""
        if (track := self._tracks.get(robot)) is not None:
            self._tracks[robot] = track._replace(heard=-math.inf)

    def forget(self, robot: str) -> None:
        """Drop a robot that is gone for good."""
        self._tracks.pop(robot, None)
        self._states.pop(robot, None)
        self._forgotten.add(robot)

    def hear(self, state: FloorState, now: float) -> None:
        """Take in what a gateway says of a robot that it moves."""
        if state.robot in self._states or len(self._states) < _MOST:
            self._states[state.robot] = state, now

    def knows(self, robot: str) -> bool:
        """Whether it was ever seen, or is told of."""
        return robot in self._tracks or robot in self._states

    def state(self, robot: str, now: float) -> FloorState | None:
        """Return what is said of a robot: what has not been said again for a while is over."""
        found = self._states.get(robot)
        if found is None:
            return None
        state, heard = found
        if state.state != "stands" and now - heard > STATE_S:
            reserved = state.way if state.state == "moves" else ()
            return replace(state, state="stands", way=reserved, waits_for="", why="", ticket=0)
        return state

    def states(self, now: float) -> tuple[FloorState, ...]:
        """Return all that is said."""
        found = (self.state(robot, now) for robot in sorted(self._states))
        return tuple(each for each in found if each is not None)

    def bodies(self, now: float) -> dict[str, Body]:
        """Return all robots whose position is known."""
        return {robot: self._body(robot, track, now) for robot, track in self._tracks.items()}

    def cleared(self, now: float) -> frozenset[str]:
        """Return the robots whose former reservations are over: they are seen to stand, and that is their ground."""
        seen = {body.robot for body in self.bodies(now).values() if body.stands and body.fresh and not body.moved}
        return frozenset(seen | self._forgotten)

    def _body(self, robot: str, track: _Track, now: float) -> Body:
        fresh = now - track.heard <= FRESH_S
        state, heard = self._states.get(robot, (None, -math.inf))
        # Its gateway says that it stands, though it has not been seen to for long.
        told = state is not None and state.state != "moves" and now - heard <= STANDS_S
        stands = not fresh or now - track.since >= STANDS_S or told
        return Body(
            robot=robot,
            at=track.at,
            size=self.size(track.info),
            speed_mps=0.0 if stands else track.speed,
            stands=stands,
            fresh=fresh,
            state=self.state(robot, now),
        )

    def size(self, info: RobotInfo) -> Size:
        """Return how large a robot is: by the configuration, by its own word, or as most are."""
        config, told = self._config, self._config.robots.get(info.id)
        usual = config.drone_radius_m if info.flies else config.radius_m
        height = _DRONE_HEIGHT_M if info.flies else _HEIGHT_M
        return Size(
            radius_m=told.radius_m if told is not None else info.radius_m or usual,
            height_m=told.height_m if told is not None else info.height_m or height,
            margin_m=config.drone_margin_m if info.flies else config.margin_m,
        )

    @staticmethod
    def _tolerance(info: RobotInfo) -> float:
        """What a position varies by of a robot that stands, metres."""
        return 0.5 if info.flies or info.kind == "mavlink" else 0.1
