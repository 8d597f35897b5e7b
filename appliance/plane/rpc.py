"""Requests from one gateway to another: a verb is a query on `gw/{gateway}/rpc/{verb}`, JSON in and out.

Queries cannot be subscribed to, so the answering gateway puts a record of each exchange where the recorder and
any Zenoh client can see it; what would be too large there is named by its digest. A gateway that calls a verb of its
own calls the handler: no message, no exchange.
"""

import asyncio
import contextlib
import hashlib
import time
from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any, Generic

import msgspec
import structlog
from msgspec import Raw, Struct
from msgspec.structs import replace

from appliance.errors import ConfigError, DeadlineError, PayloadError, SwiftbotError, UnreachableError
from appliance.identity.member import SENDER
from appliance.model import ErrorReply, encode, keyspace
from appliance.model.keys import Q, R, Verb
from appliance.model.plane_api import Exchange
from appliance.model.roles import Role
from appliance.plane.session import Question, Session

log = structlog.get_logger(__name__)

_EXCHANGE_BYTES = 32 * 1024
"""A request or reply larger than this appears in its exchange record by size and digest only."""


class Digest(Struct, frozen=True):
    """In place of a payload that is too large to repeat."""

    bytes: int
    sha256: str


class Call(Generic[R]):
    """A request that is under way."""

    def __init__(self, session: Session, question: Question, gateway: str, verb: Verb[Any, R]) -> None:
        self._session = session
        self._question = question
        self._gateway, self._verb = gateway, verb

    async def answer(self) -> R:
        """Wait for the answer; errors as of `Rpc.call`."""
        return _decoded(self._session, self._gateway, self._verb, await self._question.answer())

    def end(self) -> None:
        """Wait for it no more."""
        self._question.end()


class Rpc:
    """Serves one gateway's verbs and calls those of others; a client (`gateway` None) only calls."""

    def __init__(self, session: Session, gateway: str | None) -> None:
        self.refuse = session.refuse
        """Counts bad input of those that are asked or ask."""
        self.deny = session.deny
        """The same, for whom it is from: the audit has it too."""
        self._session = session
        self._gateway = gateway
        self._verbs = None if gateway is None else session.serve_verbs(session.keys(keyspace.RPC, gateway))
        self._handlers: dict[str, Callable[[Any], Awaitable[Struct]]] = {}
        self._local_calls: set[asyncio.Future[Struct]] = set()
        self._under_way: dict[str, set[asyncio.Future[None]]] = {}
        """Calls of other gateways."""
        self._away: dict[str, tuple[asyncio.Event, asyncio.TimerHandle]] = {}
        """Gateways that reopen their sessions -> what says that they are back."""

    def register(self, verb: Verb[Q, R], handler: Callable[[Q], Awaitable[R]]) -> None:
        """Answer a verb; ConfigError where it is answered already, and on the session of a client."""
        gateway, name = self._gateway, verb.name
        if gateway is None or self._verbs is None or name in self._handlers:
            raise ConfigError(f"the verb {name} cannot be served here")
        decoder = msgspec.json.Decoder(verb.request)

        async def answer(payload: bytes) -> bytes:
            try:
                asked = decoder.decode(payload)
            except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
                raise PayloadError(
                    f"{name}: not a {verb.request.__name__}: {error}", remedy="docs/keyspace.md has the requests"
                ) from error
            return encode(await handler(_attributed(asked)))

        async def serve(payload: bytes) -> bytes:
            if not verb.exchange:
                return await answer(payload)
            began = time.monotonic()
            try:
                reply = await answer(payload)
            except Exception as error:
                self._publish(name, gateway, payload, began, error)
                raise
            self._publish(name, gateway, payload, began, reply)
            return reply

        self._handlers[name] = handler
        signers = verb.asks if verb.signed else None
        self._verbs.add(name, lambda _, payload: serve(payload), signers=signers, urgent=verb.urgent)

    def _publish(self, verb: str, gateway: str, payload: bytes, began: float, outcome: bytes | Exception) -> None:
        reply, error = (outcome, None) if isinstance(outcome, bytes) else (None, _failure(outcome))
        record = Exchange(
            verb=verb,
            gateway=gateway,
            request=_shown(payload, checked=error is None),
            reply=Raw(b"null") if reply is None else _shown(reply, checked=True),
            error=error,
            duration_ms=round((time.monotonic() - began) * 1e3, 3),
        )
        self._session.publish(keyspace.EXCHANGE, record, gateway, verb)

    async def call(
        self,
        gateway: str,
        verb: Verb[Q, R],
        request: Q,
        *,
        timeout_s: float | None = None,
        direct: bool = False,
    ) -> R:
        """Ask a gateway; without `timeout_s` within the verb's own.

        `direct` and errors as of `Session.query`, and PayloadError when the answer is no reply of that verb.
        A verb of this gateway itself is a call of its handler, with the same errors.
        """
        if gateway == self._gateway and (handler := self._handlers.get(verb.name)) is not None:
            return await self._call_here(verb, handler(request), verb.timeout_s if timeout_s is None else timeout_s)
        within_s = verb.timeout_s if timeout_s is None else timeout_s
        if gateway in self._away:
            until = time.monotonic() + within_s
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(within_s):
                    await self._away[gateway][0].wait()
            within_s = max(0.0, until - time.monotonic())
        under_way = self._under_way.setdefault(gateway, set())
        ended = asyncio.get_running_loop().create_future()
        under_way.add(ended)
        try:
            return await self.begin(gateway, verb, request, timeout_s=within_s, direct=direct).answer()
        finally:
            ended.set_result(None)
            under_way.discard(ended)
            if not under_way and self._under_way.get(gateway) is under_way:
                del self._under_way[gateway]

    async def away(self, gateway: str, *, quiet_s: float, seconds: float) -> None:
        """Have calls of a gateway wait, for `seconds` at most: it reopens its session.

        Returns when those under way have ended, after `quiet_s` at the latest.
        """
        self.back(gateway)
        timer = asyncio.get_running_loop().call_later(seconds, self.back, gateway)
        self._away[gateway] = asyncio.Event(), timer
        if under_way := self._under_way.get(gateway):
            await asyncio.wait(set(under_way), timeout=quiet_s)

    def back(self, gateway: str) -> None:
        """Call a gateway again."""
        if (waiting := self._away.pop(gateway, None)) is not None:
            event, timer = waiting
            timer.cancel()
            event.set()

    async def _call_here(self, verb: Verb[Q, R], answering: Awaitable[Struct], timeout_s: float) -> R:
        """Wait for a handler of this gateway. It goes on when the caller gives up, as one elsewhere would."""
        work = asyncio.ensure_future(answering)
        self._local_calls.add(work)
        work.add_done_callback(partial(self._ended, verb.name))
        done, _ = await asyncio.wait({work}, timeout=timeout_s)
        if not done:
            raise DeadlineError(f"{verb.name} did not answer in time")
        if work.cancelled():
            raise UnreachableError("the one that was asked is stopping", remedy="ask another gateway")
        error = work.exception()
        if isinstance(error, SwiftbotError):
            raise error
        if error is not None:
            raise SwiftbotError(f"{type(error).__name__}: {error}") from error
        answer = work.result()
        if not isinstance(answer, verb.reply):
            raise PayloadError(f"{verb.name} answered with no {verb.reply.__name__}")
        return answer

    def _ended(self, verb: str, work: asyncio.Future[Struct]) -> None:
        """Log a handler's defect, whether or not its caller still waits."""
        self._local_calls.discard(work)
        if not work.cancelled() and (error := work.exception()) and not isinstance(error, SwiftbotError):
            log.error("a verb's handler failed", verb=verb, exc_info=error)

    def begin(
        self, gateway: str, verb: Verb[Q, R], request: Q, *, timeout_s: float | None = None, direct: bool = False
    ) -> "Call[R]":
        """Do the same, but only send the request, and have the answer awaited afterwards."""
        self._session.check_role(verb.asks, f"ask {verb.name}")
        key = self._session.keys(keyspace.RPC, gateway, verb.name)
        within_s = verb.timeout_s if timeout_s is None else timeout_s
        question = self._session.ask(key, encode(request), timeout_s=within_s, direct=direct, sign=verb.signed)
        return Call(self._session, question, gateway, verb)

    def close(self) -> None:
        """Answer no more; what this gateway has asked itself ends as unreachable."""
        if self._verbs is not None:
            self._verbs.close()
        for work in tuple(self._local_calls):
            work.cancel()
        for gateway in tuple(self._away):
            self.back(gateway)


_NAMES = ("by", "submitter")
"""Fields of requests that say who wants it."""


def _attributed(asked: Q) -> Q:
    """A request with its sender's name in place of any that it gives itself.

    A gateway passes on what others have given it, under their names.
    """
    sender = SENDER.get()
    if sender is None or sender.role is Role.GATEWAY:
        return asked
    named = {each: sender.name for each in _NAMES if each in asked.__struct_fields__}
    return replace(asked, **named) if named else asked


def _decoded(session: Session, gateway: str, verb: Verb[Any, R], answer: bytes) -> R:
    try:
        return msgspec.json.decode(answer, type=verb.reply)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        key = session.keys(keyspace.RPC, gateway, verb.name)
        session.refuse(f"malformed answer {verb.name}", key=key, reason=str(error))
        raise PayloadError(f"{gateway} answered {verb.name} with no {verb.reply.__name__}: {error}") from error


def _failure(error: Exception) -> ErrorReply:
    if isinstance(error, SwiftbotError):
        return ErrorReply(
            code=error.code, message=error.message, remedy=error.remedy, retry_after_s=error.retry_after_s
        )
    return ErrorReply(code="internal", message=f"{type(error).__name__}: {error}")


def _shown(payload: bytes, *, checked: bool) -> Raw:
    """The payload as JSON to embed: itself, its digest when too large, or its text when it is not JSON."""
    if len(payload) > _EXCHANGE_BYTES:
        return Raw(encode(Digest(bytes=len(payload), sha256=hashlib.sha256(payload).hexdigest())))
    if not checked:
        try:
            msgspec.json.decode(payload, type=Any)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            return Raw(encode(payload.decode(errors="replace")))
    return Raw(payload)
