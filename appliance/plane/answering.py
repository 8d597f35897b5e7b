"""Answering questions: each in a task of its own, bounded, every defect of a handler contained here."""
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false, reportUnknownVariableType=false
# The library's stubs leave out the return types of methods that return nothing.

import asyncio
from collections.abc import Awaitable, Callable
from functools import partial

import structlog
import zenoh

from appliance.errors import PayloadError, RefusedError, SwiftbotError, UnreachableError
from appliance.plane import link
from appliance.plane.doors import Doors
from appliance.plane.wire import Closer, Wire

log = structlog.get_logger(__name__)


Answer = Callable[[bytes | None, SwiftbotError | None], None]
"""Answers one question, from any thread."""
Handler = Callable[[str, bytes], Awaitable[bytes]]
"""Answers a question for a key, on the event loop."""


class Answering:
    """What is served on one session."""

    def __init__(self, wire: Wire, doors: Doors) -> None:
        self.wire = wire
        self._doors = doors
        self._answering: set[asyncio.Task[None]] = set()

    def serve(self, expr: str, handler: Handler, *, bulk: bool = False) -> Closer:
        """Answer queries on `expr`, each in a task of its own, at most `concurrent_queries` at once.

        `bulk`: answers are raw bytes and wait in a queue of their own; their priority is that of the question.

        A SwiftbotError of the handler is answered as ErrorReply; any other exception is logged with its traceback
        and answered as ErrorReply of code `internal`: this is where a handler's defects are contained.

        A question that was meant for another key is refused as `unreachable`: after links were made anew Zenoh 1.10 has
        been seen to deliver a query to the wrong queryable of a session or process, which made one robot do another's
        command. `query` writes down for whom it is; what other Zenoh clients ask says nothing of it.
        """
        served = Served(self, expr, handler, bulk=bulk)
        queryable = self.wire.raw.declare_queryable(expr, link.callback(served.take), complete=True)
        return Closer(queryable.undeclare)

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

    def __init__(self, answering: Answering, expr: str, handler: Handler, *, bulk: bool = False) -> None:
        self.expr, self.handler = expr, handler
        self.name = answering.wire.name(expr)
        self.running: set[asyncio.Task[None]] = set()
        self._answering, self._wire = answering, answering.wire
        self._door = None if "*" in expr else expr.encode()
        self._bulk = bulk

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
            begin = partial(answering.begin, self, str(query.key_expr), data, reply)
        if not self._wire.inbox.post(begin, size):
            link.reply(query, self.expr, None, RefusedError("too busy", remedy="try again in a moment"))
