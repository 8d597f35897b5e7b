"""A recorded log in place of a fleet: it fills the store as the plane does, at the moment the playhead is at.

Nothing can be ordered of it. A gateway or robot that was heard regularly and is heard no more is shown as gone, since
presence is no message and so not in a log. `record.player.Playhead` decides which moment is shown.

`Cursor` reads a log up to a moment. A log may be larger than memory and its end may be missing, so it is streamed. To
go back, or far ahead, it is read again from the front without decoding anything: of each key only the last message up
to the moment counts, as it does for the screens, and of what is a stream (log lines, run events) the last lines. It
blocks and is called in a thread. Here too: which logs there are on this machine, and times and rates as people write
them.
"""

import asyncio
import contextlib
import os
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import structlog
from msgspec import Struct, structs

from appliance.client import FleetClient
from appliance.errors import PayloadError, RefusedError
from appliance.model import TaskRecord, keyspace
from appliance.model.keys import fleet_and_rest
from appliance.model.roles import Role
from appliance.plane.session import Closer
from appliance.record.models import LoggedMessage, LogInfo, compile_expression
from appliance.record.player import Playhead
from appliance.record.reader import info, read
from appliance.tui.settings import TuiConfig
from appliance.tui.store import Connection, Store
from appliance.tui.subscriptions import Hearing

RATES = (0.1, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0, 100.0)
"""Log seconds a second."""


def faster(rate: float) -> float:
    """Return the next rate above."""
    return next((each for each in RATES if each > rate), RATES[-1])


def slower(rate: float) -> float:
    """Return the next rate below."""
    return next((each for each in RATES[::-1] if each < rate), RATES[0])


def rate_of(text: str) -> float:
    """Read a rate: `2` or `2x`.

    Raises:
        PayloadError: it is none, or not within `RATES`.
    """
    try:
        rate = float(text.strip().rstrip("x"))
    except ValueError:
        rate = float("nan")
    if not RATES[0] <= rate <= RATES[-1]:
        raise PayloadError(f"{text[:40]!r} is no rate", remedy=f"give {RATES[0]:g} to {RATES[-1]:g}")
    return rate


def seconds_of(text: str, *, at_s: float, length_s: float) -> float:
    """Read a time in a log: `90`, `1:30`, `1:02:03`, `50%`, or `+10` and `-10` from where it is.

    Raises:
        PayloadError: it is none.
    """
    plain = text.strip()
    sign = plain[:1] if plain[:1] in ("+", "-") else ""
    try:
        if plain.endswith("%") and not sign:
            found = float(plain[:-1]) / 100 * length_s
        else:
            found = 0.0
            parts = plain.removeprefix(sign).split(":")
            if len(parts) > 3:
                raise ValueError  # noqa: TRY301 - told below
            if any(not part[:1].isdecimal() for part in parts):
                raise ValueError  # noqa: TRY301 - told below
            for part in parts:
                found = found * 60 + float(part)
    except ValueError:
        found = float("nan")
    if not 0 <= found < 1e12:
        raise PayloadError(f"{text[:40]!r} is no time of a log", remedy="give 90, 1:30, 50 %, or +10 and -10 from here")
    return at_s + (found if sign == "+" else -found) if sign else found


def told(seconds: float) -> str:
    """Return a time of a log for people: minutes and seconds with tenths, hours where there are any."""
    tenths = round(max(0.0, seconds) * 10)
    minutes, rest = divmod(tenths, 600)
    hours, minutes = divmod(minutes, 60)
    clock = f"{minutes:02}:{rest // 10:02}.{rest % 10}"
    return f"{hours}:{clock}" if hours else clock


MOST = 200
"""Files listed, the newest."""
MOST_SEEN = 5000
"""Names looked at in one folder."""
SERVICE = Path("/var/lib/swiftbot/record")


class LogFile(Struct, frozen=True, kw_only=True):
    """A file that may be a log."""

    path: Path
    size: int
    written_s: float


def folders(fleet: str) -> tuple[Path, ...]:
    """Return where logs of a fleet usually are, this folder among them."""
    state = os.environ.get("XDG_STATE_HOME") or str(Path.home() / ".local" / "state")
    return (Path(state) / "swiftbot" / fleet / "record", SERVICE, Path.cwd())


def find_logs(own: Sequence[str], fleet: str) -> list[LogFile]:
    """Return the logs there are, the newest first; folders that cannot be read have none.

    Args:
        own: further folders.
        fleet: whose.
    """
    found: dict[Path, LogFile] = {}
    for folder in (*(Path(each).expanduser() for each in own), *folders(fleet)):
        try:
            with os.scandir(folder) as entries:
                for number, entry in enumerate(entries):
                    if number >= MOST_SEEN:
                        break
                    if entry.name.endswith(".mcap") and entry.is_file():
                        told = entry.stat()
                        path = Path(entry.path)
                        found[path] = LogFile(path=path, size=told.st_size, written_s=told.st_mtime)
        except OSError:
            continue
    return sorted(found.values(), key=lambda each: each.written_s, reverse=True)[:MOST]


MOST_KEYS = 50_000
"""Keys whose last message is kept while seeking; the one not heard for longest goes first."""
MOST_LINES = 2000
"""Messages of streams kept while seeking."""
MOST_BYTES = 256 * 2**20
"""Payloads kept while seeking."""


class Read(Struct, frozen=True, kw_only=True):
    """What was read: messages in the order recorded, the moment they reach up to, whether that is all."""

    messages: tuple[LoggedMessage, ...]
    reached_ns: int
    ended: bool = False
    fresh: bool = False
    """They are the whole state at that moment: what was known before is to be forgotten."""


class Cursor:
    """A place in a log file.

    Args:
        path: the file.
        skip: keys that no screen shows (pictures, raw frames): they are passed over.
        stream: whether a key's messages are a stream, all of which count, and not the latest alone.

    Raises:
        NotFoundError, RecordError: it cannot be read.
    """

    def __init__(self, path: Path, *, skip: Callable[[str], bool], stream: Callable[[str], bool]) -> None:
        self.path = path
        self.about = info(path)
        self.problems: list[str] = []
        """What was found damaged, a sentence each."""
        self._skip = skip
        self._stream = stream
        self._messages: Iterator[LoggedMessage] = iter(())
        self._next: LoggedMessage | None = None
        self.reached_ns = 0
        self._rewind()

    def _rewind(self) -> None:
        self.problems = []
        self._messages = read(self.path, problems=self.problems)
        self._next = next(self._messages, None)
        self.reached_ns = 0

    def on_to(self, at_ns: int, *, most: int) -> Read:
        """Read on, up to a moment or so many messages."""
        found: list[LoggedMessage] = []
        while self._next is not None and self._next.at_ns <= at_ns and len(found) < most:
            if not self._skip(self._next.key):
                found.append(self._next)
            self.reached_ns = max(self.reached_ns, self._next.at_ns)
            self._next = next(self._messages, None)
        if self._next is None or self._next.at_ns > at_ns:
            self.reached_ns = max(self.reached_ns, at_ns)
        return Read(messages=tuple(found), reached_ns=self.reached_ns, ended=self._next is None)

    def to(self, at_ns: int, *, stop: Callable[[], bool] = lambda: False) -> Read:
        """Read from the front up to a moment: the last message of each key, and the last lines of streams.

        Args:
            at_ns: the moment.
            stop: asked now and then; True ends it, with what was read until then.
        """
        self._rewind()
        last: OrderedDict[str, tuple[int, LoggedMessage]] = OrderedDict()
        lines: deque[tuple[int, LoggedMessage]] = deque(maxlen=MOST_LINES)
        number = size = 0
        while self._next is not None and self._next.at_ns <= at_ns:
            message = self._next
            number += 1
            self.reached_ns = max(self.reached_ns, message.at_ns)
            if not self._skip(message.key):
                if self._stream(message.key):
                    lines.append((number, message))
                else:
                    before = last.pop(message.key, None)
                    size += len(message.payload) - (len(before[1].payload) if before else 0)
                    last[message.key] = (number, message)
                    while len(last) > MOST_KEYS or size > MOST_BYTES:
                        size -= len(last.popitem(last=False)[1][1].payload)
            self._next = next(self._messages, None)
            if not number % 4096 and stop():
                break
        else:
            self.reached_ns = max(self.reached_ns, at_ns)
        kept = sorted([*last.values(), *lines], key=lambda each: each[0])
        return Read(
            messages=tuple(message for _, message in kept),
            reached_ns=self.reached_ns,
            ended=self._next is None,
            fresh=True,
        )


log = structlog.get_logger(__name__)

Tap = Callable[[str, int, bytes, bool], None]
"""Takes what is heard: key, Unix nanoseconds, payload, whether it was deleted."""

TICK_S = 0.1
AT_ONCE = 2000
"""Messages put into the store before the screen gets its turn."""
FAR_S = 20.0
"""Further ahead than this is sought for, instead of hearing everything on the way."""
GATEWAY_SILENT_S = 8.0
"""A gateway reports every two seconds, more rarely in large fleets, and then says so."""
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
        if name := fleet_and_rest(channel.key)[0]:
            return name
    return "log"


class ReplayView:
    """A view of a recorded log; made by `open`. It stands still at its beginning."""

    steerable = False
    operator = ""
    role: Role | None = None

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
        """Messages put into the store since it was last reset."""
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
        raise RefusedError("this is a recorded log: nothing can be ordered", remedy="`:live` goes back to the fleet")

    @property
    def moment(self) -> str:
        """Where in the log it is, in words for the header."""
        now = time.monotonic()
        state = "‖" if self.head.paused else "▶"
        at = time.localtime(self.head.position_ns(now) / 1e9)
        return f"{state} {time.strftime('%Y-%m-%d %H:%M:%S', at)} {self.head.rate:g}x"

    # --- what keys do on every screen ------------------------------------------------------------------------------

    def play(self) -> None:
        """Play, or pause."""
        now = time.monotonic()
        self.head.position_ns(now)  # at the end it stands still
        if self.head.paused:
            self.head.play(now)
        else:
            self.head.pause(now, paused=True)

    def step(self, seconds: float) -> None:
        """Go on or back."""
        now = time.monotonic()
        self.head.seek(self.head.position_ns(now) + round(seconds * 1e9), now)

    def seek(self, text: str) -> None:
        """Go to a moment as it is typed; PayloadError when it is none."""
        now = time.monotonic()
        seconds = seconds_of(text, at_s=self.head.position_s(now), length_s=self.head.length_s)
        self.head.seek(self.head.start_ns + round(seconds * 1e9), now)

    def change_rate(self, change: Callable[[float], float]) -> None:
        """Play faster or slower from now on."""
        self.head.set_rate(change(self.head.rate), time.monotonic())

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
        if not message.deleted:
            if (status := keyspace.STATUS.match(message.key)) is not None:
                self._gateways[status[0]] = message.at_ns
            elif (state := keyspace.ROBOT.match(message.key)) is not None:
                self._robots[state[0]] = message.at_ns
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
