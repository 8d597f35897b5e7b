"""Liveliness tokens: showing one's own, and seeing those of others come and go."""
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false, reportUnknownVariableType=false
# The library's stubs leave out the return types of methods that return nothing.

import asyncio
import contextlib
from collections.abc import Callable
from functools import partial
from typing import cast

import zenoh

from appliance.plane import link
from appliance.plane.wire import Closer, Wire


class Presence:
    """The tokens of one session."""

    def __init__(self, wire: Wire) -> None:
        self._wire = wire
        self._tokens: set[zenoh.LivelinessToken] = set()

    def declare_alive(self, key: str) -> Closer:
        """Show a liveliness token until closed, or until this process dies."""
        token = self._wire.raw.liveliness().declare_token(key)

        def end() -> None:
            self._tokens.discard(token)
            token.undeclare()

        # Kept here: unlike a subscription, a token that nobody holds is taken back by the garbage collector.
        self._tokens.add(token)
        return Closer(end)

    async def alive_now(self, expr: str, *, timeout_s: float = 1.0) -> list[str]:
        """Return the keys of the tokens that are there now; those that could be had in time."""
        inbox = self._wire.inbox
        found: list[str] = []
        ended = asyncio.Event()

        def take(reply: zenoh.Reply) -> None:
            if (sample := reply.ok) is not None:
                inbox.post(partial(found.append, str(sample.key_expr)), must=True)

        ask = partial(
            self._wire.raw.liveliness().get,
            expr,
            link.callback(take, drop=partial(inbox.post, ended.set, must=True)),
            timeout=timeout_s,
        )
        self._wire.send(expr, cast("Callable[[], None]", ask), 0)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                await ended.wait()
        return sorted(found)

    def watch_alive(self, expr: str, callback: Callable[[str, bool], None]) -> Closer:
        """Have the coming (True) and going (False) of tokens delivered, those already there first."""
        inbox = self._wire.inbox

        def take(sample: zenoh.Sample) -> None:
            alive = sample.kind == zenoh.SampleKind.PUT
            inbox.post(partial(deliver, str(sample.key_expr), alive), must=True)

        def deliver(key: str, alive: bool) -> None:
            if not closer.closed:
                callback(key, alive)

        # What comes before `closer` is bound waits in the inbox: it is delivered by a later turn of the loop.
        handler = link.callback(take)
        subscriber = self._wire.raw.liveliness().declare_subscriber(expr, handler, history=True)
        closer = Closer(subscriber.undeclare)
        return closer
