"""Which frames go on to which other ends: MAVLink routing as a pure decider, the clock passed in.

Source: MAVLink guide, "Routing": a frame for everybody goes to all other ends; a frame for a system goes where that
system (or its component) has been heard, and nowhere when it was heard nowhere; nothing goes back to where it came
from. Ends are (link, address): two vehicles on one listening port are two ends. A ring of routers would send a frame
round for ever, so a frame that was seen just before is dropped, and a sender is believed on the end it was heard on
last.
"""

from collections import OrderedDict
from collections.abc import Sequence

from msgspec import Struct

from appliance.robots.mavlink.links.base import Address

BROADCAST = 0


class End(Struct, frozen=True):
    """The other end of a link, or one of several on a link that listens."""

    link: int
    address: Address


class Rules(Struct, frozen=True, kw_only=True):
    """Which messages may pass between a link and the others, by name; an empty set of `only` lets all pass."""

    only_in: frozenset[str] = frozenset()
    not_in: frozenset[str] = frozenset()
    only_out: frozenset[str] = frozenset()
    not_out: frozenset[str] = frozenset()

    def lets_in(self, name: str) -> bool:
        """Whether a message heard on the link may go on to others."""
        return name not in self.not_in and (not self.only_in or name in self.only_in)

    def lets_out(self, name: str) -> bool:
        """Whether a message of another link may be sent on this one."""
        return name not in self.not_out and (not self.only_out or name in self.only_out)


class Passage(Struct, frozen=True, kw_only=True):
    """What routing looks at of a frame. Targets are 0 where a message has none, or means all."""

    system: int
    component: int
    name: str
    raw: bytes
    target_system: int = BROADCAST
    target_component: int = BROADCAST


class Router:
    """Routes of one gateway, learned from what is heard.

    Args:
        rules: of each link, in their order.
        own_system: the gateway's system id: what is meant for it goes nowhere else.
        forget_s: an end that was silent for so long is forgotten, with all that was learned of it.
        repeat_s: the same bytes within so long are a repetition, however they came.
        max_ends: most ends known at once; the longest silent is forgotten first.
    """

    def __init__(
        self,
        rules: Sequence[Rules],
        *,
        own_system: int,
        forget_s: float = 60.0,
        repeat_s: float = 0.5,
        max_ends: int = 256,
    ) -> None:
        self._rules = tuple(rules)
        self._own = own_system
        self._forget_s = forget_s
        self._repeat_s = repeat_s
        self._max_ends = max_ends
        self._ends: OrderedDict[End, float] = OrderedDict()
        """When each was heard last, the longest silent first."""
        self._routes: dict[tuple[int, int], End] = {}
        """Where each (system, component) was heard last."""
        self._seen: OrderedDict[bytes, float] = OrderedDict()

    @property
    def ends(self) -> tuple[End, ...]:
        """Ends heard lately."""
        return tuple(self._ends)

    def knows(self, system: int, component: int) -> bool:
        """Whether that very component has been heard."""
        return (system, component) in self._routes

    def repeated(self, raw: bytes, now: float) -> bool:
        """Whether these bytes came just before; notes that they came now. Bounded by the time, and by 8192 frames."""
        while self._seen:
            oldest = next(iter(self._seen.items()))
            if now - oldest[1] <= self._repeat_s and len(self._seen) <= 8192:
                break
            del self._seen[oldest[0]]
        if raw in self._seen:
            return True
        self._seen[raw] = now
        return False

    def hear(self, passage: Passage, source: End, now: float) -> None:
        """Learn that a sender is at an end."""
        self._ends[source] = now
        self._ends.move_to_end(source)
        self._routes[passage.system, passage.component] = source
        while self._ends:
            silent, at = next(iter(self._ends.items()))
            if now - at <= self._forget_s and len(self._ends) <= self._max_ends:
                break
            del self._ends[silent]
            self._routes = {sender: end for sender, end in self._routes.items() if end != silent}

    def destinations(self, passage: Passage, source: End) -> tuple[End, ...]:
        """Return the ends a frame heard at `source` goes on to."""
        if not self._rules[source.link].lets_in(passage.name) or passage.target_system == self._own:
            return ()
        if passage.target_system == BROADCAST:
            found = set(self._ends)
        else:
            found = self._where(passage.target_system, passage.target_component)
        return tuple(
            sorted(
                (end for end in found if end != source and self._rules[end.link].lets_out(passage.name)),
                key=lambda end: (end.link, end.address),
            )
        )

    def _where(self, system: int, component: int) -> set[End]:
        """Ends of a component; of its whole system where the component is not meant, or was never heard."""
        exact = self._routes.get((system, component)) if component != BROADCAST else None
        if exact is not None:
            return {exact}
        return {end for (heard, _), end in self._routes.items() if heard == system}
