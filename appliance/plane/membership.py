"""Who is there: the gateways whose liveliness token is seen, and the ring made of them.

A token goes when its process dies (at once) or its link has been silent for a lease, so nobody is asked. When a link
is cut and made anew while the other end stands still, Zenoh may forget a token that is there and never mention it
again; whoever hears from a gateway that it is not seen shows a further token, and is there while any of them is.
"""

from collections.abc import Callable

import structlog

from appliance.errors import PayloadError
from appliance.plane.keys import check_name
from appliance.plane.pulse import clock
from appliance.plane.ring import Ring
from appliance.plane.session import Closer, Session

log = structlog.get_logger(__name__)

MOST = 1000
"""Gateways known at once; liveliness of more costs too much (design/platform). More are refused and counted."""
_MOST_TOKENS = 8
"""Of one gateway; more than two mean a mistake."""


class Membership:
    """The gateways of a fleet as this process sees them. `gateway` is this one's id; None for clients."""

    def __init__(self, session: Session, *, gateway: str | None, virtual_nodes: int) -> None:
        self._session = session
        self._gateway = gateway
        self._members: frozenset[str] = frozenset() if gateway is None else frozenset({gateway})
        self._made = self._members, Ring(self._members, virtual_nodes=virtual_nodes)
        """The members that the ring was last made of, and it."""
        self.on_joined: list[Callable[[str], None]] = []
        self.on_lost: list[Callable[[str], None]] = []
        self._tokens: dict[str, set[str]] = {}
        """Name -> keys of the tokens seen."""
        self._since: dict[str, float] = {}
        """Name -> since when a token of it has been seen without a break, by the pulse's clock."""
        self._gone: dict[str, float] = {}
        """Name -> when the last token of it went, by the pulse's clock, of those that have not come back; the last."""
        self._watches: list[Closer] = []
        self._token: Closer | None = None
        self._again: Closer | None = None
        self._shown = 0

    @property
    def members(self) -> frozenset[str]:
        """Ids of the gateways that are there; this one counts itself in."""
        return self._members

    @property
    def ring(self) -> Ring:
        """The ring of the members; made when it is asked for, so that a burst of news makes it once."""
        members, (made_of, ring) = self._members, self._made
        if made_of is not members:
            ring = ring.changed_to(members)
            self._made = members, ring
        return ring

    def sees(self, name: str) -> bool:
        """Whether a gateway counts as there for its questions about records."""
        return name in self._members

    def seen_since(self, moment: float) -> frozenset[str]:
        """The other members whose token was there at a moment of the pulse's clock and has never gone since."""
        return frozenset(name for name, at in self._since.items() if at <= moment)

    def lost_since(self, moment: float) -> frozenset[str]:
        """Those whose last token went after a moment of the pulse's clock, and who have not come back."""
        return frozenset(name for name, at in self._gone.items() if at >= moment)

    def owns(self, key: str) -> bool:
        """Whether a key belongs to this gateway just now."""
        return self.ring.owner(key) == self._gateway

    def start(self) -> None:
        """Begin to watch."""
        keys = self._session.keys
        self._watches = [self._session.watch_alive(each, self._seen) for each in (keys.alive(), keys.alive_again())]

    def add(self, name: str) -> None:
        """Count a gateway in before its token is watched."""
        self._seen(self._session.keys.alive(name), alive=True)

    def join(self) -> None:
        """Show the others that this gateway is there."""
        if self._gateway is not None:
            self._token = self._session.declare_alive(self._session.keys.alive(self._gateway))

    def show_again(self) -> None:
        """Show a token that nobody can have forgotten: somebody does not see the first."""
        if self._gateway is None or self._token is None:
            return
        self._shown += 1
        before, again = self._again, self._session.keys.alive_again(self._gateway, str(self._shown))
        self._again = self._session.declare_alive(again)
        if before is not None:
            before.close()

    def _seen(self, key: str, alive: bool) -> None:
        name = key.removeprefix(f"{self._session.keys.root}/gw/").partition("/")[0]
        if name == self._gateway or not self._count(name, key, alive):
            return
        try:
            check_name(name, "gateway")
        except PayloadError as error:
            self._session.refuse("malformed gw/*/alive", key=key, reason=str(error))
            return
        if alive and len(self._members) >= MOST:
            self._session.refuse("too many gateways", key=key)
            return
        self._gone.pop(name, None)
        if alive:
            self._tokens[name], self._since[name] = {key}, clock()
        else:
            self._since.pop(name, None)
            self._gone[name] = clock()
            while len(self._gone) > MOST:
                del self._gone[next(iter(self._gone))]
        self._members = self._members | {name} if alive else self._members - {name}
        log.info("gateway joined" if alive else "gateway lost", member=name, members=len(self._members))
        self._tell(self.on_joined if alive else self.on_lost, name)

    def _tell(self, listeners: list[Callable[[str], None]], name: str) -> None:
        for callback in tuple(listeners):
            try:
                callback(name)
            except Exception:  # supervision boundary: the other listeners must hear of it all the same
                log.exception("a listener to the membership failed", member=name)

    def _count(self, name: str, key: str, alive: bool) -> bool:
        """Note a token's coming or going; returns whether its gateway comes or goes with it."""
        if name not in self._members:
            return alive
        tokens = self._tokens[name]
        if not alive:
            tokens.discard(key)
            if not tokens:
                del self._tokens[name]
            return not tokens
        if len(tokens) >= _MOST_TOKENS and key not in tokens:
            self._session.refuse("too many tokens of a gateway", key=key)
        else:
            tokens.add(key)
        return False

    def close(self) -> None:
        """Leave: the token is taken back first, so the others take over before this gateway stops answering."""
        for closer in (self._again, self._token, *self._watches):
            if closer is not None:
                closer.close()
        self._token = None
