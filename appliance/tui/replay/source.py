"""A recorded log in place of a fleet: it fills the store as the plane does, at the moment that the playhead is at.

Nothing can be ordered of it. Whoever was heard regularly and is heard no more (a gateway, a robot) is shown as gone,
since presence is no message and so not in a log.
"""

import asyncio
import contextlib
import time
from collections.abc import Callable
from pathlib import Path

import structlog
from msgspec import structs

from appliance.client import FleetClient
from appliance.errors import RefusedError
from appliance.model import TaskRecord
from appliance.plane.session import Closer
from appliance.record.expressions import compile_expression
from appliance.record.facts import LoggedMessage, LogInfo
from appliance.record.playhead import Playhead
from appliance.tui.hearing import Hearing
from appliance.tui.replay.cursor import Cursor, Read
from appliance.tui.settings import TuiConfig
from appliance.tui.store import Connection, Store

log = structlog.get_logger(__name__)

Tap = Callable[[str, int, bytes, bool], None]
"""Takes what is heard: key, Unix nanoseconds, payload, whether it was deleted."""

TICK_S = 0.1
AT_ONCE = 2000
"""Messages put into the store before the screen gets its turn."""
FAR_S = 20.0
"""Further ahead than this is sought for, instead of hearing everything on the way."""
GATEWAY_SILENT_S = 8.0
"""A gateway tells of itself every two seconds, more rarely in large fleets, and then says so."""
ROBOT_SILENT_S = 10.0

_SKIPPED = compile_expression("swiftbot/*/robot/*/camera"), compile_expression("swiftbot/*/robot/*/mavlink/**")
_STREAMS = tuple(
    compile_expression(each)
    for each in (
        "swiftbot/*/gw/*/log",
        "swiftbot/*/notice/*",
        "swiftbot/*/task/*/run/*",
        "swiftbot/*/task/*/transition",
        "swiftbot/*/gw/*/exchange/*",
        "swiftbot/*/operator/act/*",
    )
)


def skipped(key: str) -> bool:
    """Whether no screen shows messages of a key: pictures and raw frames, which are most of a log's bytes."""
    return any(each.fullmatch(key) for each in _SKIPPED)


def streamed(key: str) -> bool:
    """Whether all messages of a key count, and not the latest alone."""
    return any(each.fullmatch(key) for each in _STREAMS)


def fleet_of(about: LogInfo) -> str:
    """Return whose log it is: by what the recorder wrote down, else by its keys."""
    if name := about.metadata.get("fleet"):
        return name
    for channel in about.channels:
        chunks = channel.key.split("/")
        if chunks[0] == "swiftbot" and len(chunks) > 2:
            return chunks[1]
    return "log"


class ReplayView:
    """A view of a recorded log; made by `open`. It stands still at its beginning."""

    steerable = False
    operator = ""

    def __init__(self, cursor: Cursor, config: TuiConfig | None = None) -> None:
        self.config = config or TuiConfig()
        self.about = cursor.about
        self.fleet = fleet_of(cursor.about)
        self.store = Store(tasks=self.config.tasks, entries=self.config.entries)
        about = cursor.about
        self.head = Playhead(about.start_ns, about.end_ns, rate=1.0, now=time.monotonic(), paused=True)
        self.problem = ""
        """Why it cannot be read on; empty when all is well."""
        self.reading = False
        """Whether it is being read up to a moment far from the last."""
        self.messages = 0
        """Messages put into the store since it was last filled anew."""
        self._cursor = cursor
        self._hearing = Hearing(self.store, self.fleet)
        self._taps: dict[int, tuple[str, Tap]] = {}
        self._gateways: dict[str, int] = {}
        self._robots: dict[str, int] = {}
        self._feeder: asyncio.Task[None] | None = None
        self._shown_ns = -1
        self._stopping = False

    @classmethod
    async def open(cls, path: Path, config: TuiConfig | None = None) -> "ReplayView":
        """Open a log.

        Raises:
            NotFoundError, RecordError: it cannot be read.
        """
        cursor = await asyncio.to_thread(Cursor, path, skip=skipped, stream=streamed)
        return cls(cursor, config)

    @property
    def problems(self) -> tuple[str, ...]:
        """What was found damaged, a sentence each."""
        return (*self.about.problems, *self._cursor.problems)

    @property
    def refused(self) -> int:
        """Messages that could not be decoded."""
        return sum(self._hearing.refused.values())

    async def start(self) -> None:
        """Begin to fill the store."""
        self.store.tell(Connection(connected=True))
        self._stopping = False
        self._feeder = asyncio.create_task(self._feed(), name="replay")

    async def close(self) -> None:
        """End it."""
        self._stopping = True
        if self._feeder is not None:
            self._feeder.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._feeder
            self._feeder = None

    def sync(self) -> None:
        """Nothing is to be taken from elsewhere."""

    def note(self, record: TaskRecord) -> None:
        """Take a record that an order was answered with; there are none here."""

    @property
    def orders(self) -> FleetClient:
        """Raise RefusedError: a log takes no orders."""
        raise RefusedError(
            "this is a recorded log: nothing can be ordered", remedy="`:live` goes back to the fleet that is there"
        )

    def tap(self, expression: str, take: Tap) -> Closer:
        """Have all messages of matching keys delivered as they are played."""
        number = max(self._taps, default=0) + 1
        self._taps[number] = (expression, take)
        return Closer(lambda: self._taps.pop(number, None) and None)

    # --- filling the store ---------------------------------------------------------------------------------------

    async def _feed(self) -> None:
        while True:
            try:
                await self._feed_once()
                self.problem = ""
            except Exception as error:  # supervision boundary: the screen must say that nothing is read any more
                log.exception("the log could not be read on")
                self.problem = f"{type(error).__name__}: {error}"
                self.head.pause(time.monotonic(), paused=True)
            await asyncio.sleep(TICK_S)

    async def _feed_once(self) -> None:
        wanted = self.head.position_ns(time.monotonic())
        if wanted == self._shown_ns:
            return
        reached = self._cursor.reached_ns
        if self._shown_ns < 0 or wanted < self._shown_ns or wanted - reached > FAR_S * 1e9:
            self.reading = True
            try:
                read = await self._read_to(wanted)
            finally:
                self.reading = False
        else:
            read = await asyncio.to_thread(self._cursor.on_to, wanted, most=AT_ONCE)
        await self._take(read)
        self._shown_ns = read.reached_ns
        self.head.hold(read.reached_ns, time.monotonic())
        self._mark_silent(read.reached_ns)

    async def _read_to(self, wanted: int) -> Read:
        """Read the state at a moment; while it is read another moment may be wanted, which ends this one."""

        def stop() -> bool:
            return self._stopping or self.head.position_ns(time.monotonic()) < wanted

        return await asyncio.to_thread(self._cursor.to, wanted, stop=stop)

    async def _take(self, read: Read) -> None:
        if read.fresh:
            self.store.forget_all()
            self.store.tell(Connection(connected=True))
            self._gateways.clear()
            self._robots.clear()
            self.messages = 0
        for number, message in enumerate(read.messages, start=1):
            self._hear(message)
            if not number % 200:
                await asyncio.sleep(0)

    def _hear(self, message: LoggedMessage) -> None:
        self.messages += 1
        self._hearing.hear(message.key, message.payload, message.at_ns, deleted=message.deleted)
        chunks = message.key.split("/")
        if len(chunks) == 5 and not message.deleted:
            if chunks[2] == "gw" and chunks[4] == "status":
                self._gateways[chunks[3]] = message.at_ns
            elif chunks[2] == "robot" and chunks[4] == "state":
                self._robots[chunks[3]] = message.at_ns
        for expression, take in tuple(self._taps.values()):
            if compile_expression(expression).fullmatch(message.key):
                take(message.key, message.at_ns, message.payload, message.deleted)

    def _mark_silent(self, now_ns: int) -> None:
        for name, heard_ns in self._gateways.items():
            known = self.store.gateways.get(name)
            if known is None or known.lost_ns:
                continue
            patience_s = max(GATEWAY_SILENT_S, 3e-3 * known.status.again_ms)
            if now_ns - heard_ns > patience_s * 1e9:
                self.store.gateways.put(name, structs.replace(known, lost_ns=heard_ns))
        for name, heard_ns in self._robots.items():
            robot = self.store.robots.get(name)
            if robot is not None and robot.online and now_ns - heard_ns > ROBOT_SILENT_S * 1e9:
                self.store.robots.put(name, structs.replace(robot, online=False))
