"""Backfill: fetches the messages that the recorder missed while it was not linked, and puts them in their place.

Each session numbers what it puts and keeps what it has put lately (`plane.backlog`). `Follower` follows those numbers:
messages of a session that come behind a hole wait until the hole is filled or given up, so that the log has a session's
messages in its order; other sessions' messages do not wait for them. It is pure state: no clock, no I/O. `CatchingUp`
asks the sessions for what is missing. What came before the recorder heard a session for the first time is asked for
too, from the moment the recorder began; after a restart, from the moment its last file ends.
"""

import asyncio
import contextlib
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Container, Iterable, Mapping
from pathlib import Path

import msgspec
import structlog
from mcap.exceptions import McapError
from mcap.reader import make_reader
from msgspec import Struct

from appliance.background import Background
from appliance.errors import PayloadError, RecordError, SwiftbotError, UnreachableError
from appliance.model import keyspace
from appliance.plane.backlog import UNKNOWN, BacklogAsk, Backlogged, after, moved
from appliance.plane.session import Session
from appliance.record.models import LoggedMessage
from appliance.record.reader import info, logged, read

MOST_SESSIONS = 20_000
"""Sessions that are followed; the one that was silent for longest is forgotten first."""
MOST_HELD, MOST_HELD_BYTES = 20_000, 32 * 2**20
"""What waits behind the hole of one session; beyond that the hole is given up."""
_FAR = 2**30
"""So far back it is asked for what a session put before it was heard of."""


class Hole(Struct, frozen=True):
    """Numbers `first` to `last` of a session are missing. `fresh`: nothing of that session was heard before."""

    source: str
    first: int
    last: int
    fresh: bool = False

    @property
    def count(self) -> int:
        """How many."""
        return after(self.last, self.first) + 1


class Lost(Struct, frozen=True):
    """So many messages of a session stay missing, by kind of key."""

    source: str
    keys: dict[str, int]
    at_ns: int


class Taken(Struct):
    """What follows from messages: those to log, in order, holes to ask about, and what is lost."""

    messages: list[LoggedMessage]
    holes: list[Hole]
    lost: list[Lost]


class _Session(Struct):
    last: int
    hole: Hole | None = None
    held: list[LoggedMessage] = []
    held_bytes: int = 0
    lost: set[int] = set()
    """Numbers that were given up, and may yet come."""


class Follower:
    """Follows all sessions of a fleet."""

    def __init__(self) -> None:
        self._sessions: OrderedDict[str, _Session] = OrderedDict()

    def take(self, messages: Iterable[LoggedMessage]) -> Taken:
        """Take messages as they came."""
        out = Taken([], [], [])
        for message in messages:
            if message.source and message.number:
                self._take(message, out)
            else:
                out.messages.append(message)
        return out

    def fill(self, hole: Hole, found: Iterable[LoggedMessage], lost: Mapping[str, int]) -> Taken:
        """End a hole with what was found of it, in order of its numbers, and let those go on that wait behind it.

        Args:
            hole: as it was told.
            found: of its numbers; others are left out.
            lost: what stays missing, by kind of key.
        """
        out = Taken([], [], [])
        session = self._sessions.get(hole.source)
        if session is None or session.hole != hole:
            return out  # it was given up
        fitting = (each for each in found if after(each.number, hole.first) >= 0 and after(hole.last, each.number) >= 0)
        out.messages += sorted(fitting, key=lambda each: after(each.number, hole.first))
        held, session.held, session.held_bytes = session.held, [], 0
        session.hole, session.last = None, hole.last
        if lost:
            there = {each.number for each in out.messages}
            if hole.count <= MOST_HELD:
                numbers = (moved(hole.first, offset) for offset in range(hole.count))
                session.lost = {number for number in numbers if number not in there}
            out.lost.append(Lost(hole.source, dict(lost), held[0].at_ns if held else 0))
        for message in held:
            self._take(message, out)
        return out

    def give_up(self, hole: Hole) -> Taken:
        """End a hole of which nothing can be learned: its session has gone, or keeps nothing.

        What was before the first message of a session that was not known is nobody's loss for all that is known.
        """
        return self.fill(hole, (), {} if hole.fresh else {UNKNOWN: hole.count})

    def give_all_up(self) -> Taken:
        """End all holes: recording ends."""
        out = Taken([], [], [])
        for session in list(self._sessions.values()):
            while session.hole is not None:
                found = self.give_up(session.hole)
                out.messages += found.messages
                out.lost += found.lost
        return out

    def _take(self, message: LoggedMessage, out: Taken) -> None:
        session = self._sessions.get(message.source)
        if session is None:
            session = self._sessions[message.source] = _Session(last=0)
            if message.number != 1:
                first = max(1, message.number - _FAR)
                self._open(session, Hole(message.source, first, message.number - 1, fresh=True), message, out)
            else:
                session.last = 1
                out.messages.append(message)
            self._bound()
            return
        self._sessions.move_to_end(message.source)
        if session.hole is not None:
            self._hold(session, message, out)
            return
        ahead = after(message.number, session.last)
        if ahead == 1:
            session.last = message.number
            out.messages.append(message)
        elif ahead > 1:
            hole = Hole(message.source, moved(session.last, 1), moved(message.number, -1))
            self._open(session, hole, message, out)
        elif message.number in session.lost:
            session.lost.discard(message.number)  # counted as lost, and here after all: the log has it
            out.messages.append(message)
        # Otherwise it is there already: fetched, and then delivered all the same.

    def _open(self, session: _Session, hole: Hole, message: LoggedMessage, out: Taken) -> None:
        session.hole, session.held, session.held_bytes = hole, [message], len(message.payload)
        out.holes.append(hole)

    def _hold(self, session: _Session, message: LoggedMessage, out: Taken) -> None:
        session.held.append(message)
        session.held_bytes += len(message.payload)
        hole = session.hole
        if hole is not None and (len(session.held) > MOST_HELD or session.held_bytes > MOST_HELD_BYTES):
            ended = self.give_up(hole)
            out.messages += ended.messages
            out.holes += ended.holes
            out.lost += ended.lost

    def _bound(self) -> None:
        while len(self._sessions) > MOST_SESSIONS:
            # One with a hole has messages that wait: it is at work, and stays.
            oldest = next((name for name, each in self._sessions.items() if each.hole is None), None)
            if oldest is None:
                return
            del self._sessions[oldest]


log = structlog.get_logger(__name__)

_TIMEOUT_S = 2.0
_TRIES = 3
_PAUSE_S = 0.2
"""Between two tries: a session that has just been linked is not known to serve anything yet."""
_AT_ONCE = 8
"""Sessions that are asked at the same time: the fleet of a router that was restarted comes back together."""
_END_S = 2.0
_SKEW_NS = 2 * 10**9
"""Sessions' messages stand in a log by arrival: so far before its end one of another session may be missing."""
_MOST_UNFINISHED = 64 * 2**20
"""Bytes of a file without an index that are read for its end; some 3 s."""


class Tail(Struct, frozen=True):
    """What the log has already: everything before `since_ns`, and `seen` (key and time) after that."""

    since_ns: int
    seen: frozenset[tuple[str, int]] = frozenset()


def tail_of(folder: Path, prefix: str, *, keep_s: float, now_ns: int, but: Container[str] = ()) -> Tail:
    """Return what a recorder's files have of the `keep_s` seconds before `now_ns`; blocks.

    Where they have nothing, what was put before `now_ns` is not missing.

    Args:
        folder: of the files.
        prefix: of their names.
        keep_s: seconds.
        now_ns: when the recorder has begun.
        but: names of files that are being written now.
    """
    since_ns = now_ns - int(keep_s * 1e9)
    ended = _Ended()
    for path in [each for each in sorted(folder.glob(f"{prefix}*.mcap")) if each.name not in but][-2:]:
        with contextlib.suppress(OSError, SwiftbotError, McapError):
            if path.stat().st_mtime_ns >= since_ns:
                ended.read(path, since_ns)
    if not ended.began_ns:
        return Tail(now_ns)
    # A recorder that was killed has not written its last half second.
    ends_ns = max((at_ns for _, at_ns in ended.seen if at_ns <= now_ns), default=0) - _SKEW_NS
    return Tail(max(since_ns, ends_ns, ended.began_ns), frozenset(ended.seen))


class _Ended:
    """The ends of files: what they have of the last seconds, and when the first of them began."""

    def __init__(self) -> None:
        self.seen: set[tuple[str, int]] = set()
        self.began_ns = 0

    def read(self, path: Path, since_ns: int) -> None:
        """Read a file's end; one without an index is read whole, unless it is large."""
        if not self._by_index(path, since_ns):
            if path.stat().st_size > _MOST_UNFINISHED:
                raise RecordError(f"{path} is not finished and large", remedy="what was put meanwhile is not fetched")
            self.seen |= {(each.key, each.at_ns) for each in read(path, problems=[]) if each.at_ns >= since_ns}
        began_ns = int(info(path).metadata.get("start_ns", "0"))
        self.began_ns = min(self.began_ns or began_ns, began_ns)

    def _by_index(self, path: Path, since_ns: int) -> bool:
        with contextlib.suppress(McapError), path.open("rb") as file:
            reader = make_reader(file)
            if reader.get_summary() is not None:
                found = reader.iter_messages(start_time=since_ns, log_time_order=False)
                messages = [logged(channel, message) for _, channel, message in found]
                self.seen |= {(each.key, each.at_ns) for each in messages}
                return True
        return False


class CatchingUp:
    """Between the subscription and the intake.

    Args:
        session: By which it is asked.
        put_all: Takes messages in order; may block for a moment.
        lose: Told of messages that stay missing.
        tail: Reads what is recorded already (`tail_of`); on a thread.
    """

    def __init__(
        self,
        session: Session,
        *,
        put_all: Callable[[list[LoggedMessage]], None],
        lose: Callable[[Lost], None],
        tail: Callable[[], Tail],
    ) -> None:
        self._session = session
        self._put_all, self._lose = put_all, lose
        self._read_tail = tail
        self._follower = Follower()
        self._lock = threading.Lock()
        self._loop = asyncio.get_running_loop()
        self._tail: asyncio.Task[Tail] | None = None
        self._fetching = Background()
        self._turn = asyncio.Semaphore(_AT_ONCE)
        self.fetched = 0
        """Messages that were not heard, and fetched."""

    def start(self) -> None:
        """Begin; before the first messages come."""
        self._tail = asyncio.create_task(asyncio.to_thread(self._read_tail), name="end of the last log")

    def take(self, messages: list[LoggedMessage]) -> None:
        """Take messages as they come, on any thread."""
        with self._lock:
            self._pass_on(self._follower.take(messages))

    async def close(self) -> None:
        """Wait a moment for what is being fetched, and count the rest as lost."""
        await self._fetching.finish(_END_S)
        await self._fetching.close()
        if self._tail is not None:
            self._tail.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._tail
        with self._lock:
            taken = self._follower.give_all_up()
            taken.holes.clear()
            self._pass_on(taken)

    def _pass_on(self, taken: Taken) -> None:
        """Hand over; under the lock, so that a session's messages stay in order."""
        if taken.messages:
            self._put_all(taken.messages)
        for lost in taken.lost:
            self._lose(lost)
        if taken.holes:
            with contextlib.suppress(RuntimeError):  # the loop has ended: nobody waits for this
                self._loop.call_soon_threadsafe(self._ask, taken.holes)

    def _ask(self, holes: list[Hole]) -> None:
        for hole in holes:
            self._fetching.start(self._fill(hole), "fetch what was missed")

    async def _fill(self, hole: Hole) -> None:
        async with self._turn:
            found, lost = await self._fetch(hole)
        await asyncio.to_thread(self._end, hole, found, lost)

    def _end(self, hole: Hole, found: list[LoggedMessage], lost: dict[str, int]) -> None:
        with self._lock:
            self.fetched += len(found)
            self._pass_on(self._follower.fill(hole, found, lost))

    async def _fetch(self, hole: Hole) -> tuple[list[LoggedMessage], dict[str, int]]:
        """Ask a session for what is missing; returns it, and what stays missing."""
        tail = await self._tail if self._tail is not None and hole.fresh else Tail(0)
        found: list[LoggedMessage] = []
        lost: dict[str, int] = {}
        first, size, seen = hole.first, 0, 0
        root = f"{self._session.keys.root}/"
        while True:
            try:
                answer = await self._asked(hole.source, BacklogAsk(first, hole.last, tail.since_ns))
            except SwiftbotError as error:
                log.debug("what was missed cannot be fetched", session=hole.source, reason=str(error))
                # Of a session that was not known before, nobody can say that anything is missing.
                if not hole.fresh or found:
                    lost[UNKNOWN] = max(0, hole.count - len(found) - seen)
                return found, {kind: count for kind, count in lost.items() if count}
            for each in answer.said:
                if (each.key, each.at_ns) in tail.seen or not each.key.startswith(root):
                    seen += 1
                    continue
                found.append(
                    LoggedMessage(
                        each.key, each.at_ns, each.payload, each.encoding, each.deleted, hole.source, each.number
                    )
                )
                size += len(each.payload)
            for kind, count in (*answer.lost.items(), (UNKNOWN, answer.forgotten)):
                if count > 0:
                    lost[kind] = lost.get(kind, 0) + count
            if answer.upto == hole.last or not answer.said:
                return found, lost
            if size > MOST_HELD_BYTES:
                lost[UNKNOWN] = lost.get(UNKNOWN, 0) + max(0, hole.count - len(found))
                return found, lost
            first = moved(answer.upto, 1)

    async def _asked(self, source: str, ask: BacklogAsk) -> Backlogged:
        key = self._session.keys(keyspace.BACKLOG, source.partition("/")[0])
        until = time.monotonic() + _TIMEOUT_S * _TRIES
        for left in reversed(range(_TRIES)):
            try:
                raw = await self._session.query(key, msgspec.msgpack.encode(ask), timeout_s=_TIMEOUT_S, bulk=True)
                return msgspec.msgpack.decode(raw, type=Backlogged)
            except UnreachableError:
                if not left or time.monotonic() > until:
                    raise
                await asyncio.sleep(_PAUSE_S)
            except msgspec.MsgspecError as error:
                raise PayloadError(f"{key}: {error}") from error
        raise UnreachableError(f"nobody answers on {key}")
