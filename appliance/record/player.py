"""Plays logs onto the plane: what was put then is put again, in its order and at its pace.

Played is what was said, not what was decided: every listener (the terminal UI, Foxglove, a program of one's own) sees
the fleet of the log. So the keys are those of another fleet (`replay` unless told otherwise), and what would make
somebody act is left out: requests for tasks, triggers of recorders. The gateways and robots of the log are shown as
present while they speak in it, since listeners believe nobody else.

`Playhead` is the playback clock, a pure function of the clock that is passed in: `position(now) = mark + (now - since)
· rate`, where `mark` and `since` are set again whenever the rate changes, the replay is paused or goes on, or jumps. A
rate of 0 means as fast as the listener takes it: then the position is wherever the last message was. Logs that are
played onto the plane and those on the screens go by the same.
"""

import asyncio
import contextlib
import heapq
import re
import time
from collections.abc import AsyncGenerator, Callable, Iterator, Sequence
from pathlib import Path

from msgspec import Struct

from appliance.errors import ConfigError
from appliance.model import keyspace
from appliance.model.keys import Keys
from appliance.model.recorder_api import Clock
from appliance.plane.session import Closer, Session
from appliance.record.edit import Select, span
from appliance.record.models import LoggedMessage, compile_expression
from appliance.record.reader import read

SLOWEST, FASTEST = 0.01, 1000.0


class Playhead:
    """Between the log's nanoseconds and the clock's seconds.

    Args:
        start_ns: time in the log to begin at; nothing is before it.
        end_ns: time at which it stands still; None: it goes on.
        rate: seconds of the log a second; 0: as fast as possible.
        now: the clock.
        paused: begin standing still.
    """

    def __init__(
        self, start_ns: int, end_ns: int | None = None, *, rate: float, now: float, paused: bool = False
    ) -> None:
        self.start_ns = start_ns
        self.end_ns = None if end_ns is None else max(start_ns, end_ns)
        self._mark_ns = start_ns
        self._since = now
        self._rate = rate
        self._paused = paused

    @property
    def paused(self) -> bool:
        """Whether it stands still."""
        return self._paused

    @property
    def rate(self) -> float:
        """Seconds of the log a second; 0: as fast as possible."""
        return self._rate

    def position_ns(self, now: float) -> int:
        """Return the time in the log at a reading of the clock."""
        if self._paused or not self._rate:
            return self._mark_ns
        at_ns = self._mark_ns + round((now - self._since) * self._rate * 1e9)
        if self.end_ns is None or at_ns < self.end_ns:
            return at_ns
        self._mark_ns, self._paused = self.end_ns, True
        return self.end_ns

    @property
    def length_s(self) -> float:
        """Seconds from the start to the end; 0 without one."""
        return 0.0 if self.end_ns is None else (self.end_ns - self.start_ns) / 1e9

    def position_s(self, now: float) -> float:
        """Return the position as seconds from the start."""
        return (self.position_ns(now) - self.start_ns) / 1e9

    def delay_s(self, at_ns: int, now: float) -> float | None:
        """Return how long until a message of the log is due, 0 when it is; None while paused."""
        if self._paused:
            return None
        if not self._rate:
            return 0.0
        return max(0.0, (at_ns - self.position_ns(now)) / 1e9 / self._rate)

    def reached(self, at_ns: int) -> None:
        """Note that a message was played: without a rate that is where it is."""
        if not self._rate:
            self._mark_ns = max(self._mark_ns, at_ns)

    def pause(self, now: float, *, paused: bool) -> None:
        """Stand still, or go on from there."""
        self._mark_ns, self._since = self.position_ns(now), now
        self._paused = paused

    def play(self, now: float) -> None:
        """Go on from there; at the end from the start."""
        if self.position_ns(now) == self.end_ns:
            self.seek(self.start_ns, now)
        self.pause(now, paused=False)

    def hold(self, at_ns: int, now: float) -> None:
        """Take it that messages could be read up to `at_ns` only: the clock waits for them."""
        if not self._paused and self.position_ns(now) > at_ns:
            self.seek(at_ns, now)

    def set_rate(self, rate: float, now: float) -> None:
        """Go on at another rate, kept within bounds; 0 is as fast as possible."""
        self._mark_ns, self._since = self.position_ns(now), now
        self._rate = min(FASTEST, max(SLOWEST, rate)) if rate else 0.0

    def seek(self, to_ns: int, now: float) -> None:
        """Jump, within the bounds; it goes on from there if it did before."""
        self.position_ns(now)
        latest_ns = to_ns if self.end_ns is None else min(to_ns, self.end_ns)
        self._mark_ns, self._since = max(self.start_ns, latest_ns), now


CLOCK_S = 0.1
"""How often the clock is put."""
SILENT_NS = 10 * 10**9
"""A gateway that says nothing for so long in the log is gone: a status comes every few seconds."""
MOST_UNSENT = 5_000
"""Messages waiting to be sent, beyond which a replay at full speed holds its breath."""
_ORDERS = (
    "swiftbot/*/operator/stop/*",
    "swiftbot/*/operator/resume/*",
    "swiftbot/*/operator/lease/*",
    "swiftbot/*/robot/*/task",
    "swiftbot/*/recorder/*/trigger",
    "swiftbot/*/recorder/replay/clock",
)
_KEY = re.compile(r"[^\s*$?#]{1,1000}")
_FOREIGN = re.compile(r"[*$?#]")
_FLEET_CHUNKS = 2


class PlayOptions(Struct, frozen=True, kw_only=True):
    """How logs are played. Times are Unix nanoseconds of the log."""

    select: Select = Select()
    rate: float = 1.0
    """0: as fast as the listeners take it."""
    loop: bool = False
    paused: bool = False
    """Begin standing still."""
    remap: tuple[tuple[str, str], ...] = ()
    """Beginning of a key, in whole chunks, and what takes its place; the first that fits."""
    orders: bool = False
    """Play requests for tasks and triggers too: listeners will act on them."""
    clock: bool = True
    presence: bool = True


class Played(Struct, frozen=True, kw_only=True):
    """What came of a replay."""

    messages: int
    left_out: int
    """Orders, which were not played."""
    rounds: int
    position_ns: int
    """Time in the log of the last message played."""
    ended: bool
    """Whether it came to its end, and was not stopped."""
    took_s: float
    problems: tuple[str, ...] = ()
    """What was damaged in the logs."""


def parse_remap(texts: Sequence[str]) -> tuple[tuple[str, str], ...]:
    """Return rules of `FROM=TO`; ConfigError names one that is none."""
    rules: list[tuple[str, str]] = []
    for text in texts:
        old, separator, new = text.partition("=")
        old, new = old.strip("/"), new.strip("/")
        if not separator or not _KEY.fullmatch(old) or not _KEY.fullmatch(new):
            raise ConfigError(
                f"--remap {text[:80]!r} is no rule",
                remedy="write FROM=TO, such as swiftbot/demo/robot/r1=swiftbot/replay/robot/r2",
            )
        rules.append((old, new))
    return tuple(rules)


def remapped(key: str, rules: Sequence[tuple[str, str]], fleet: str) -> str:
    """Return the key to play on: by the first rule that fits, else the same below the fleet that is played onto."""
    for old, new in rules:
        if key == old or key.startswith(old + "/"):
            return new + key[len(old) :]
    chunks = key.split("/", _FLEET_CHUNKS)
    if len(chunks) > _FLEET_CHUNKS and chunks[0] == "swiftbot":
        return f"swiftbot/{fleet}/{chunks[_FLEET_CHUNKS]}"
    # Of another writer: what Zenoh has no room for in a key is left out.
    return "/".join(_FOREIGN.sub("_", chunk) for chunk in key.split("/") if chunk) or "_"


def in_order(paths: Sequence[Path], select: Select, problems: list[str]) -> Iterator[LoggedMessage]:
    """Yield the selected messages of some logs by time; each file's own order stays."""

    def one(index: int, path: Path) -> Iterator[tuple[int, int, int, LoggedMessage]]:
        match, latest = select.matcher(), 0
        found: list[str] = []
        for place, message in enumerate(read(path, problems=found)):
            if select.within(message.at_ns) and match(message.key):
                latest = max(latest, message.at_ns)
                yield latest, index, place, message
        problems.extend(f"{path.name}: {each}" for each in found if len(problems) < 100)

    merged = heapq.merge(*(one(index, path) for index, path in enumerate(paths)), key=lambda each: each[:3])
    return (message for _, _, _, message in merged)


class Player:
    """One replay. Its methods may be called while it plays.

    Args:
        session: where it is put; its fleet is the one played onto.
        paths: the logs.
        options: how.
        told: called with position and messages played, some times a second.

    Raises:
        NotFoundError, RecordError: as `reader.info`.
    """

    def __init__(
        self,
        session: Session,
        paths: Sequence[Path],
        options: PlayOptions,
        *,
        told: Callable[[int, int], None] = lambda _position_ns, _messages: None,
    ) -> None:
        start_ns, end_ns = span(paths)
        select = options.select
        self.start_ns = start_ns if select.since_ns is None else max(start_ns, select.since_ns)
        self.end_ns = end_ns if select.until_ns is None else min(end_ns, select.until_ns)
        self._session, self._paths, self._options, self._told = session, paths, options, told
        self._head = Playhead(self.start_ns, rate=options.rate, now=time.monotonic(), paused=options.paused)
        self._changed = asyncio.Event()
        self._stopped = False
        self._sought: int | None = None
        self._steps = 0
        self._presence = _Presence(session) if options.presence else None
        self._orders = [compile_expression(each) for each in _ORDERS]
        self._messages = self._left_out = self._rounds = 0
        self._position_ns = self.start_ns

    # --- by hand ----------------------------------------------------------------------------------------------

    def on_told(self, told: Callable[[int, int], None]) -> None:
        """Have position and messages played told to somebody else from now on."""
        self._told = told

    @property
    def head(self) -> Playhead:
        """Where it is, how fast, and whether it stands."""
        return self._head

    def stop(self) -> None:
        """End it."""
        self._stopped = True
        self._changed.set()

    def pause(self, *, paused: bool) -> None:
        """Stand still, or go on."""
        self._head.pause(time.monotonic(), paused=paused)
        self._changed.set()

    def set_rate(self, rate: float) -> None:
        """Go on at another rate."""
        self._head.set_rate(rate, time.monotonic())
        self._changed.set()

    def seek(self, to_ns: int) -> None:
        """Go on from another time in the log; what lies between is not played."""
        self._sought = min(self.end_ns, max(self.start_ns, to_ns))
        self._changed.set()

    def step(self) -> None:
        """While it stands: play one message."""
        self._steps += 1
        self._changed.set()

    # --- playing ----------------------------------------------------------------------------------------------

    async def play(self) -> Played:
        """Play to the end, or until it is stopped.

        Raises:
            RecordError: a log is no MCAP file. Damage within one is passed over, and told in the result.
        """
        began = time.monotonic()
        problems: list[str] = []
        async with self._clock():
            begin_ns, ended = self.start_ns, False
            while not self._stopped:
                if not begin_ns > self.start_ns:
                    self._rounds += 1
                sought = await self._round(begin_ns, problems)
                if sought is not None:
                    begin_ns = sought
                    self._head.seek(sought, time.monotonic())
                    continue
                ended = not self._stopped
                if not self._options.loop or not self._messages:
                    break
                begin_ns = self.start_ns
                self._head.seek(begin_ns, time.monotonic())
            await self._sent(0)
        if self._presence is not None:
            self._presence.close()
        return Played(
            messages=self._messages,
            left_out=self._left_out,
            rounds=self._rounds,
            position_ns=self._position_ns,
            ended=ended,
            took_s=round(time.monotonic() - began, 3),
            problems=tuple(dict.fromkeys(problems)),
        )

    async def _round(self, begin_ns: int, problems: list[str]) -> int | None:
        """Play from a time to the end; returns where to go on instead, when somebody has jumped."""
        for number, message in enumerate(in_order(self._paths, self._options.select, problems)):
            if message.at_ns < begin_ns:
                if number % 2_000 == 0:
                    await asyncio.sleep(0)
                continue
            await self._due(message.at_ns)
            if self._stopped:
                return None
            if self._sought is not None:
                sought, self._sought = self._sought, None
                return sought
            self._put(message)
            if self._session.unsent > MOST_UNSENT:
                await self._sent(MOST_UNSENT // 2)
            elif number % 200 == 0:
                await asyncio.sleep(0)
        return None

    async def _due(self, at_ns: int) -> None:
        """Wait until a message is due, or something else is wanted."""
        while not self._stopped and self._sought is None:
            self._changed.clear()
            delay_s = self._head.delay_s(at_ns, time.monotonic())
            if delay_s == 0.0:
                return
            if delay_s is None and self._steps:
                self._steps -= 1
                self._head.seek(at_ns, time.monotonic())
                return
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(delay_s):
                    await self._changed.wait()

    async def _sent(self, most: int) -> None:
        while self._session.unsent > most and not self._stopped:  # noqa: ASYNC110 - see below
            await asyncio.sleep(0.005)  # Zenoh tells nobody when it has sent

    def _put(self, message: LoggedMessage) -> None:
        self._position_ns = message.at_ns
        self._head.reached(message.at_ns)
        key = remapped(message.key, self._options.remap, self._session.keys.fleet)
        if not self._options.orders and any(each.fullmatch(one) for each in self._orders for one in (message.key, key)):
            self._left_out += 1
            return
        if self._presence is not None:
            self._presence.heard(key, message)
        if message.deleted:
            self._session.delete(key)
        else:
            self._session.put(key, message.payload, encoding=message.encoding or "zenoh/bytes")
        self._messages += 1
        if self._messages % 500 == 0:
            self._told(self._position_ns, self._messages)

    @contextlib.asynccontextmanager
    async def _clock(self) -> AsyncGenerator[None]:
        def put(*, ended: bool = False) -> None:
            position_ns = self._head.position_ns(time.monotonic())
            position_ns = min(self.end_ns, max(self.start_ns, position_ns))
            self._told(position_ns, self._messages)
            if self._options.clock:
                clock = Clock(at_ns=position_ns, rate=self._head.rate, paused=self._head.paused, ended=ended)
                self._session.publish(keyspace.REPLAY_CLOCK, clock)

        async def tick() -> None:
            while True:
                put()
                await asyncio.sleep(CLOCK_S)

        ticking = asyncio.create_task(tick(), name="clock of a replay")
        try:
            yield
        finally:
            ticking.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await ticking
            put(ended=True)


class _Presence:
    """Shows the gateways and robots of the log as present while they speak in it."""

    def __init__(self, session: Session) -> None:
        self._session = session
        keys: Keys = session.keys
        self._statuses, self._robots = (
            compile_expression(keys(keyspace.STATUS)),
            compile_expression(keys(keyspace.ROBOT)),
        )
        self._shown: dict[str, tuple[Closer, int]] = {}
        self._looked_ns = 0

    def heard(self, key: str, message: LoggedMessage) -> None:
        token = ""
        if self._statuses.fullmatch(key):
            token = self._session.keys(keyspace.GATEWAY_ALIVE, *keyspace.STATUS.names(key))
        elif self._robots.fullmatch(key):
            token = self._session.keys(keyspace.ROBOT_ALIVE, *keyspace.ROBOT.names(key))
        at_ns = message.at_ns
        if token:
            shown = self._shown.get(token)
            closer = shown[0] if shown else self._session.declare_alive(token)
            self._shown[token] = (closer, at_ns)
        if abs(at_ns - self._looked_ns) > SILENT_NS // 10:
            self._looked_ns = at_ns
            for each, (closer, last_ns) in list(self._shown.items()):
                if abs(at_ns - last_ns) > SILENT_NS:
                    closer.close()
                    del self._shown[each]

    def close(self) -> None:
        for closer, _ in self._shown.values():
            closer.close()
        self._shown.clear()


def check_rate(rate: float) -> float:
    """Return a rate that can be played; ConfigError otherwise."""
    if not 0.0 <= rate <= 1000.0:
        raise ConfigError(f"--rate {rate:g}", remedy="give 0 (as fast as possible) to 1000")
    return rate
