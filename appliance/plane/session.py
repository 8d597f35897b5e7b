"""The one thin wrapper around a Zenoh session: nothing else in the product touches the library.

It exists to keep three promises. Every callback runs on the event loop's thread. Every payload that arrives is
bounded, and one that is malformed or oversize is counted, logged and dropped or answered with an ErrorReply.
Nothing that is sent can hang the loop: sends block when a peer is stuck (dropping would lose facts silently), but
they do so on a thread of their own, and a peer stuck for a lease is disconnected.
"""
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false, reportUnknownVariableType=false
# The library's stubs leave out the return types of methods that return nothing.

import asyncio
import contextlib
import time
from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any, TypeVar, cast

import msgspec
import structlog
import zenoh
from msgspec import Struct

from appliance.errors import DeadlineError, PayloadError, RefusedError, SwiftbotError, UnreachableError
from appliance.plane import link
from appliance.plane.keys import Keys
from appliance.plane.queues import Inbox, Outbox
from appliance.plane.settings import PlaneConfig
from appliance.plane.sockets import SocketWatch

log = structlog.get_logger(__name__)

T = TypeVar("T")

Answer = Callable[[bytes | None, SwiftbotError | None], None]
"""Answers one query, from any thread."""

WRONG_DOOR = "the question is not for this"
_AFTER_ANSWER_S = 0.05
"""After a question at the wrong door was answered so, before the links are made anew."""
_CLOSE_S = 2.0
"""How long a closing session keeps sending what waits."""


class Message(Struct, frozen=True):
    """A put or delete as it arrived. `at_ns` is the sender's hybrid logical clock, Unix nanoseconds."""

    key: str
    payload: bytes
    deleted: bool
    at_ns: int
    encoding: str


class Closer:
    """Ends a subscription, service or token; more than once does no harm."""

    def __init__(self, end: Callable[[], None]) -> None:
        self._end: Callable[[], None] | None = end

    @property
    def closed(self) -> bool:
        """Whether it was ended; what was under way to the loop then is not delivered any more."""
        return self._end is None

    def close(self) -> None:
        """End it."""
        end, self._end = self._end, None
        if end is not None:
            # An entity of a closed session is gone already.
            with contextlib.suppress(zenoh.ZError):
                end()


class Session:
    """A Zenoh session of one fleet; made by `open`, ended by `close`."""

    def __init__(self, config: PlaneConfig, fleet: str, raw: zenoh.Session, loop: asyncio.AbstractEventLoop) -> None:
        self.config = config
        self.keys = Keys(fleet)
        self.refused: dict[str, int] = {}
        self._raw = raw
        self._loop = loop
        self._inbox = Inbox(
            loop,
            messages=config.queue_messages,
            payload_bytes=config.queue_bytes,
            on_dropped=lambda count: self.refuse("incoming queue full", count=count),
        )
        self._outbox = Outbox(messages=config.queue_messages, payload_bytes=config.queue_bytes)
        self._bulk: Outbox | None = None
        """Of its own, so that facts and orders never wait behind a volume on a slow link."""
        self._answering: set[asyncio.Task[None]] = set()
        self._asking: set[asyncio.Future[bytes]] = set()
        self._tokens: set[zenoh.LivelinessToken] = set()
        self._closed = False
        self._sockets = SocketWatch(config.lease_ms)
        self._sockets.start()

    @classmethod
    async def open(cls, config: PlaneConfig, fleet: str) -> "Session":
        """Open a session as configured. Peers start in any order and keep looking for each other for ever.

        Raises:
            ConfigError: a setting is wrong, or an endpoint to listen on is in use or not of this machine.
            UnreachableError: a client found no endpoint that answers.
        """
        config.check()
        Keys(fleet)
        raw = await asyncio.to_thread(link.open_raw, config)
        return cls(config, fleet, raw, asyncio.get_running_loop())

    @property
    def linked(self) -> int:
        """Sessions linked to directly just now, however they came about."""
        return len(list(self._raw.info.peers_zid())) + len(list(self._raw.info.routers_zid()))

    @property
    def missed(self) -> int:
        """Messages that arrived and were dropped because the queue to the event loop was full."""
        return self._inbox.dropped

    # --- facts ------------------------------------------------------------------------------------------------

    def put(self, key: str, payload: bytes, *, encoding: str = "application/json") -> None:
        """Publish; returns at once. What cannot be sent (too large, queue full) is counted and logged."""
        if len(payload) > self.config.max_payload_bytes:
            self.refuse("oversize put", key=key, size=len(payload))
            return
        send = partial(
            self._raw.put,
            key,
            payload,
            encoding=encoding,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )
        self._send(key, send, len(payload))

    def delete(self, key: str) -> None:
        """Publish that a key's fact is gone."""
        self._send(key, partial(self._raw.delete, key, congestion_control=zenoh.CongestionControl.BLOCK), 0)

    def _send(self, key: str, send: Callable[[], None], size: int, *, bulk: bool = False) -> None:
        outbox = self._outbox
        if bulk:
            outbox = self._bulk = self._bulk or Outbox(
                messages=self.config.queue_messages, payload_bytes=self.config.queue_bytes
            )
        if not outbox.send(partial(link.quietly, send, key), size) and not self._closed:
            self.refuse("outgoing queue full", key=key)

    def subscribe(self, expr: str, callback: Callable[[Message], None]) -> Closer:
        """Have every put and delete under `expr` delivered, as bytes; oversize ones are counted and dropped."""
        name, limit = self._name(expr), self.config.max_payload_bytes

        def take(sample: zenoh.Sample) -> None:
            key, size = str(sample.key_expr), len(sample.payload)
            if size > limit:
                self._inbox.post(partial(self.refuse, f"oversize {name}", key=key, size=size))
                return
            stamp = sample.timestamp
            message = Message(
                key,
                sample.payload.to_bytes(),
                sample.kind == zenoh.SampleKind.DELETE,
                stamp.get_time_as_ntp64().as_nanos() if stamp else time.time_ns(),
                str(sample.encoding),
            )
            self._inbox.post(partial(deliver, message), size)

        def deliver(message: Message) -> None:
            if not closer.closed:
                callback(message)

        subscriber = self._raw.declare_subscriber(expr, zenoh.handlers.Callback(take, indirect=False))
        closer = Closer(subscriber.undeclare)
        return closer

    def subscribe_typed(
        self,
        expr: str,
        kind: type[T],
        callback: Callable[[str, T | None], None],
        *,
        wanted: Callable[[str], bool] = lambda _: True,
    ) -> Closer:
        """Have facts delivered decoded, None when one is deleted; malformed ones are counted, logged, dropped.

        Those whose key is not `wanted` are not even decoded.
        """
        decoder, name = msgspec.json.Decoder(kind), self._name(expr)

        def take(message: Message) -> None:
            if not wanted(message.key):
                return
            if message.deleted:
                callback(message.key, None)
                return
            try:
                value = decoder.decode(message.payload)
            except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
                self.refuse(f"malformed {name}", key=message.key, reason=str(error))
                return
            callback(message.key, value)

        return self.subscribe(expr, take)

    # --- questions --------------------------------------------------------------------------------------------

    def serve(
        self,
        expr: str,
        handler: Callable[[str, bytes], Awaitable[bytes]],
        *,
        bulk: bool = False,
        at_once: Callable[[bytes, Answer], bool] | None = None,
    ) -> Closer:
        """Answer queries on `expr`, each in a task of its own, at most `concurrent_queries` at once.

        `bulk`: answers are raw bytes and wait in a queue of their own; their priority is that of the question.
        `at_once`: tried first for direct questions, on Zenoh's own thread: it must neither block nor touch what
        belongs to the event loop. It says whether it answers, or has another thread answer; if not, the handler does.

        A SwiftbotError of the handler is answered as ErrorReply; any other exception is logged with its traceback
        and answered as ErrorReply of code `internal`: this is where a handler's defects are contained.

        A question that was meant for another key is refused as `unreachable`: after links were made anew Zenoh 1.10 has
        been seen to deliver a query to the wrong queryable of a session or process, which made one robot do another's
        command. `query` writes down for whom it is; what other Zenoh clients ask says nothing of it.
        """
        limit, running, name = self.config.max_payload_bytes, set[asyncio.Task[None]](), self._name(expr)

        def take(query: zenoh.Query) -> None:
            key, payload = str(query.key_expr), query.payload
            size = len(payload) if payload is not None else 0
            meant = query.attachment.to_bytes() if query.attachment is not None else b""
            direct, meant = meant.startswith(link.MARK), meant.removeprefix(link.MARK)
            if meant and "*" not in expr and meant != expr.encode():
                error = UnreachableError(f"{expr}: {WRONG_DOOR}", remedy="ask again in a moment")
                begin = partial(self._misrouted, name, query, expr, error)
                size = 0
            elif size > limit:
                error = PayloadError(f"{key}: {size:,} bytes", remedy=f"at most {limit:,}")
                begin = partial(self._refuse_query, f"oversize {name}", query, expr, error)
                size = 0
            else:
                data = payload.to_bytes() if payload is not None else b""
                if at_once is not None and direct and at_once(data, partial(link.reply_direct, query, expr)):
                    return
                begin = partial(answer, key, data, query)
            if not self._inbox.post(begin, size):
                link.reply(query, expr, None, RefusedError("too busy", remedy="try again in a moment"))

        def answer(key: str, data: bytes, query: zenoh.Query) -> None:
            if len(running) >= self.config.concurrent_queries:
                error = RefusedError(f"{key}: {len(running)} queries are being answered", remedy="try again later")
                self._refuse_query(f"too many {name}", query, expr, error)
                return
            task = self._loop.create_task(self._answer(handler, key, data, query, expr, bulk=bulk))
            for group in (running, self._answering):
                group.add(task)
                task.add_done_callback(group.discard)

        queryable = self._raw.declare_queryable(expr, zenoh.handlers.Callback(take, indirect=False), complete=True)
        return Closer(queryable.undeclare)

    async def _answer(
        self,
        handler: Callable[[str, bytes], Awaitable[bytes]],
        key: str,
        data: bytes,
        query: zenoh.Query,
        expr: str,
        *,
        bulk: bool,
    ) -> None:
        reply: bytes | None = None
        error: SwiftbotError | None = None
        try:
            reply = await handler(key, data)
            if len(reply) > self.config.max_payload_bytes:
                error = PayloadError(f"{key}: the answer has {len(reply):,} bytes", remedy="ask for less at once")
        except SwiftbotError as refusal:
            if isinstance(refusal, PayloadError):
                self.refuse(f"malformed {self._name(expr)}", key=key, reason=str(refusal))
            error = refusal
        except asyncio.CancelledError:
            error = UnreachableError("whoever was asked is stopping", remedy="ask another gateway")
            raise
        except Exception as defect:  # the supervision boundary of `serve`
            log.exception("a query's handler failed", key=key)
            error = SwiftbotError(f"{type(defect).__name__}: {defect}")
        finally:
            size = len(reply) if reply is not None and error is None else 0
            if self._closed:
                link.reply(query, expr, reply, error)
            elif link.is_direct(query):
                link.reply_direct(query, expr, reply, error)
            else:
                self._send(key, partial(link.reply, query, expr, reply, error, bulk=bulk), size, bulk=bulk)

    def _misrouted(self, name: str, query: zenoh.Query, expr: str, error: SwiftbotError) -> None:
        """Refuse a question for another key, and make the links anew over which it came: they are mixed up for good."""
        self._refuse_query(f"misrouted {name}", query, expr, error)
        self._loop.call_later(_AFTER_ANSWER_S, self._reset_links)

    def _reset_links(self) -> None:
        if not self._closed and (broken := self._sockets.reset()):
            log.warning("links are made anew, since questions arrived at wrong doors", links=broken)

    def _refuse_query(self, what: str, query: zenoh.Query, expr: str, error: SwiftbotError) -> None:
        self.refuse(what, key=str(query.key_expr), reason=str(error))
        self._send(expr, partial(link.reply, query, expr, None, error), 0)

    async def query(
        self, key: str, payload: bytes, *, timeout_s: float, bulk: bool = False, direct: bool = False
    ) -> bytes:
        """Ask whoever serves a key and return the first answer; `bulk`: other messages go before it.

        `direct`: sent from here, past the queue of the sender's thread, and dropped when the link is full. For small
        questions that can be asked again, where the way there and back matters.

        Raises:
            UnreachableError: nobody serves the key, or whoever did went away before answering.
            DeadlineError: no answer within `timeout_s` seconds.
            PayloadError: the request or the answer is too large.
            SwiftbotError: what the answering side raised.
        """
        direct = direct and len(payload) <= link.MOST_DIRECT
        until = self._loop.time() + timeout_s
        answer: asyncio.Future[bytes] = self._loop.create_future()
        self._asking.add(answer)

        def on_reply(_: str, data: bytes | None, error: SwiftbotError | None) -> None:
            if not answer.done():
                if error is not None:
                    if WRONG_DOOR in str(error):
                        # Mixed up may be the link from here, or one further on: both ends make theirs anew.
                        self._loop.call_later(_AFTER_ANSWER_S, self._reset_links)
                    answer.set_exception(error)
                elif data is not None:
                    answer.set_result(data)

        def on_end() -> None:
            if not answer.done():
                answer.set_exception(
                    UnreachableError(f"nobody answers on {key}", remedy="is that gateway or robot up and linked?")
                )

        try:
            target = zenoh.QueryTarget.BEST_MATCHING
            meant = link.MARK + key.encode() if direct else key.encode()
            self._get(key, payload, timeout_s, on_reply, on_end, target=target, bulk=bulk, direct=direct, meant=meant)
            async with asyncio.timeout_at(until):
                data = await answer
            if data or not direct:
                return data
        except TimeoutError:
            raise DeadlineError(f"no answer on {key} within {timeout_s:g} s") from None
        finally:
            self._asking.discard(answer)
            answer.cancel()
        # The answer is too large to be sent so.
        return await self.query(key, payload, timeout_s=max(0.0, until - self._loop.time()), bulk=bulk)

    async def query_all(self, expr: str, payload: bytes, *, timeout_s: float) -> list[Message]:
        """Ask everybody who serves a key of `expr`; returns the answers that came in time, errors left out."""
        messages: list[Message] = []
        ended = asyncio.Event()

        def on_reply(key: str, data: bytes | None, error: SwiftbotError | None) -> None:
            if data is not None:
                messages.append(Message(key, data, deleted=False, at_ns=time.time_ns(), encoding="application/json"))
            elif error is not None:
                log.debug("an answer is an error", expr=expr, error=str(error))

        self._get(expr, payload, timeout_s, on_reply, ended.set, target=zenoh.QueryTarget.ALL)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                await ended.wait()
        return list(messages)

    def _get(
        self,
        expr: str,
        payload: bytes,
        timeout_s: float,
        on_reply: Callable[[str, bytes | None, SwiftbotError | None], None],
        on_end: Callable[[], None],
        *,
        target: zenoh.QueryTarget,
        bulk: bool = False,
        direct: bool = False,
        meant: bytes | None = None,
    ) -> None:
        limit = self.config.max_payload_bytes
        if len(payload) > limit:
            raise PayloadError(f"a request of {len(payload):,} bytes on {expr}", remedy=f"at most {limit:,}")
        if self._closed:
            raise UnreachableError("the session is closed")

        def take(reply: zenoh.Reply) -> None:
            sample = reply.ok
            if sample is None:
                error = link.error_of(reply.err)
                self._inbox.post(partial(on_reply, expr, None, error), must=True)
            elif (size := len(sample.payload)) > limit:
                self._inbox.post(partial(self.refuse, "oversize answer", key=expr, size=size))
                error = PayloadError(f"the answer on {expr} has {size:,} bytes", remedy=f"at most {limit:,}")
                self._inbox.post(partial(on_reply, expr, None, error), must=True)
            else:
                data = sample.payload.to_bytes()
                self._inbox.post(partial(on_reply, str(sample.key_expr), data, None), size, must=True)

        priority = zenoh.Priority.DATA_LOW if bulk else zenoh.Priority.DATA
        control = zenoh.CongestionControl
        send = partial(
            self._raw.get,
            expr,
            zenoh.handlers.Callback(take, drop=partial(self._inbox.post, on_end, must=True), indirect=False),
            target=target,
            consolidation=zenoh.ConsolidationMode.NONE,
            # Ours decides; Zenoh's only makes sure that nothing is kept for ever.
            timeout=timeout_s + 1.0,
            congestion_control=control.DROP if direct else control.BLOCK,
            priority=zenoh.Priority.DATA_HIGH if direct else priority,
            express=True,
            payload=payload,
            attachment=meant,
        )
        if direct:
            link.quietly(cast("Callable[[], None]", send), expr)
        else:
            self._send(expr, cast("Callable[[], None]", send), len(payload))

    # --- presence ---------------------------------------------------------------------------------------------

    def declare_alive(self, key: str) -> Closer:
        """Show a liveliness token until closed, or until this process dies."""
        token = self._raw.liveliness().declare_token(key)

        def end() -> None:
            self._tokens.discard(token)
            token.undeclare()

        # Kept here: unlike a subscription, a token that nobody holds is taken back by the garbage collector.
        self._tokens.add(token)
        return Closer(end)

    async def alive_now(self, expr: str, *, timeout_s: float = 1.0) -> list[str]:
        """Return the keys of the tokens that are there now; those that could be had in time."""
        found: list[str] = []
        ended = asyncio.Event()

        def take(reply: zenoh.Reply) -> None:
            if (sample := reply.ok) is not None:
                self._inbox.post(partial(found.append, str(sample.key_expr)), must=True)

        ask = partial(
            self._raw.liveliness().get,
            expr,
            zenoh.handlers.Callback(take, drop=partial(self._inbox.post, ended.set, must=True), indirect=False),
            timeout=timeout_s,
        )
        self._send(expr, cast("Callable[[], None]", ask), 0)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                await ended.wait()
        return sorted(found)

    def watch_alive(self, expr: str, callback: Callable[[str, bool], None]) -> Closer:
        """Have the coming (True) and going (False) of tokens delivered, those already there first."""

        def take(sample: zenoh.Sample) -> None:
            alive = sample.kind == zenoh.SampleKind.PUT
            self._inbox.post(partial(deliver, str(sample.key_expr), alive), must=True)

        def deliver(key: str, alive: bool) -> None:
            if not closer.closed:
                callback(key, alive)

        # What comes before `closer` is bound waits in the inbox: it is delivered by a later turn of the loop.
        handler = zenoh.handlers.Callback(take, indirect=False)
        subscriber = self._raw.liveliness().declare_subscriber(expr, handler, history=True)
        closer = Closer(subscriber.undeclare)
        return closer

    # --- bad input, end ---------------------------------------------------------------------------------------

    def refuse(self, what: str, *, count: int = 1, **fields: Any) -> None:
        """Count bad input; logged the first ten times, then at powers of two: a flood does not fill the log."""
        before = self.refused.get(what, 0)
        total = self.refused[what] = before + count
        if total <= 10 or before.bit_length() != total.bit_length():
            fields = {key: value[:300] if isinstance(value, str) else value for key, value in fields.items()}
            log.warning("refused", what=what, count=total, **fields)

    def _name(self, expr: str) -> str:
        return expr.removeprefix(f"{self.keys.root}/")

    async def close(self) -> None:
        """End every query under way with an error, send what waits, close. Needed: Zenoh hangs the exit without."""
        if self._closed:
            return
        for task in tuple(self._answering):
            task.cancel()
        if self._answering:
            await asyncio.wait(self._answering, timeout=_CLOSE_S)
        self._closed = True
        for answer in self._asking:
            if not answer.done():
                answer.set_exception(UnreachableError("the session was closed"))
        await asyncio.to_thread(self._outbox.close, _CLOSE_S)
        if self._bulk is not None:
            await asyncio.to_thread(self._bulk.close, _CLOSE_S)
        await asyncio.to_thread(self._raw.close)
        self._sockets.close()
        self._inbox.close()
