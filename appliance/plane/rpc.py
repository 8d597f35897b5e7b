"""Requests from one gateway to another: a verb is a query on `gw/{gateway}/rpc/{verb}`, JSON in and out.

Queries cannot be subscribed to, so the answering gateway puts a record of each exchange where the recorder and
any Zenoh client can see it; what would be too large there is named by its digest.
"""

import hashlib
import time
from collections.abc import Awaitable, Callable
from typing import Any, Generic, TypeVar

import msgspec
from msgspec import Raw, Struct

from appliance.errors import ConfigError, PayloadError, SwiftbotError
from appliance.model import ErrorReply, encode
from appliance.plane.session import Question, Session

Q = TypeVar("Q", bound=Struct)
R = TypeVar("R", bound=Struct)

_EXCHANGE_BYTES = 32 * 1024
"""A request or reply larger than this appears in its exchange record by size and digest only."""


class Exchange(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What was asked of a gateway and what it answered; published after the answer."""

    verb: str
    gateway: str
    request: Raw
    duration_ms: float
    reply: Raw = Raw(b"null")
    """JSON null where there is an `error` (a union with None would not be decoded as raw JSON)."""
    error: ErrorReply | None = None


class Digest(Struct, frozen=True):
    """In place of a payload that is too large to repeat."""

    bytes: int
    sha256: str


class Call(Generic[R]):
    """A request that is under way."""

    def __init__(self, session: Session, question: Question, gateway: str, verb: str, reply: type[R]) -> None:
        self._session = session
        self._question = question
        self._gateway, self._verb, self._reply = gateway, verb, reply

    async def answer(self) -> R:
        """Wait for the answer; errors as of `Rpc.call`."""
        return _decoded(self._session, self._gateway, self._verb, await self._question.answer(), self._reply)

    def end(self) -> None:
        """Wait for it no more."""
        self._question.end()


class Rpc:
    """Serves one gateway's verbs and calls those of others; a client (`gateway` None) only calls."""

    def __init__(self, session: Session, gateway: str | None) -> None:
        self.refuse = session.refuse
        """Counts bad input of those that are asked or ask."""
        self._session = session
        self._gateway = gateway
        self._verbs = None if gateway is None else session.serve_verbs(session.keys.rpc(gateway))
        self._registered = set[str]()

    def register(
        self,
        verb: str,
        request: type[Q],
        handler: Callable[[Q], Awaitable[Struct]],
        *,
        exchange: bool = True,
    ) -> None:
        """Answer a verb. `exchange=False` is for the plane's own traffic, which would repeat what is put anyway."""
        gateway = self._gateway
        if gateway is None or self._verbs is None or verb in self._registered:
            raise ConfigError(f"the verb {verb} cannot be served here")
        decoder = msgspec.json.Decoder(request)

        async def answer(payload: bytes) -> bytes:
            try:
                asked = decoder.decode(payload)
            except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
                raise PayloadError(
                    f"{verb}: not a {request.__name__}: {error}", remedy="docs/keyspace.md has the requests"
                ) from error
            return encode(await handler(asked))

        async def serve(payload: bytes) -> bytes:
            if not exchange:
                return await answer(payload)
            began = time.monotonic()
            try:
                reply = await answer(payload)
            except Exception as error:
                self._publish(verb, gateway, payload, began, error)
                raise
            self._publish(verb, gateway, payload, began, reply)
            return reply

        self._registered.add(verb)
        self._verbs.add(verb, lambda _, payload: serve(payload))

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
        self._session.put(self._session.keys.exchange(gateway, verb), encode(record))

    async def call(
        self,
        gateway: str,
        verb: str,
        request: Struct,
        reply: type[R],
        *,
        timeout_s: float = 5.0,
        direct: bool = False,
    ) -> R:
        """Ask a gateway; `direct` and errors as of `Session.query`, and PayloadError when the answer is no `reply`."""
        return await self.begin(gateway, verb, request, reply, timeout_s=timeout_s, direct=direct).answer()

    def begin(
        self, gateway: str, verb: str, request: Struct, reply: type[R], *, timeout_s: float, direct: bool = False
    ) -> "Call[R]":
        """Do the same, but only send the request, and have the answer awaited afterwards."""
        key = self._session.keys.rpc(gateway, verb)
        question = self._session.ask(key, encode(request), timeout_s=timeout_s, direct=direct)
        return Call(self._session, question, gateway, verb, reply)

    def close(self) -> None:
        """Answer no more."""
        if self._verbs is not None:
            self._verbs.close()


def _decoded(session: Session, gateway: str, verb: str, answer: bytes, reply: type[R]) -> R:
    try:
        return msgspec.json.decode(answer, type=reply)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        session.refuse(f"malformed answer {verb}", key=session.keys.rpc(gateway, verb), reason=str(error))
        raise PayloadError(f"{gateway} answered {verb} with no {reply.__name__}: {error}") from error


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
