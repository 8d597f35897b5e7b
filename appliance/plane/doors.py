"""Questions at wrong doors: which links are made anew, so that both ends forget what they knew of each other's keys.

After links were made anew Zenoh 1.10 has been seen to deliver questions to the wrong queryable, for good: the two ends
of a link disagree about which number stands for which key (zenoh issue 1886). Whoever is asked refuses such a question
(`answering`), and a new link mends it. But anybody may attach a wrong key to a question, or answer that a door is the
wrong one, and say that it is somebody else. So nobody's word breaks a link that others use:

- whoever *asked*, and is linked to the one that answered, makes just that link anew. The one that was asked does
  nothing: the link is the same, and the asker has no doubt about what it meant.
- where there is something between the two, the link that is mixed up is not known. Then all of Zenoh's links of this
  process are made anew, but only when two different sessions have met a wrong door here within a minute: one is not
  believed, and an attempt that fails for such a reason is made by another gateway next.
- whoever *finds by itself* that links of its own cannot be right (`outlived`) makes all of them anew: nobody said so.
"""
# pyright: reportUnknownMemberType=false

from collections import OrderedDict

import structlog

from appliance.plane.sockets import CALM_S, SocketWatch, address_of
from appliance.plane.wire import Wire

log = structlog.get_logger(__name__)

WITNESS_S = 60.0
"""Within so long a second session must have met a wrong door, for links that are not known to be the ones."""
WITNESSES = 2
_MOST_KNOWN = 64
_AFTER_ANSWER_S = 0.05
"""Before links are broken, for answers that are on their way over them."""


class Mixups:
    """Decides when links are made anew. Pure; times are seconds of one monotonic clock."""

    def __init__(self) -> None:
        self._seen: OrderedDict[str, float] = OrderedDict()
        """Session of the other side -> when it last met a wrong door here, with something between."""
        self._broken: OrderedDict[str, float] = OrderedDict()
        """Session at the other end of a link -> when that was made anew; "" for all links."""

    def direct(self, other: str, now: float) -> bool:
        """Whether the link with a session is to be made anew, that answered a question of ours as not its own."""
        return self._calm(other, now)

    def relayed(self, other: str, now: float) -> bool:
        """Whether all links are, after a wrong door between this session and another that it has no link with."""
        if not other:
            return False  # nobody's word
        self._seen[other] = now
        self._seen.move_to_end(other)
        while len(self._seen) > _MOST_KNOWN or now - next(iter(self._seen.values())) > WITNESS_S:
            self._seen.popitem(last=False)
        if len(self._seen) < WITNESSES or not self._calm("", now):
            return False
        self._seen.clear()
        return True

    def renewed(self, now: float) -> None:
        """All links are made anew, for another reason."""
        self._broken[""] = now
        self._seen.clear()

    def _calm(self, link: str, now: float) -> bool:
        if now < self._broken.get(link, -CALM_S) + CALM_S:
            return False
        self._broken[link] = now
        self._broken.move_to_end(link)
        while len(self._broken) > _MOST_KNOWN:
            self._broken.popitem(last=False)
        return True


class Doors:
    """Makes the links of one session anew when `Mixups` says so; called on the event loop's thread."""

    def __init__(self, wire: Wire, sockets: SocketWatch) -> None:
        self._wire = wire
        self._sockets = sockets
        self._mixups = Mixups()

    def was_wrong(self, asker: str) -> None:
        """A question came here that was meant for another key; `asker`: the session that it says it is of."""
        if not self._links(asker) and self._mixups.relayed(asker, self._wire.loop.time()):
            self._soon("")

    def met_wrong(self, replier: str) -> None:
        """A question of ours was answered by a session, which says it was meant for another key."""
        if self._links(replier):
            if self._mixups.direct(replier, self._wire.loop.time()):
                self._soon(replier)
        elif self._mixups.relayed(replier, self._wire.loop.time()):
            self._soon("")

    def renew(self, why: str) -> None:
        """Make all links anew; `why` is for the log."""
        self._mixups.renewed(self._wire.loop.time())
        self._break("", why)

    def _links(self, other: str) -> list[tuple[str, str]]:
        """Ends of the links with a session, or of all for the empty name."""
        if self._wire.closed:
            return []
        found = self._wire.raw.info.links()
        return [(each.src, each.dst) for each in found if not other or str(each.zid) == other]

    def _soon(self, other: str) -> None:
        self._wire.loop.call_later(_AFTER_ANSWER_S, self._break, other, "questions arrived at wrong doors")

    def _break(self, other: str, why: str) -> None:
        ends = [(address_of(one), address_of(another)) for one, another in self._links(other)]
        broken = self._sockets.shut({(one, another) for one, another in ends if one and another})
        if broken:
            log.warning("links are made anew", why=why, links=broken, other=other or "all")
