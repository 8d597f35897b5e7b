"""The one thin wrapper around a Zenoh session: nothing else in the product touches the library.

It exists to keep three promises. Every callback runs on the event loop's thread. Every payload that arrives is
bounded, and one that is malformed or oversize is counted, logged and dropped or answered with an ErrorReply.
Nothing that is sent can hang the loop: sends block when a peer is stuck (dropping would lose facts silently), but
they do so on a thread of their own, and a peer stuck for a lease is disconnected.

Its parts are `publishing` (facts), `answering` and `asking` (questions), `presence` (liveliness tokens) and `doors`
(links that are mixed up), each around the same `wire`.
"""
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false, reportUnknownVariableType=false
# The library's stubs leave out the return types of methods that return nothing.

import asyncio
from functools import partial

import zenoh

from appliance.plane import link
from appliance.plane.answering import Answering
from appliance.plane.asking import Asking
from appliance.plane.doors import Doors
from appliance.plane.keys import Keys
from appliance.plane.presence import Presence
from appliance.plane.publishing import Message, Publishing
from appliance.plane.settings import PlaneConfig
from appliance.plane.sockets import SocketWatch
from appliance.plane.verbs import Verbs
from appliance.plane.wire import Closer, Wire

__all__ = ["Closer", "Message", "Session"]

_CLOSE_S = 2.0
"""How long a closing session keeps sending what waits."""


class Session:
    """A Zenoh session of one fleet; made by `open`, ended by `close`."""

    def __init__(self, config: PlaneConfig, fleet: str, raw: zenoh.Session, loop: asyncio.AbstractEventLoop) -> None:
        wire = Wire(config, fleet, raw, loop)
        self.config = config
        self.keys: Keys = wire.keys
        self.refused: dict[str, int] = wire.refused
        """Counts of bad input by kind."""
        self.refuse = wire.refuse
        self._wire = wire
        self._sockets = SocketWatch.shared(config.lease_ms)
        doors = Doors(wire, self._sockets)
        publishing, presence = Publishing(wire, self._serve_backlog), Presence(wire)
        self._answering, self._asking = Answering(wire, doors), Asking(wire, doors)
        self.put = publishing.put
        self.delete = publishing.delete
        self.flood = publishing.flood
        self.subscribe = publishing.subscribe
        self.subscribe_typed = publishing.subscribe_typed
        self.serve = self._answering.serve
        self.serve_verbs = partial(Verbs, self._answering)
        self.query = self._asking.query
        self.ask = self._asking.ask
        self.query_all = self._asking.query_all
        self.answerers = self._asking.answerers
        self.declare_alive = presence.declare_alive
        self.alive_now = presence.alive_now
        self.watch_alive = presence.watch_alive
        self.renew_links = doors.renew

    @classmethod
    async def open(cls, config: PlaneConfig, fleet: str, gateway: str = "") -> "Session":
        """Open a session as configured. Peers start in any order and keep looking for each other for ever.

        `gateway`: whose it is, where it is one's: which of two dials the other goes by their names.

        Raises:
            ConfigError: a setting is wrong, or an endpoint to listen on is in use or not of this machine.
            UnreachableError: a client found no endpoint that answers.
        """
        config.check()
        Keys(fleet)
        raw = await asyncio.to_thread(link.open_raw, config, gateway)
        return cls(config, fleet, raw, asyncio.get_running_loop())

    def _serve_backlog(self) -> None:
        """Answer for what this session puts; one that never puts has no such queryable."""
        backlog = self._wire.backlog
        self._answering.serve(self.keys.backlog(str(self._wire.raw.zid())), backlog.answered, bulk=True)

    @property
    def linked(self) -> int:
        """Sessions linked to directly just now, however they came about."""
        info = self._wire.raw.info
        return len(list(info.peers_zid())) + len(list(info.routers_zid()))

    @property
    def missed(self) -> int:
        """Messages that arrived and were dropped because the queue to the event loop was full."""
        return self._wire.inbox.dropped

    @property
    def unsent(self) -> int:
        """Messages that wait to be sent: whoever sends many waits for the others to take them."""
        return self._wire.outbox.waiting

    async def close(self) -> None:
        """End every query under way with an error, send what waits, close. Needed: Zenoh hangs the exit without."""
        if self._wire.closed:
            return
        await self._answering.stop(_CLOSE_S)
        self._wire.closed = True
        self._asking.stop()
        await self._wire.close(_CLOSE_S)
        self._sockets.close()
        self._wire.inbox.close()
