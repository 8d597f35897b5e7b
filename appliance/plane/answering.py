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


class Answering:
    """What is served on one session."""

    def __init__(self, wire: Wire, doors: Doors, direct: Direct) -> None:
        self._wire = wire
        self._doors = doors
        self._direct = direct
        self._answering: set[asyncio.Task[None]] = set()

    def serve(
        self,
        expr: str,
        handler: Callable[[str, bytes], Awaitable[bytes]],
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
        limit, running, name = self._wire.config.max_payload_bytes, set[asyncio.Task[None]](), self._wire.name(expr)
        door = None if "*" in expr else expr.encode()

        def take(query: zenoh.Query) -> None:
            payload = query.payload
            size = len(payload) if payload is not None else 0
            marked, meant = link.read_mark(query)
            reply = partial(self._reply, query, expr, bulk, marked)
            if meant and door is not None and meant != door:
                error = UnreachableError(f"{expr}: {link.WRONG_DOOR}", remedy="ask again in a moment")
                begin = partial(self._misrouted, name, expr, link.asker_of(query), reply, error)
                size = 0
            elif size > limit:
                error = PayloadError(f"{query.key_expr}: {size:,} bytes", remedy=f"at most {limit:,}")
                begin = partial(self._refuse, f"oversize {name}", str(query.key_expr), reply, error)
                size = 0
            else:
                data = payload.to_bytes() if payload is not None else b""
                if at_once is not None and marked and at_once(data, partial(link.reply_direct, query, expr)):
                    return
                begin = partial(answer, str(query.key_expr), data, reply)
            if not self._wire.inbox.post(begin, size):
                link.reply(query, expr, None, RefusedError("too busy", remedy="try again in a moment"))

        def take_direct(asked: Asked, payload: zenoh.ZBytes) -> None:
            size = len(payload)
            reply = partial(self._direct.answer, asked)
            if asked.key != door:
                # Asked again as a query it is refused, and whoever asked learns by whom.
                error = UnreachableError(f"{expr}: {link.WRONG_DOOR}")
                begin = partial(self._refuse, f"misrouted {name}", expr, partial(_again, reply), error)
                size = 0
            elif size > link.MOST_DIRECT:
                error = PayloadError(f"{expr}: {size:,} bytes", remedy=f"at most {link.MOST_DIRECT:,} in a message")
                begin = partial(self._refuse, f"oversize {name}", expr, reply, error)
                size = 0
            else:
                data = payload.to_bytes()
                if at_once is not None and at_once(data, reply):
                    return
                begin = partial(answer, expr, data, reply)
            if not self._wire.inbox.post(begin, size):
                reply(None, RefusedError("too busy", remedy="try again in a moment"))

        def answer(key: str, data: bytes, reply: Answer) -> None:
            if len(running) >= self._wire.config.concurrent_queries:
                error = RefusedError(f"{key}: {len(running)} queries are being answered", remedy="try again later")
                self._refuse(f"too many {name}", key, reply, error)
                return
            task = self._wire.loop.create_task(self._answer(handler, name, key, data, reply))
            for group in (running, self._answering):
                group.add(task)
                task.add_done_callback(group.discard)

        queryable = self._wire.raw.declare_queryable(expr, threads.callback(take), complete=True)
        messages = self._direct.serve(expr, take_direct) if direct else None

        def end() -> None:
            if messages is not None:
                messages.close()
            queryable.undeclare()

        return Closer(end)

    async def _answer(
        self,
        handler: Callable[[str, bytes], Awaitable[bytes]],
        name: str,
        key: str,
        data: bytes,
        reply: Answer,
    ) -> None:
        answer: bytes | None = None
        error: SwiftbotError | None = None
        try:
            answer = await handler(key, data)
            if len(answer) > self._wire.config.max_payload_bytes:
                error = PayloadError(f"{key}: the answer has {len(answer):,} bytes", remedy="ask for less at once")
        except SwiftbotError as refusal:
            if isinstance(refusal, PayloadError):
                self._wire.refuse(f"malformed {name}", key=key, reason=str(refusal))
            error = refusal
        except asyncio.CancelledError:
            error = UnreachableError("whoever was asked is stopping", remedy="ask another gateway")
            raise
        except Exception as defect:  # the supervision boundary of `serve`
            log.exception("a query's handler failed", key=key)
            error = SwiftbotError(f"{type(defect).__name__}: {defect}")
        finally:
            reply(answer, error)

    def _reply(
        self, query: zenoh.Query, expr: str, bulk: bool, marked: bool, answer: bytes | None, error: SwiftbotError | None
    ) -> None:
        """Answer a query; one marked as direct from here, others on the sender's thread."""
        if self._wire.closed:
            link.reply(query, expr, answer, error)
        elif marked:
            link.reply_direct(query, expr, answer, error)
        else:
            size = len(answer) if answer is not None and error is None else 0
            self._wire.send(expr, partial(link.reply, query, expr, answer, error, bulk=bulk), size, bulk=bulk)

    def _misrouted(self, name: str, expr: str, asker: str, reply: Answer, error: SwiftbotError) -> None:
        """Refuse a question for another key; the links over which it came may be mixed up."""
        self._refuse(f"misrouted {name}", expr, reply, error)
        self._doors.was_wrong(asker)

    def _refuse(self, what: str, key: str, reply: Answer, error: SwiftbotError) -> None:
        self._wire.refuse(what, key=key, reason=str(error))
        reply(None, error)

    async def stop(self, wait_s: float) -> None:
        """End every answer under way with an error, waiting at most so long for handlers that tidy up."""
        for task in tuple(self._answering):
            task.cancel()
        if self._answering:
            await asyncio.wait(self._answering, timeout=wait_s)


def _again(reply: Answer, _: bytes | None, __: SwiftbotError | None) -> None:
    """Have a question asked again, as a query."""
    reply(b"", None)
