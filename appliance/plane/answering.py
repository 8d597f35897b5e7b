"""Answering questions: each in a task of its own, bounded, every defect of a handler contained here."""
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false, reportUnknownVariableType=false
# The library's stubs leave out the return types of methods that return nothing.

import asyncio
from collections.abc import Awaitable, Callable
from functools import partial

import structlog
import zenoh

from appliance.errors import PayloadError, RefusedError, SwiftbotError, UnreachableError
from appliance.plane import link, threads
from appliance.plane.direct import Answer, Asked, Direct
from appliance.plane.doors import Doors
from appliance.plane.wire import Closer, Wire

log = structlog.get_logger(__name__)


Handler = Callable[[str, bytes], Awaitable[bytes]]
"""Answers a question for a key, on the event loop."""


class Answering:
    """What is served on one session."""

    def __init__(self, wire: Wire, doors: Doors, direct: Direct) -> None:
        self.wire = wire
        self._doors = doors
        self._direct = direct
        self.direct_answer = direct.answer
        self._answering: set[asyncio.Task[None]] = set()

    def serve(
        self,
        expr: str,
        handler: Handler,
        *,
        bulk: bool = False,
        direct: bool = False,
        at_once: Callable[[bytes, Answer], bool] | None = None,
    ) -> Closer:
        """Answer queries on `expr`, each in a task of its own, at most `concurrent_queries` at once.

        `bulk`: answers are raw bytes and wait in a queue of their own; their priority is that of the question.
        `direct`: direct questions may come as plain messages too (`plane.direct`).
        `at_once`: tried first for direct questions, on Zenoh's own thread: it must neither block nor touch what
        belongs to the event loop. It says whether it answers, or has another thread answer; if not, the handler does.

        A SwiftbotError of the handler is answered as ErrorReply; any other exception is logged with its traceback
        and answered as ErrorReply of code `internal`: this is where a handler's defects are contained.

        A question that was meant for another key is refused as `unreachable`: after links were made anew Zenoh 1.10 has
        been seen to deliver a query to the wrong queryable of a session or process, which made one robot do another's
        command. `query` writes down for whom it is; what other Zenoh clients ask says nothing of it.
        """
        served = Served(self, expr, handler, bulk=bulk, at_once=at_once)
        queryable = self.wire.raw.declare_queryable(expr, threads.callback(served.take), complete=True)
        messages = self.take_messages(served) if direct else None

        def end() -> None:
            if messages is not None:
                messages.close()
            queryable.undeclare()

        return Closer(end)

    def take_messages(self, served: "Served") -> Closer:
        """Have the direct questions for a key come as plain messages too."""
        return self._direct.serve(served.expr, served.take_message)

    def begin(self, served: "Served", key: str, data: bytes, reply: Answer) -> None:
        """Have a handler answer, unless too many are at it; on the event loop's thread."""
        if len(served.running) >= self.wire.config.concurrent_queries:
            error = RefusedError(f"{key}: {len(served.running)} queries are being answered", remedy="try again later")
            self.refuse(f"too many {served.name}", key, reply, error)
            return
        task = self.wire.loop.create_task(self._answer(served.handler, served.name, key, data, reply))
        for group in (served.running, self._answering):
            group.add(task)
            task.add_done_callback(group.discard)

    async def _answer(
        self,
        handler: Handler,
        name: str,
        key: str,
        data: bytes,
        reply: Answer,
    ) -> None:
        answer: bytes | None = None
        error: SwiftbotError | None = None
        try:
            answer = await handler(key, data)
            if len(answer) > self.wire.config.max_payload_bytes:
                error = PayloadError(f"{key}: the answer has {len(answer):,} bytes", remedy="ask for less at once")
        except SwiftbotError as refusal:
            if isinstance(refusal, PayloadError):
                self.wire.refuse(f"malformed {name}", key=key, reason=str(refusal))
            error = refusal
        except asyncio.CancelledError:
            error = UnreachableError("whoever was asked is stopping", remedy="ask another gateway")
            raise
        except Exception as defect:  # the supervision boundary of `serve`
            log.exception("a query's handler failed", key=key)
            error = SwiftbotError(f"{type(defect).__name__}: {defect}")
        finally:
            reply(answer, error)

    def reply(
        self, query: zenoh.Query, expr: str, bulk: bool, marked: bool, answer: bytes | None, error: SwiftbotError | None
    ) -> None:
        """Answer a query; one marked as direct from here, others on the sender's thread."""
        if self.wire.closed:
            link.reply(query, expr, answer, error)
        elif marked:
            link.reply_direct(query, expr, answer, error)
        else:
            size = len(answer) if answer is not None and error is None else 0
            self.wire.send(expr, partial(link.reply, query, expr, answer, error, bulk=bulk), size, bulk=bulk)

    def misrouted(self, name: str, expr: str, asker: str, reply: Answer, error: SwiftbotError) -> None:
        """Refuse a question for another key; the links over which it came may be mixed up."""
        self.refuse(f"misrouted {name}", expr, reply, error)
        self._doors.was_wrong(asker)

    def refuse(self, what: str, key: str, reply: Answer, error: SwiftbotError) -> None:
        """Refuse a question as bad input, which is counted."""
        self.wire.refuse(what, key=key, reason=str(error))
        reply(None, error)

    async def stop(self, wait_s: float) -> None:
        """End every answer under way with an error, waiting at most so long for handlers that tidy up."""
        for task in tuple(self._answering):
            task.cancel()
        if self._answering:
            await asyncio.wait(self._answering, timeout=wait_s)


class Served:
    """What answers the questions for one key, or for those of an expression; `take`, on Zenoh's threads, has them."""

    def __init__(
        self,
        answering: Answering,
        expr: str,
        handler: Handler,
        *,
        bulk: bool = False,
        at_once: Callable[[bytes, Answer], bool] | None = None,
    ) -> None:
        self.expr, self.handler = expr, handler
        self.name = answering.wire.name(expr)
        self.running: set[asyncio.Task[None]] = set()
        self._answering, self._wire = answering, answering.wire
        self._direct_answer = answering.direct_answer
        self._door = None if "*" in expr else expr.encode()
        self._bulk, self._at_once = bulk, at_once

    def take(self, query: zenoh.Query) -> None:
        """A question came."""
        self.take_marked(query, *link.read_mark(query))

    def take_marked(self, query: zenoh.Query, marked: bool, meant: bytes) -> None:
        """The same, with what it says of itself read (`link.read_mark`)."""
        answering, limit = self._answering, self._wire.config.max_payload_bytes
        payload = query.payload
        size = len(payload) if payload is not None else 0
        reply = partial(answering.reply, query, self.expr, self._bulk, marked)
        if meant and self._door is not None and meant != self._door:
            error = UnreachableError(f"{self.expr}: {link.WRONG_DOOR}", remedy="ask again in a moment")
            begin = partial(answering.misrouted, self.name, self.expr, link.asker_of(query), reply, error)
            size = 0
        elif size > limit:
            error = PayloadError(f"{query.key_expr}: {size:,} bytes", remedy=f"at most {limit:,}")
            begin = partial(answering.refuse, f"oversize {self.name}", str(query.key_expr), reply, error)
            size = 0
        else:
            data = payload.to_bytes() if payload is not None else b""
            if (
                self._at_once is not None
                and marked
                and self._at_once(data, partial(link.reply_direct, query, self.expr))
            ):
                return
            begin = partial(answering.begin, self, str(query.key_expr), data, reply)
        if not self._wire.inbox.post(begin, size):
            link.reply(query, self.expr, None, RefusedError("too busy", remedy="try again in a moment"))

    def take_message(self, asked: Asked, payload: zenoh.ZBytes) -> None:
        """A direct question came as a plain message."""
        answering, expr = self._answering, self.expr
        size = len(payload)
        reply = partial(self._direct_answer, asked)
        if size > link.MOST_DIRECT:
            error = PayloadError(f"{expr}: {size:,} bytes", remedy=f"at most {link.MOST_DIRECT:,} in a message")
            begin = partial(answering.refuse, f"oversize {self.name}", expr, reply, error)
            size = 0
        else:
            data = payload.to_bytes()
            if self._at_once is not None and self._at_once(data, reply):
                return
            begin = partial(answering.begin, self, expr, data, reply)
        if not self._wire.inbox.post(begin, size):
            reply(None, RefusedError("too busy", remedy="try again in a moment"))
