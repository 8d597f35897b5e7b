"""Robots that write their orders into a file: the effects of a chaos run, counted where they happen.

The file refuses nothing and forgets nothing: each time the robot acts there is one line more. What keeps an effect
from being done twice is the product's own: the desk and ledger of commands that every robot has, known by the command's
id and fenced by its attempt.
"""

import asyncio
import os
import time
from collections.abc import Sequence
from pathlib import Path

import msgspec
from msgspec import Struct

from appliance.model import RobotInfo, keyspace
from appliance.plane.session import Session
from appliance.plane.settings import PlaneConfig
from appliance.robots.executor import CommandExecutor, Done, IdempotencyLog, Verb
from appliance.robots.verbs import PickArgs

STATE_S = 0.5
REMEMBERED = 100_000
"""Commands whose outcome a robot remembers: more than any run makes."""
_FSYNC_EVERY = 50


class Line(Struct, frozen=True):
    """One effect as it happened."""

    entry: str
    robot: str
    at_ns: int


class LedgerFile:
    """The file all ledger robots of a run append to."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = path.open("ab")
        self._lines = 0

    def append(self, line: Line) -> None:
        """Write a line; with the kernel when this returns."""
        self._file.write(msgspec.json.encode(line) + b"\n")
        self._file.flush()
        self._lines += 1
        if self._lines % _FSYNC_EVERY == 0:
            os.fsync(self._file.fileno())

    def close(self) -> None:
        """Close it."""
        self._file.close()

    def read(self) -> list[Line]:
        """Return all lines so far, in order."""
        return [msgspec.json.decode(each, type=Line) for each in self.path.read_bytes().splitlines()]


class LedgerRobot:
    """One robot, a client of the fleet on a session of its own."""

    def __init__(self, name: str, session: Session, file: LedgerFile) -> None:
        self.name = name
        self._session = session
        self._file = file
        self.refused: dict[str, int] = {}
        self.desk = CommandExecutor(
            name,
            session=session,
            ledger=IdempotencyLog(name, limit=REMEMBERED),
            verbs={"pick": Verb(run=self._write)},
            ready=lambda: None,
            halt=self._halt,
            refused=self.refused,
        )
        self._serving = session.serve(
            session.keys(keyspace.COMMAND, name), self.desk.handle, signers=keyspace.COMMAND.asks
        )
        self._token = session.declare_alive(session.keys(keyspace.ROBOT_ALIVE, name))
        self._telling = asyncio.create_task(self._tell(), name=f"state of {name}")

    @classmethod
    async def start(
        cls, name: str, file: LedgerFile, *, fleet: str, connect: Sequence[str], keys: str = ""
    ) -> "LedgerRobot":
        """Connect to the fleet at any of its endpoints; UnreachableError when none answers."""
        config = PlaneConfig(mode="client", connect=tuple(connect), keys=keys)
        return cls(name, await Session.open(config, fleet), file)

    async def _write(self, args: PickArgs) -> Done:
        self._file.append(Line(entry=args.object, robot=self.name, at_ns=time.monotonic_ns()))
        return Done()

    async def _halt(self) -> None:
        return

    async def _tell(self) -> None:
        info = RobotInfo(id=self.name, kind="zenoh", verbs=("pick", "stop"))
        while True:
            self._session.publish(keyspace.ROBOT, info, self.name)
            await asyncio.sleep(STATE_S)

    async def close(self) -> None:
        """Leave the fleet."""
        self._telling.cancel()
        self._serving.close()
        self._token.close()
        await self.desk.close()
        await self._session.close()
