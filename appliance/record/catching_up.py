"""Fetches what the recorder was not linked for: each session keeps what it has put lately (`plane.backlog`).

What came before the recorder heard a session for the first time is its business too, from the moment it began on; and
where it was itself restarted, from the moment its last file ends.
"""

import asyncio
import contextlib
import threading
import time
from collections.abc import Callable, Container
from pathlib import Path

import msgspec
import structlog
from mcap.exceptions import McapError
from mcap.reader import make_reader
from msgspec import Struct

from appliance.errors import PayloadError, RecordError, SwiftbotError, UnreachableError
from appliance.plane.backlog import UNKNOWN, BacklogAsk, Backlogged, moved
from appliance.plane.session import Session
from appliance.record.facts import LoggedMessage
from appliance.record.following import MOST_HELD_BYTES, Follower, Hole, Lost, Taken
from appliance.record.reader import info, logged, read

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
        self._fetching: set[asyncio.Task[None]] = set()
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
        if self._fetching:
            await asyncio.wait(tuple(self._fetching), timeout=_END_S)
        for task in (*self._fetching, *((self._tail,) if self._tail else ())):
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
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
            with contextlib.suppress(RuntimeError):  # the loop has ended: whoever closed it waits for nothing
                self._loop.call_soon_threadsafe(self._ask, taken.holes)

    def _ask(self, holes: list[Hole]) -> None:
        for hole in holes:
            task = self._loop.create_task(self._fill(hole), name="fetch what was missed")
            self._fetching.add(task)
            task.add_done_callback(self._fetching.discard)

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
        key = self._session.keys.backlog(source.partition("/")[0])
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
