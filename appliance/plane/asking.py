"""Asking whoever serves a key, or everybody: bounded in time and size, and over when the session closes."""
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false, reportUnknownVariableType=false
# The library's stubs leave out the return types of methods that return nothing.

import asyncio
import contextlib
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import cast

import structlog
import zenoh

from appliance.errors import DeadlineError, PayloadError, SwiftbotError, UnreachableError
from appliance.plane import link
from appliance.plane.doors import Doors
from appliance.plane.publishing import Message
from appliance.plane.wire import Wire

log = structlog.get_logger(__name__)

MOST_ANSWERS = 2_000
"""To one question that everybody may answer; twice the gateways that a fleet may have."""


class Asking:
    """The questions under way of one session."""

    def __init__(self, wire: Wire, doors: Doors) -> None:
        self._wire = wire
        self._doors = doors
        self.open: set[asyncio.Future[bytes]] = set()
        """Answers that are awaited."""

    async def query(
        self, key: str, payload: bytes, *, timeout_s: float, bulk: bool = False, direct: bool = False
    ) -> bytes:
        """Ask whoever serves a key and return the first answer; `bulk`: other messages go before it.

        `direct`: sent from here, past the queue of the sender's thread, and dropped when the link is full. For small
        questions that can be asked again, where the way there and back matters.

        Raises:
            UnreachableError: nobody serves the key, or (`sent`) whoever may have heard it went away before answering.
            DeadlineError: no answer within `timeout_s` seconds.
            PayloadError: the request or the answer is too large.
            SwiftbotError: what the answering side raised.
        """
        return await self.ask(key, payload, timeout_s=timeout_s, bulk=bulk, direct=direct).answer()

    def ask(
        self, key: str, payload: bytes, *, timeout_s: float, bulk: bool = False, direct: bool = False
    ) -> "Question":
        """Do the same, but only send the question, and have the answer awaited afterwards."""
        return Question(self, self._wire, key, payload, timeout_s, bulk=bulk, direct=direct)

    async def query_all(self, expr: str, payload: bytes, *, timeout_s: float) -> list[Message]:
        """Ask everybody who serves a key of `expr`; returns the answers that came in time, errors left out.

        At most `MOST_ANSWERS`, and `queue_bytes` of them together: what comes beyond that is counted as refused.
        """
        messages: list[Message] = []
        ended = asyncio.Event()

        def on_reply(key: str, data: bytes | None, error: SwiftbotError | None) -> None:
            if data is not None:
                messages.append(Message(key, data, deleted=False, at_ns=time.time_ns(), encoding="application/json"))
            elif error is not None:
                log.debug("an answer is an error", expr=expr, error=str(error))

        self.get(expr, payload, timeout_s, on_reply, lambda _: ended.set(), target=zenoh.QueryTarget.ALL)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                await ended.wait()
        return list(messages)

    async def answerers(self, key: str, payload: bytes, *, timeout_s: float) -> int:
        """Ask everybody who serves a key, and return how many answered in time, whatever they said."""
        found: set[str] = set()
        ended = asyncio.Event()
        inbox = self._wire.inbox

        def take(reply: zenoh.Reply) -> None:
            who = reply.replier_id
            inbox.post(partial(found.add, f"{who.zid}/{who.eid}" if who is not None else f"{len(found)}"), must=True)

        ask = partial(
            self._wire.raw.get,
            key,
            link.callback(take, drop=partial(inbox.post, ended.set, must=True)),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout_s,
            payload=payload,
        )
        self._wire.send(key, cast("Callable[[], None]", ask), len(payload))
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                await ended.wait()
        return len(found)

    def get(
        self,
        expr: str,
        payload: bytes,
        timeout_s: float,
        on_reply: Callable[[str, bytes | None, SwiftbotError | None], None],
        on_end: Callable[[bool], None],
        *,
        target: zenoh.QueryTarget,
        bulk: bool = False,
        direct: bool = False,
        meant: bytes | None = None,
    ) -> None:
        """Send a query; both callbacks come by the event loop, `on_end` only where no answer came first."""
        first = target != zenoh.QueryTarget.ALL
        limit = self._wire.config.max_payload_bytes
        if len(payload) > limit:
            raise PayloadError(f"a request of {len(payload):,} bytes on {expr}", remedy=f"at most {limit:,}")
        if self._wire.closed:
            raise UnreachableError("the session is closed")

        answered, sender = False, 0
        # One answer is all that counts of a question to one; whoever is asked may send more.
        taken = _Bounds(1 if first else MOST_ANSWERS, self._wire.config.queue_bytes)

        def take(reply: zenoh.Reply) -> None:
            nonlocal answered
            answered = True
            sample = reply.ok
            size = len(sample.payload) if sample is not None else 0
            if not taken.one(0 if first or size > limit else size):
                return
            if sample is None:
                error = link.error_of(reply.err)
                if link.WRONG_DOOR in error.message:
                    replier = str(reply.replier_id.zid) if reply.replier_id is not None else ""
                    self._wire.inbox.post(partial(self._doors.met_wrong, replier))
                self._wire.inbox.post(partial(on_reply, expr, None, error), must=True)
            elif size > limit:
                self._wire.inbox.post(partial(self._wire.refuse, "oversize answer", key=expr, size=size))
                error = PayloadError(f"the answer on {expr} has {size:,} bytes", remedy=f"at most {limit:,}")
                self._wire.inbox.post(partial(on_reply, expr, None, error), must=True)
            else:
                data = sample.payload.to_bytes()
                key = expr if first else str(sample.key_expr)
                self._wire.inbox.post(partial(on_reply, key, data, None), size, must=True)

        def end() -> None:
            if taken.left_out and not first:
                refuse = partial(self._wire.refuse, "answers beyond the limit", count=taken.left_out, key=expr)
                self._wire.inbox.post(refuse, must=True)
            # Where the first answer is all that counts, waking the event loop for the end after it is for nothing.
            if not (first and answered):
                # One that nobody serves ends within the call that sends it.
                self._wire.inbox.post(partial(on_end, sender != threading.get_ident()), must=True)

        priority = zenoh.Priority.DATA_LOW if bulk else zenoh.Priority.DATA
        control = zenoh.CongestionControl
        send = partial(
            self._wire.raw.get,
            expr,
            link.callback(take, drop=end),
            target=target,
            consolidation=zenoh.ConsolidationMode.NONE,
            # Ours decides; Zenoh's only makes sure that nothing is kept for ever.
            timeout=timeout_s + 1.0,
            congestion_control=control.DROP if direct else control.BLOCK,
            priority=zenoh.Priority.DATA_HIGH if direct else priority,
            express=True,
            payload=payload,
            attachment=meant,
            source_info=self._wire.source,
        )

        def ask() -> None:
            nonlocal sender
            sender = threading.get_ident()
            send()
            sender = 0

        if direct:
            link.quietly(ask, expr)
        else:
            self._wire.send(expr, ask, len(payload))

    def stop(self) -> None:
        """End every question under way with an error."""
        for answer in self.open:
            if not answer.done():
                answer.set_exception(UnreachableError("the session was closed", sent=True))


class Question:
    """A question that is under way; what went wrong with sending it is told with the answer."""

    def __init__(
        self,
        asking: Asking,
        wire: Wire,
        key: str,
        payload: bytes,
        timeout_s: float,
        *,
        bulk: bool,
        direct: bool,
    ) -> None:
        self._asking = asking
        self._key, self._payload = key, payload
        self._timeout_s, self._until = timeout_s, wire.loop.time() + timeout_s
        self._bulk, self._direct = bulk, direct and len(payload) <= link.MOST_DIRECT
        self._loop = wire.loop
        self._answer: asyncio.Future[bytes] = wire.loop.create_future()
        asking.open.add(self._answer)
        self._timer = wire.loop.call_at(self._until, self._on_time)
        try:
            self._send()
        except SwiftbotError as error:
            self._answer.set_exception(error)

    def _send(self) -> None:
        self._asking.get(
            self._key,
            self._payload,
            self._timeout_s,
            self._on_reply,
            self._on_end,
            target=zenoh.QueryTarget.BEST_MATCHING,
            bulk=self._bulk,
            direct=self._direct,
            meant=link.mark(self._key, direct=self._direct),
        )

    def _on_answer(self, data: bytes | None, error: SwiftbotError | None) -> None:
        if not self._answer.done():
            if error is not None:
                self._answer.set_exception(error)
            elif data is not None:
                self._answer.set_result(data)

    def _on_reply(self, _: str, data: bytes | None, error: SwiftbotError | None) -> None:
        self._on_answer(data, error)

    def _on_end(self, sent: bool) -> None:
        self._on_answer(None, UnreachableError(f"nobody answers on {self._key}", remedy=link.NOBODY_REMEDY, sent=sent))

    def _on_time(self) -> None:
        self._on_answer(None, DeadlineError(f"no answer on {self._key} within {self._timeout_s:g} s"))

    async def answer(self) -> bytes:
        """Wait for the answer; errors as of `Asking.query`, whose time has run since the question was sent."""
        try:
            data = await self._answer
            if data or not self._direct:
                return data
        finally:
            self.end()
        # The answer is too large to be sent so.
        left_s = max(0.0, self._until - self._loop.time())
        return await self._asking.query(self._key, self._payload, timeout_s=left_s, bulk=self._bulk)

    def end(self) -> None:
        """Wait for it no more; more than once does no harm."""
        self._timer.cancel()
        self._asking.open.discard(self._answer)
        if not self._answer.cancel() and not self._answer.cancelled():
            self._answer.exception()  # looked at: nobody else may come to


class _Bounds:
    """Counts the answers to one question, on whatever threads they come."""

    def __init__(self, most: int, most_bytes: int) -> None:
        self.left_out = 0
        self._left, self._left_bytes = most, most_bytes
        self._lock = threading.Lock()

    def one(self, size: int) -> bool:
        """Whether one more of that size is within the bounds."""
        with self._lock:
            if self._left <= 0 or self._left_bytes < size:
                self.left_out += 1
                return False
            self._left -= 1
            self._left_bytes -= size
            return True
