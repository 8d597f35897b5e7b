"""Follows one task to its end: subscribes, asks every gateway what it still knows, and yields lines in one order.

It is a client of the key space like any other and needs no gateway in particular: those that die or join meanwhile
change what is heard, and nothing else.
"""

import asyncio
import contextlib
import time
from collections.abc import AsyncGenerator, Awaitable, Callable
from typing import Protocol

from appliance.errors import SwiftbotError
from appliance.model import LogLine, Notice, RunEvent, TaskRecord
from appliance.plane.keys import Keys
from appliance.plane.once import Once
from appliance.plane.rpc import Rpc
from appliance.plane.session import Closer, Session
from appliance.tasks.api import TaskLines, TaskLinesAsk
from appliance.tasks.transition import Transition
from appliance.tasks.watch import lines
from appliance.tasks.watch.lines import Line
from appliance.tasks.watch.merge import Merge

QUEUE = 5000
"""Messages that may wait for a slow reader; beyond it they are dropped and counted."""
ASK_S = 2.0
"""How long a gateway may take to tell what it knows; one that does not is left out."""
POLL_S = 2.0
"""How often the record is asked for while nothing is heard: the news of the end may be missed."""
LINGER_S = 0.7
"""How long lines are waited for after the end: figures of the last run, the ends of those that were cancelled."""


class PlaneLike(Protocol):
    """What a stream needs of a fleet: `plane.node.PlaneClient`."""

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
        self._asking: set[asyncio.Task[None]] = set()
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
            for asking in self._asking:
                asking.cancel()

    def _subscribe(self) -> list[Closer]:
        session, keys = self._plane.session, self._plane.keys

        def on_record(_: str, record: TaskRecord | None) -> None:
            if record is not None and record.state.final and self._ended_at is None:
                self._ended_at = time.monotonic()
                self._put(None)

        def on_log(key: str, line: LogLine | None) -> None:
            told = lines.of_log(key.split("/")[-2], line) if line is not None else None
            if told is not None and told.task == self._task:
                self._put(told)

        once = Once()

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
            session.subscribe_typed(keys.transition(self._task), Transition, on_transition),
            session.subscribe_typed(keys.run(self._task), RunEvent, on_event),
            session.subscribe_typed(keys.task(self._task), TaskRecord, on_record),
            session.subscribe_typed(keys.log(), LogLine, on_log),
            session.subscribe_typed(keys.notice(), Notice, on_notice),
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
            asking = asyncio.create_task(self._ask(gateway), name=f"lines of {gateway}")
            self._asking.add(asking)
            asking.add_done_callback(self._asking.discard)

    async def _ask(self, gateway: str) -> None:
        """Ask a gateway for its lines, and for its time, by which all its lines are put into order."""
        self._asked.add(gateway)
        asked_ns = time.time_ns()
        try:
            answer = await self._plane.rpc.call(
                gateway, "task_lines", TaskLinesAsk(task=self._task), TaskLines, timeout_s=ASK_S
            )
        except SwiftbotError:
            return  # what it says from now on is heard all the same
        # Half the round trip is the error of it (Cristian, Probabilistic clock synchronization, 1989).
        self._merge.set_clock(gateway, theirs_ns=answer.now_ns, ours_ns=(asked_ns + time.time_ns()) // 2)
        self._merge.missed(answer.dropped if not self._from_ns else 0, gateway)
        for line in answer.lines:
            self._add(line)
