"""The robots of the fleet, as they or their gateways describe them; one that is gone is shown offline for a while."""

import asyncio
import contextlib
import time
from collections.abc import Callable, Iterable

import msgspec
from msgspec.structs import replace

from appliance.errors import PayloadError
from appliance.model import RobotInfo
from appliance.model.plausible import plausible, read_robot
from appliance.plane.keys import check_name
from appliance.plane.session import Closer, Message, Session

ROBOT_KEPT_S = 300.0
"""How long a robot that went offline is still shown."""
MOST_ROBOTS = 10_000
"""Bound on what is believed."""
SPEAKER_S = 3.0
"""A robot that has said nothing for so long may be followed by another of its name, such as itself after a restart."""
RIVAL_S = 15.0
"""How long it is shown that a second one used the name."""
_TICK_S = 5.0


class Roster:
    """What is known of robots just now; `on_change` is called when it is something else than before."""

    def __init__(self, session: Session, *, on_change: Callable[[], None]) -> None:
        self.robots: dict[str, RobotInfo] = {}
        self._session = session
        self._on_change = on_change
        self.lost_ns: dict[str, int] = {}
        """When each robot that is offline was lost, Unix nanoseconds by this machine's clock, also without its row."""
        self._gone: dict[str, float] = {}
        self._speakers: dict[str, tuple[str, float]] = {}
        """Who speaks for each name, and when it did last."""
        self._rivals: dict[str, float] = {}
        """When another was last heard that uses the name."""
        self._closers: list[Closer] = []
        self._sweeping: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Begin to listen."""
        session, keys = self._session, self._session.keys
        self._closers = [
            session.subscribe(keys.robot(), self._heard),
            session.watch_alive(keys.robot_alive(), self._on_alive),
        ]
        self._sweeping = asyncio.create_task(self._keep_sweeping(), name="roster")

    def take(self, robots: Iterable[RobotInfo]) -> None:
        """Learn of robots from a gateway that knows them; what they said themselves is newer."""
        for robot in robots:
            if robot.id not in self.robots and len(self.robots) < MOST_ROBOTS and self._named(robot.id):
                self.robots[robot.id] = self._believed(robot)
                if not robot.online:
                    self._went(robot.id)
                self._on_change()

    def _heard(self, message: Message) -> None:
        info = None
        if not message.deleted:
            try:
                info = read_robot(message.payload)
            except msgspec.DecodeError as error:
                self._session.refuse("malformed robot/*/state", key=message.key, reason=str(error))
                return
        self._on_robot(message.key, info)

    def _believed(self, info: RobotInfo) -> RobotInfo:
        """Return a robot's state without numbers that cannot be, which are counted."""
        believed, dropped = plausible(info)
        if dropped:
            self._session.refuse("implausible robot/*/state", robot=info.id, left_out=", ".join(dropped))
        return believed

    def _named(self, robot: str) -> bool:
        """Whether it is a name that a robot may have: `*` on a key would be all of them, and so would its commands."""
        try:
            check_name(robot, "robot")
        except PayloadError as error:
            self._session.refuse("misnamed robot/*/state", reason=error.message)
            return False
        return True

    def doubtful(self, robot: str) -> bool:
        """Whether more than one may carry out what this robot is ordered: they have to be counted first."""
        info = self.robots.get(robot)
        if info is None or info.gateway:
            return False  # its gateway sees to it that it is one
        return not info.speaker or self._contested(robot)

    def _contested(self, robot: str) -> bool:
        return time.monotonic() - self._rivals.get(robot, -RIVAL_S) < RIVAL_S

    def _heeded(self, info: RobotInfo) -> bool:
        """Whether this one speaks for its name: the older one of two does, in every roster."""
        if not info.speaker:
            return True
        now = time.monotonic()
        speaker, heard_at = self._speakers.get(info.id, (info.speaker, now))
        if speaker != info.speaker and now - heard_at < SPEAKER_S:
            self._session.refuse("namesake robot/*/state", robot=info.id)
            self._rivals[info.id] = now
            if speaker < info.speaker:
                return False
        elif speaker != info.speaker:
            self._rivals.pop(info.id, None)
        self._speakers[info.id] = (info.speaker, now)
        return True

    def _on_robot(self, key: str, info: RobotInfo | None) -> None:
        robot = key.split("/")[-2]
        if info is None:
            # Somebody removed its row: a robot that is merely gone is put as offline, or its token ends.
            self._gone.pop(robot, None)
            self.lost_ns.pop(robot, None)
            self._speakers.pop(robot, None)
            self._rivals.pop(robot, None)
            if self.robots.pop(robot, None) is not None:
                self._on_change()
            return
        if info.id != robot:
            self._session.refuse("misplaced robot/*/state", key=key, says=info.id)
            return
        if not self._named(robot):
            return
        if robot not in self.robots and len(self.robots) >= MOST_ROBOTS:
            self._session.refuse("too many robot/*/state", key=key)
            return
        before, info = self.robots.get(robot), self._believed(info)
        if not self._heeded(info):
            return
        if self._contested(robot):
            note = f"another robot calls itself {robot}: give it a name of its own"
            info = replace(info, note=f"{note}; {info.note}" if info.note else note)
        self.robots[robot] = info
        if info.online:
            self._gone.pop(robot, None)
            self.lost_ns.pop(robot, None)
        else:
            self._went(robot)
        if before != info:
            self._on_change()

    def _on_alive(self, key: str, alive: bool) -> None:
        if not alive:
            self._lose(key.split("/")[-2])

    def _lose(self, robot: str) -> None:
        info = self.robots.get(robot)
        if info is not None and info.online:
            self.robots[robot] = replace(info, online=False)
            self._went(robot)
            self._on_change()

    def _went(self, robot: str) -> None:
        """Note that a robot is offline from now on, unless it was before."""
        self._gone.setdefault(robot, time.monotonic())
        self.lost_ns.setdefault(robot, time.time_ns())
        while len(self.lost_ns) > MOST_ROBOTS:
            del self.lost_ns[next(iter(self.lost_ns))]

    async def _keep_sweeping(self) -> None:
        while True:
            await asyncio.sleep(_TICK_S)
            before = time.monotonic() - ROBOT_KEPT_S
            for robot in [each for each, since in self._gone.items() if since < before]:
                del self._gone[robot]
                self._speakers.pop(robot, None)
                self._rivals.pop(robot, None)
                self.robots.pop(robot, None)
                self._on_change()

    async def close(self) -> None:
        """Listen no more."""
        for closer in self._closers:
            closer.close()
        if self._sweeping is not None:
            self._sweeping.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await asyncio.gather(self._sweeping, return_exceptions=True)
