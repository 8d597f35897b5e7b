"""Which commands a robot has taken up and what came of them, so that none is done twice.

A handler that is run again, a query that is repeated after a lost reply, a gateway that died between the two: all
repeat the same command id. An entry is written before the robot moves and completed before the reply is sent.

Rules (pure, `Ledger.decide`):
1. a lower attempt than was seen of that task and subtask is refused: its coordinator has given up on it;
2. an id under way is joined, an id that succeeded is answered with the stored reply;
3. an id that failed is answered the same to the same attempt, and done anew for a higher one;
4. an id taken up before a restart of whoever serves the robot, without an outcome, is resumed where the verb is a
   goal (going somewhere, being landed) and answered as unknown where it is an act (picking, recording).
"""

from collections import OrderedDict
from enum import Enum, auto
from typing import Protocol

import msgspec
import structlog
from msgspec import Struct

from appliance.model import RobotCommand, RobotReply

log = structlog.get_logger(__name__)

MAX_BLOB_BYTES = 64 * 2**20
"""Of all remembered replies of one robot; pictures of the oldest are forgotten first."""


class KeyValues(Protocol):
    """What the ledger needs of the plane's Store."""

    async def put(self, key: str, value: bytes) -> None:
        """Write durably."""
        ...

    async def delete(self, key: str) -> object:
        """Remove."""
        ...

    async def scan(self, prefix: str) -> list[tuple[str, bytes]]:
        """Return keys and values under a prefix."""
        ...


class Entry(Struct, frozen=True, kw_only=True):
    """A command taken up; `reply` is None while it is under way. `number` orders entries by age."""

    number: int
    command: RobotCommand
    reply: RobotReply | None = None


class Verdict(Enum):
    """What to do with a command."""

    NEW = auto()
    """Take it up."""
    ANSWER = auto()
    """Answer with the stored reply."""
    INTERRUPTED = auto()
    """Taken up before a restart, outcome unknown."""
    STALE = auto()
    """A higher attempt has been seen."""


class Ledger:
    """Ledger of one robot: in memory, and in `store` where there is one."""

    def __init__(self, robot: str, store: KeyValues | None = None, *, limit: int = 1000) -> None:
        self._store = store
        self._prefix = f"robots/ledger/{robot}/"
        self._limit = limit
        self._entries: OrderedDict[str, Entry] = OrderedDict()
        self._attempts: OrderedDict[tuple[str, str], int] = OrderedDict()
        self._blob_bytes = 0
        self._next = 0

    def __len__(self) -> int:
        return len(self._entries)

    async def load(self) -> None:
        """Read what an earlier process wrote; an entry that cannot be read is logged and dropped."""
        if self._store is None:
            return
        found: list[Entry] = []
        for key, value in await self._store.scan(self._prefix):
            try:
                found.append(msgspec.json.decode(value, type=Entry))
            except msgspec.DecodeError as error:
                log.warning("ledger entry unreadable, dropped", key=key, error=str(error))
                await self._store.delete(key)
        for entry in sorted(found, key=lambda each: each.number):
            self._remember(entry)
        for identity in self._overflow():
            await self._store.delete(self._prefix + identity)

    def decide(self, command: RobotCommand) -> tuple[Verdict, RobotReply | None]:
        """Say what to do with a command that is not under way; ANSWER comes with the reply."""
        if command.attempt < self.attempt_of(command):
            return Verdict.STALE, None
        entry = self._entries.get(command.id)
        if entry is None:
            return Verdict.NEW, None
        if entry.reply is None:
            return Verdict.INTERRUPTED, None
        if entry.reply.failure is not None and command.attempt > entry.command.attempt:
            return Verdict.NEW, None
        return Verdict.ANSWER, entry.reply

    def attempt_of(self, command: RobotCommand) -> int:
        """Return the highest attempt seen of the command's task and subtask, 0 when none."""
        return self._attempts.get((command.task, command.subtask), 0) if command.task else 0

    def see(self, command: RobotCommand) -> None:
        """Fence off lower attempts from now on, before anything is awaited."""
        if not command.task:
            return
        key = (command.task, command.subtask)
        self._attempts[key] = max(self._attempts.get(key, 0), command.attempt)
        self._attempts.move_to_end(key)
        while len(self._attempts) > self._limit:
            self._attempts.popitem(last=False)

    async def take(self, command: RobotCommand) -> None:
        """Write that the command is taken up; durable when it returns."""
        await self._write(Entry(number=self._next, command=command))

    async def finish(self, command: RobotCommand, reply: RobotReply) -> None:
        """Write the command's outcome; durable when it returns."""
        await self._write(Entry(number=self._next, command=command, reply=reply))

    async def _write(self, entry: Entry) -> None:
        self._remember(entry)
        dropped = self._overflow()
        if self._store is not None:
            await self._store.put(self._prefix + entry.command.id, msgspec.json.encode(entry))
            for identity in dropped:
                await self._store.delete(self._prefix + identity)

    def _remember(self, entry: Entry) -> None:
        self._next = max(self._next, entry.number) + 1
        self._forget(entry.command.id)
        self._entries[entry.command.id] = entry
        self._blob_bytes += _size(entry)
        self.see(entry.command)

    def _forget(self, identity: str) -> None:
        entry = self._entries.pop(identity, None)
        if entry is not None:
            self._blob_bytes -= _size(entry)

    def _overflow(self) -> list[str]:
        """Drop the oldest entries over the bounds, never the newest; return their ids.

        One that is still under way may go too: whoever executes it knows it, and its outcome makes a new entry.
        """
        dropped: list[str] = []
        while len(self._entries) > 1 and (len(self._entries) > self._limit or self._blob_bytes > MAX_BLOB_BYTES):
            identity = next(iter(self._entries))
            self._forget(identity)
            dropped.append(identity)
        return dropped


def _size(entry: Entry) -> int:
    return 0 if entry.reply is None else sum(len(blob) for blob in entry.reply.blobs.values())
