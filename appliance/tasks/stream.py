"""One stream of what happens to a task: progress, figures and log lines of all gateways, in order as well as can be.

`Kept` is a gateway's buffer: the last lines that it has said of each task, its own only, within one bound. A client
that follows a task later asks every gateway for them (verb `task_lines`); nothing is written to disk, since the logs
have all of it.

`Merge` puts the lines of several gateways into one order, with bounds; pure, the clock passed in. Gateways' clocks may
differ by an hour, so times are first brought to the reader's clock by what each gateway's clock showed when it was
asked (Cristian's method: half the round trip is the error). A line is held back for a moment so that one that was said
earlier elsewhere, and comes later, stands before it. Within a source, lines keep their numbers' order and a number that
is missing is counted. What would not fit is dropped, log lines first, and counted as well.

`Stream` follows one task to its end: it subscribes, asks every gateway what it still has, and yields lines in one
order. It is a client of the key space like any other and needs no gateway in particular: those that die or join
meanwhile change what is heard, and nothing else.
"""

import asyncio
import contextlib
import heapq
import threading
import time
from collections import Counter, OrderedDict, deque
from collections.abc import AsyncGenerator, Awaitable, Callable, Mapping
from typing import Protocol

from msgspec.structs import replace

from appliance.background import Background
from appliance.errors import SwiftbotError
from appliance.model import LogLine, Notice, RunEvent, TaskRecord, keyspace
from appliance.model.keys import Keys
from appliance.model.task_api import Line, LineKind, TaskLines, TaskLinesAsk
from appliance.model.transitions import Transition
from appliance.plane.dedup import Deduplicator
from appliance.plane.rpc import Rpc
from appliance.plane.session import Closer, Session
from appliance.tasks import lines

PER_TASK = 1000
"""Lines kept of one task."""
ALTOGETHER = 10_000
"""Of all tasks: about 6 MB. The task that was last heard of longest ago is forgotten first."""


class Kept:
    """The last lines that one gateway has said, by task."""

    def __init__(self, gateway: str, *, per_task: int = PER_TASK, altogether: int = ALTOGETHER) -> None:
        self._gateway = gateway
        self._per_task = per_task
        self._altogether = altogether
        self._lines: OrderedDict[str, deque[Line]] = OrderedDict()
        self._dropped: dict[str, int] = {}
        self._count = 0
        self._lock = threading.Lock()
        """Log lines come from worker threads too."""

    def hear_event(self, event: RunEvent) -> None:
        """Keep what a run here has told."""
        self._add(lines.of_event(event))

    def hear_log(self, line: LogLine) -> None:
        """Keep a log line of this gateway, if it is about a task."""
        self._add(lines.of_log(self._gateway, line))

    def hear_transition(self, event: Transition) -> None:
        """Keep a transition that was applied here."""
        self._add(lines.of_transition(event))

    def _add(self, line: Line | None) -> None:
        if line is not None:
            with self._lock:
                self._keep(line)

    def _keep(self, line: Line) -> None:
        kept = self._lines.get(line.task)
        if kept is None:
            kept = self._lines[line.task] = deque()
        self._lines.move_to_end(line.task)
        kept.append(line)
        self._count += 1
        if len(kept) > self._per_task:
            kept.popleft()
            self._count -= 1
            self._dropped[line.task] = self._dropped.get(line.task, 0) + 1
        while self._count > self._altogether and len(self._lines) > 1:
            task, gone = self._lines.popitem(last=False)
            self._count -= len(gone)
            self._dropped.pop(task, None)

    async def answer(self, ask: TaskLinesAsk) -> TaskLines:
        """Return the last lines of a task, oldest first, with this gateway's time of now."""
        with self._lock:
            kept = tuple(self._lines.get(ask.task, ()))
            dropped = self._dropped.get(ask.task, 0)
        skipped = max(0, len(kept) - max(0, ask.limit))
        return TaskLines(
            gateway=self._gateway,
            now_ns=time.time_ns(),
            lines=kept[skipped:],
            dropped=dropped + skipped,
        )


HOLD_S = 0.3
"""Twice what a line usually takes through a loaded gateway; longer would only delay what people see."""
MOST_HELD = 5000
"""Lines held back at once; beyond it the least important are dropped."""
MOST_KNOWN = 50_000
"""Lines that are remembered so that none is shown twice: those kept by gateways come a second time."""
_LEAST = (LineKind.LOG, LineKind.GATEWAY, LineKind.PARTIAL, LineKind.PROGRESS)


class Merge:
    """One reader's stream of one task. Times are seconds of the reader's monotonic clock."""

    def __init__(self, *, hold_s: float = HOLD_S, most: int = MOST_HELD) -> None:
        self._hold_s = hold_s
        self._most = most
        self._offsets: dict[str, int] = {}
        self._heap: list[tuple[int, int, float, Line]] = []
        self._known: dict[tuple[str, str, int, int], None] = {}
        self._count = 0
        self._last_at: dict[tuple[str, str], int] = {}
        self._numbers: dict[tuple[str, str], int] = {}
        self._told: dict[tuple[str, str], int] = {}
        self._dropped: Counter[str] = Counter()

    def set_clock(self, gateway: str, *, theirs_ns: int, ours_ns: int) -> None:
        """Note what a gateway's clock showed when ours showed that."""
        self._offsets[gateway] = ours_ns - theirs_ns

    @property
    def dropped(self) -> Mapping[str, int]:
        """Lines dropped since they were last told, by gateway; those of no one in particular under ""."""
        return self._dropped

    def missed(self, count: int, gateway: str = "") -> None:
        """Count lines that never came here."""
        if count > 0:
            self._dropped[gateway] += count

    def add(self, line: Line, now_s: float, *, from_ns: int = 0) -> None:
        """Take a line in, unless it was said before `from_ns` (the reader's clock)."""
        if line.key in self._known:
            return
        self._known[line.key] = None
        while len(self._known) > MOST_KNOWN:
            del self._known[next(iter(self._known))]
        source = (line.gateway, line.source)
        at_ns = line.at_ns + self._offsets.get(line.gateway, 0)
        if at_ns < from_ns:
            return
        # A clock that is set back must not turn a source's own order around.
        last = self._numbers.get(source, 0)
        if line.number > last:
            at_ns = max(at_ns, self._last_at.get(source, at_ns))
            self._last_at[source] = at_ns
            self._numbers[source] = line.number
        self._count += 1
        heapq.heappush(self._heap, (at_ns, self._count, now_s, replace(line, at_ns=at_ns)))
        if len(self._heap) > self._most:
            self._drop()

    def _drop(self) -> None:
        """Drop the oldest of the least important line held; of none such, the oldest of all."""
        least = [each for each in self._heap if each[3].kind in _LEAST]
        gone = min(least or self._heap)
        self._heap.remove(gone)
        heapq.heapify(self._heap)
        if not gone[3].counted:
            self._dropped[gone[3].gateway] += 1  # else the gap in its source's numbers says so

    def due(self, now_s: float, *, all_of_it: bool = False) -> list[Line]:
        """Return the lines that need not be held back any longer, in order; those before a line that is due are too."""
        due_at = [entry[0] for entry in self._heap if all_of_it or now_s - entry[2] >= self._hold_s]
        if not due_at:
            return []
        until = max(due_at)
        found: list[Line] = []
        while self._heap and self._heap[0][0] <= until:
            line = heapq.heappop(self._heap)[3]
            self._count_gap(line)
            if self._dropped:
                found.extend(self._drops(line))
            found.append(line)
        return found

    def _count_gap(self, line: Line) -> None:
        """Count the lines of its source that should have come before a line and did not."""
        source = (line.gateway, line.source)
        last = self._told.get(source, 0)
        if line.counted and line.number:
            if last and line.number > last + 1:
                self._dropped[line.gateway] += line.number - last - 1
            self._told[source] = max(last, line.number)

    def _drops(self, before: Line) -> list[Line]:
        """Lines that say what is missing, to stand before a line."""
        told = [
            Line(
                kind=LineKind.DROPPED,
                task=before.task,
                at_ns=before.at_ns,
                gateway=gateway,
                level="warning",
                text=f"{count} lines are missing here",
                fields={"count": count},
                source="reader",
            )
            for gateway, count in sorted(self._dropped.items())
        ]
        self._dropped.clear()
        return told

    def wait_s(self, now_s: float) -> float | None:
        """Seconds until the next line is due; None when none is held."""
        if not self._heap:
            return None
        return max(0.0, min(entry[2] for entry in self._heap) + self._hold_s - now_s)


QUEUE = 5000
"""Messages that may wait for a slow reader; beyond it they are dropped and counted."""
ASK_S = 2.0
"""How long a gateway may take to tell what it knows; one that does not is left out."""
POLL_S = 2.0
"""How often the record is asked for while nothing is heard: the news of the end may be missed."""
LINGER_S = 0.7
"""How long lines are waited for after the end: figures of the last run, the ends of those that were cancelled."""


class PlaneLike(Protocol):
    """What a stream needs of a fleet: `plane.client.PlaneClient`."""

    session: Session
    keys: Keys
    rpc: Rpc

    def members(self) -> frozenset[str]:
        """Return the gateways that are present."""
        ...


class Stream:
    """One reader of one task."""

    def __init__(self, plane: PlaneLike, task: str, ask_record: Callable[[], Awaitable[TaskRecord]]) -> None:
        self._plane = plane
        self._task = task
        self._ask_record = ask_record
        self._queue: asyncio.Queue[Line | None] = asyncio.Queue(QUEUE)
        self._merge = Merge()
        self._asking = Background()
        self._asked: set[str] = set()
        self._from_ns = 0
        self._ended_at: float | None = None

    async def follow(self, *, since_s: float | None = None) -> AsyncGenerator[Line]:
        """Yield the lines of the task, until it has ended.

        Args:
            since_s: leave out what was said longer ago than so many seconds; None: all that is still known.

        Raises:
            NotFoundError: there is no such task.
        """
        self._from_ns = 0 if since_s is None else time.time_ns() - int(since_s * 1e9)
        closers = self._subscribe()
        try:
            record = await self._ask_record()
            await self._ask_all()
            if record.state.final:
                self._ended_at = time.monotonic() - LINGER_S
            heard_at = time.monotonic()
            while True:
                heard = await self._take()
                now = time.monotonic()
                heard_at = now if heard else heard_at
                over = self._ended_at is not None and now - self._ended_at >= LINGER_S and self._queue.empty()
                for line in self._merge.due(now, all_of_it=over):
                    yield line
                if over:
                    return
                self._ask_newcomers()
                if now - heard_at > POLL_S and self._ended_at is None:
                    heard_at = now
                    with contextlib.suppress(SwiftbotError):
                        if (await self._ask_record()).state.final:
                            self._ended_at = time.monotonic()
        finally:
            for closer in closers:
                closer.close()
            self._asking.cancel()

    def _subscribe(self) -> list[Closer]:
        session = self._plane.session

        def on_record(_: str, record: TaskRecord | None) -> None:
            if record is not None and record.state.final and self._ended_at is None:
                self._ended_at = time.monotonic()
                self._put(None)

        def on_log(key: str, line: LogLine | None) -> None:
            told = lines.of_log(keyspace.LOG.names(key)[0], line) if line is not None else None
            if told is not None and told.task == self._task:
                self._put(told)

        once = Deduplicator()

        def on_notice(_: str, notice: Notice | None) -> None:
            if notice is not None and notice.task == self._task and once.new(notice.id):
                self._put(lines.of_notice(notice))

        def on_event(_: str, event: RunEvent | None) -> None:
            if event is not None:
                self._put(lines.of_event(event))

        def on_transition(_: str, event: Transition | None) -> None:
            if event is not None:
                self._put(lines.of_transition(event))

        return [
            session.subscribe_typed(keyspace.TRANSITION, on_transition, self._task),
            session.subscribe_typed(keyspace.RUN_EVENT, on_event, self._task),
            session.subscribe_typed(keyspace.TASK_UPDATE, on_record, self._task),
            session.subscribe_typed(keyspace.LOG, on_log),
            session.subscribe_typed(keyspace.NOTICE, on_notice),
        ]

    def _put(self, line: Line | None) -> None:
        try:
            self._queue.put_nowait(line)
        except asyncio.QueueFull:
            self._merge.missed(1, line.gateway if line is not None else "")

    async def _take(self) -> bool:
        """Wait for news or for a line that becomes due; whether anything was heard."""
        now = time.monotonic()
        waits = [POLL_S]
        if (due_s := self._merge.wait_s(now)) is not None:
            waits.append(due_s)
        if self._ended_at is not None:
            waits.append(self._ended_at + LINGER_S - now)
        heard: list[Line | None] = []
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(max(0.001, min(waits))):
                heard.append(await self._queue.get())
        while not self._queue.empty():
            heard.append(self._queue.get_nowait())
        for line in heard:
            if line is not None:
                self._add(line)
        return bool(heard)

    def _add(self, line: Line) -> None:
        self._merge.add(line, time.monotonic(), from_ns=self._from_ns)

    # --- what gateways still know -----------------------------------------------------------------------------

    async def _ask_all(self) -> None:
        await asyncio.gather(*(self._ask(each) for each in sorted(self._plane.members())))

    def _ask_newcomers(self) -> None:
        for gateway in self._plane.members() - self._asked:
            self._asking.start(self._ask(gateway), f"lines of {gateway}")

    async def _ask(self, gateway: str) -> None:
        """Ask a gateway for its lines, and for its time, by which all its lines are put into order."""
        self._asked.add(gateway)
        asked_ns = time.time_ns()
        try:
            answer = await self._plane.rpc.call(
                gateway, keyspace.TASK_LINES, TaskLinesAsk(task=self._task), timeout_s=ASK_S
            )
        except SwiftbotError:
            return  # what it says from now on is heard all the same
        # Half the round trip is the error of it (Cristian, Probabilistic clock synchronization, 1989).
        self._merge.set_clock(gateway, theirs_ns=answer.now_ns, ours_ns=(asked_ns + time.time_ns()) // 2)
        self._merge.missed(answer.dropped if not self._from_ns else 0, gateway)
        for line in answer.lines:
            self._add(line)
