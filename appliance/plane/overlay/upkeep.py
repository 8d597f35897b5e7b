"""Keeping a bounded view in step with the ring: joining, meeting neighbours, mending after failures, gossip.

A round is one errand: meet a member (swap neighbours and a few others, and see that it is there) or look up a
finger's position. Neighbours matter most, so every other round goes to them; fingers are looked up in turn, and the
rest met in turn, whoever was not heard of for longest first. When a round finds something changed the next comes
sooner, when not, later: at rest a gateway sends a few bytes a second, and under churn as much as it takes (`Pace`).
Pure: rounds come from `due`, what came of them goes back in, and time is passed in.
"""

import random
from collections.abc import Iterable

from msgspec import Struct

from appliance.plane.overlay.view import Around, View

_OTHERS = 4
"""Members named beside the neighbours whenever two meet: half of them the newest heard of, so that joins spread."""
_GONE_S = 120.0
"""How long hearsay does not bring back a member that was found gone; it can itself, at once."""
_LOST_S = 600.0
"""How long a member that was found gone is tried again now and then: what was cut off may be linked again, and two
parts of a ring that forgot each other would stay two rings."""
_LOST_TURN = 16
"""Every so many rounds."""
_MOST_GONE = 1024
_MOST_FIRST = 32
_TRUST_S = 5.0
"""How long a member that was heard from is not suspected."""
_PATIENCE = 3
"""Questions in a row that a member whose token is seen may leave without an answer before it counts as gone."""
_BREATH = 4.0
"""The next round comes no sooner than after so many times what the last one took: where all are slow because there is
more to do than they can, they do less."""


class MeetAsk(Struct, frozen=True, omit_defaults=True):
    """`ring_meet`: here am I; who is around you?"""

    asker: str
    all: bool = False
    """A joiner's: everybody you know."""


class LeaveAsk(Struct, frozen=True):
    """`ring_leave`: I go, and `around` me are these."""

    leaver: str
    around: Around


class Pace(Struct, frozen=True, kw_only=True):
    """How often a round comes, seconds."""

    least_s: float = 0.2
    most_s: float = 10.0
    faster: float = 0.6
    """Factor after a round that found a member gone, or a neighbour unknown."""
    slower: float = 1.06
    """Factor after one that did not: while members come and go about one round in ten finds something."""


class Meet(Struct, frozen=True):
    """A round: meet this member."""

    member: str


class Seek(Struct, frozen=True):
    """A round: look up whose this position is, for a finger."""

    target: int


class Upkeep:
    """The upkeep of one gateway's view."""

    def __init__(self, view: View, *, rng: random.Random, now: float, pace: Pace | None = None) -> None:
        self.view = view
        self._rng = rng
        self._pace = pace or Pace()
        self.interval_s = self._pace.least_s
        self.next_at = now + rng.uniform(0, self.interval_s)
        self._seen: dict[str, float] = dict.fromkeys(view.names, now)
        self._gone: dict[str, float] = {}
        self._late: dict[str, int] = {}
        """Member -> questions in a row that it has not answered in time."""
        self._newest: list[str] = []
        self._turn = 0
        self._finger = view.origin % view.bound
        """Number of the finger looked up last; not all members begin with the same one."""
        self._first: list[str] = []
        """To be met before all others, the last first: a joiner's neighbours; members that their neighbour left out, or
        that show no token."""

    def settle(self, now: float) -> None:
        """Begin as if nothing had changed for long: rounds spread over the longest interval."""
        self.interval_s = self._pace.most_s
        self.next_at = now + self._rng.uniform(0, self.interval_s)

    def joined(self, successor: str, told: Around, now: float) -> None:
        """The member at whose stretch this one joins has told everybody it knows; its neighbours are met first."""
        self.met(successor, told, now)
        view = self.view
        near = [*view.after()[: view.before_count], *reversed(view.before()[-view.before_count :])]
        self._first = [name for name in dict.fromkeys(reversed(near)) if name != successor]
        self.interval_s = self._pace.least_s
        self.next_at = now

    # --- rounds -----------------------------------------------------------------------------------------------

    def due(self, now: float) -> Meet | Seek | None:
        """The next round; None when there is nobody to meet."""
        view = self.view
        while self._first:
            name = self._first.pop()
            if name in view:
                self.next_at = now + self._pace.least_s
                return Meet(name)
        self.next_at = now + self.interval_s * self._rng.uniform(0.75, 1.25)
        self._turn += 1
        lost = self._lost(now) if self._turn % _LOST_TURN == 0 or not len(view) else ""
        if lost:
            return Meet(lost)
        if not len(view):
            return None
        after, before = view.after(), view.before()
        # Too short a list of neighbours: whoever is last in it knows those beyond.
        if self._turn % 4 == 1:
            short = not view.whole and len(after) < view.after_count
            return Meet(after[-1] if short and after else view.names[0])
        if self._turn % 4 == 3:
            short = not view.whole and len(before) < view.before_count
            return Meet(before[0] if short and before else view.names[-1])
        targets = view.targets() if self._turn % 4 == 2 and not view.whole else []
        if targets:
            # One after the other: drawn by lot, one of twenty would wait for three times as many rounds, now and then.
            self._finger = (self._finger + 1) % len(targets)
            return Seek(targets[self._finger])
        return Meet(min(view.names, key=lambda name: self._seen.get(name, 0.0)))

    def met(self, member: str, told: Around, now: float) -> None:
        """The member met has answered."""
        self._seen[member] = now
        self._late.pop(member, None)
        self._gone.pop(member, None)
        # One that was heard from a moment ago is there, only its neighbour does not know it yet.
        suspects = [name for name in self.view.unlisted(member, told) if now - self._seen.get(name, 0.0) > _TRUST_S]
        self._first = [*suspects, *self._first][-_MOST_FIRST:]
        usable = self._usable(told, now)
        new = self.view.merge(member, usable)
        self.view.hear(usable.others)
        self._changed(self._news(new) or bool(suspects))

    def took(self, seconds: float, now: float) -> None:
        """So long a round has taken."""
        self.next_at = max(self.next_at, now + min(self._pace.most_s, seconds * _BREATH))

    def late(self, member: str, now: float, *, in_round: bool = True) -> None:
        """A member has not answered in time, in a round or a lookup; that it is gone its token would tell."""
        count = self._late.get(member, 0) + 1
        if count >= _PATIENCE or member not in self.view:
            self.unreachable(member, now, in_round=in_round)
            return
        self._late[member] = count
        # Not the one to be met next again.
        self._seen[member] = now

    def doubt(self, member: str, now: float) -> None:
        """A member that was heard of shows no token: it is met next, since it may be gone."""
        if member in self.view and member not in self._first:
            self._first = [*self._first, member][-_MOST_FIRST:]
            self.next_at = min(self.next_at, now + self._pace.least_s)

    def unreachable(self, member: str, now: float, *, in_round: bool = True) -> None:
        """A member is not there: found so in a round, by a lookup, or told by whoever watches for it."""
        known = self.view.lose(member)
        self._seen.pop(member, None)
        self._late.pop(member, None)
        if len(self._gone) >= _MOST_GONE:
            del self._gone[next(iter(self._gone))]
        self._gone.setdefault(member, now)
        if in_round:
            self._changed(known)

    def found(self, names: Iterable[str], now: float) -> None:
        """A lookup of a finger's position has ended with these members, or others were heard of."""
        self.view.hear(self._fresh(names, now))
        self.view.trim(self._rng)
        self._changed(False)

    # --- being met --------------------------------------------------------------------------------------------

    def asked(self, ask: MeetAsk, now: float) -> Around:
        """Answer a member that meets this one; it is heard of by that."""
        answer = self.view.around(self._others(ask))
        self._seen[ask.asker] = now
        self._gone.pop(ask.asker, None)
        if self._news(self.view.hear((ask.asker,))):
            self._changed(True)
            self.next_at = min(self.next_at, now + self.interval_s)
        return answer

    def left(self, ask: LeaveAsk, now: float) -> None:
        """A member says that it goes, and who its neighbours are."""
        self.view.merge(ask.leaver, self._usable(ask.around, now))
        self.unreachable(ask.leaver, now, in_round=False)
        self.view.trim(self._rng)

    def leaving(self) -> tuple[LeaveAsk, tuple[str, ...]]:
        """What to say on leaving, and to whom: those whose neighbour this gateway is."""
        view = self.view
        return LeaveAsk(view.me, view.around()), (*view.before()[-view.replicas :], *view.after()[: view.replicas])

    # --- within -----------------------------------------------------------------------------------------------

    def _others(self, ask: MeetAsk) -> tuple[str, ...]:
        names = self.view.names
        if ask.all:
            return tuple(name for name in names if name != ask.asker)
        newest = [name for name in self._newest if name in self.view][: _OTHERS // 2]
        drawn = self._rng.sample(names, min(len(names), _OTHERS - len(newest)))
        return tuple(name for name in dict.fromkeys((*newest, *drawn)) if name != ask.asker)

    def _lost(self, now: float) -> str:
        """A member found gone that may be back; empty: none."""
        self._gone = {name: at for name, at in self._gone.items() if now - at < _LOST_S}
        return self._rng.choice(list(self._gone)) if self._gone else ""

    def _usable(self, told: Around, now: float) -> Around:
        return Around(
            before=self._fresh(told.before, now),
            after=self._fresh(told.after, now),
            others=self._fresh(told.others, now),
            whole=told.whole,
        )

    def _fresh(self, names: Iterable[str], now: float) -> tuple[str, ...]:
        """Those not found gone a short while ago."""
        return tuple(name for name in names if now - self._gone.get(name, -_GONE_S) >= _GONE_S)

    def _news(self, new: list[str]) -> bool:
        """Trim the view, and return whether neighbours are among those heard of: those are told on."""
        view = self.view
        view.trim(self._rng)
        if len(self._seen) > 2 * view.bound:
            self._seen = {name: at for name, at in self._seen.items() if name in view}
            self._late = {name: count for name, count in self._late.items() if name in view}
        most = view.before_count
        near = set(view.names) if view.whole else {*view.after()[:most], *view.before()[-most:]}
        news = [name for name in new if name in near]
        self._newest = [*news[:_OTHERS], *self._newest][:_OTHERS]
        return bool(news)

    def _changed(self, changed: bool) -> None:
        pace = self._pace
        factor = pace.faster if changed else pace.slower
        self.interval_s = min(pace.most_s, max(pace.least_s, self.interval_s * factor))
