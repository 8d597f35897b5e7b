"""The robots of the fleet, as they or their gateways describe them; one that is gone is shown offline for a while."""

import asyncio
import contextlib
import time
from collections.abc import Callable, Iterable

import msgspec
from msgspec.structs import replace

from appliance.model import RobotInfo
from appliance.model.plausible import plausible, read_robot
from appliance.plane.session import Closer, Message, Session

ROBOT_KEPT_S = 300.0
"""How long a robot that went offline is still shown."""
MOST_ROBOTS = 10_000
"""Bound on what is believed."""
_TICK_S = 5.0


class Roster:
    """What is known of robots just now; `on_change` is called when it is something else than before."""

    def __init__(self, session: Session, *, on_change: Callable[[], None]) -> None:
        self.robots: dict[str, RobotInfo] = {}
        self._session = session
        self._on_change = on_change
        self._gone: dict[str, float] = {}
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
            if robot.id not in self.robots and len(self.robots) < MOST_ROBOTS:
                self.robots[robot.id] = self._believed(robot)
                if not robot.online:
                    self._gone[robot.id] = time.monotonic()
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

    def _on_robot(self, key: str, info: RobotInfo | None) -> None:
        robot = key.split("/")[-2]
        if info is None:
            # Somebody removed its row: a robot that is merely gone is put as offline, or its token ends.
            self._gone.pop(robot, None)
            if self.robots.pop(robot, None) is not None:
                self._on_change()
            return
        if info.id != robot:
            self._session.refuse("misplaced robot/*/state", key=key, says=info.id)
            return
        if robot not in self.robots and len(self.robots) >= MOST_ROBOTS:
            self._session.refuse("too many robot/*/state", key=key)
            return
        before, info = self.robots.get(robot), self._believed(info)
        self.robots[robot] = info
        if info.online:
            self._gone.pop(robot, None)
        else:
            self._gone.setdefault(robot, time.monotonic())
        if before != info:
            self._on_change()

    def _on_alive(self, key: str, alive: bool) -> None:
        if not alive:
            self._lose(key.split("/")[-2])

    def _lose(self, robot: str) -> None:
        info = self.robots.get(robot)
        if info is not None and info.online:
            self.robots[robot] = replace(info, online=False)
            self._gone[robot] = time.monotonic()
            self._on_change()

    async def _keep_sweeping(self) -> None:
        while True:
            await asyncio.sleep(_TICK_S)
            before = time.monotonic() - ROBOT_KEPT_S
            for robot in [each for each, since in self._gone.items() if since < before]:
                del self._gone[robot]
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
