"""Gateways that exist only as the pure part of their plane: questions are calls, time is a number, bytes are counted.

Everything that would be sent is encoded as the plane encodes it, so that the bytes are those of the wire but for
Zenoh's keep-alives, which go over each link whatever the ring does.
"""

import heapq
import random
from bisect import bisect_left, insort
from collections import Counter
from collections.abc import Iterable
from itertools import chain

from msgspec import Struct

from appliance.model import encode
from appliance.plane.keys import Keys
from appliance.plane.overlay import Lookup, Meet, MeetAsk, NextAsk, Seek, Upkeep, View
from appliance.plane.ring import RING_SIZE, Ring

FRAMING = 64
"""Bytes of a message beside key and payload: TCP/IP headers 40, Zenoh's own about 24."""


class Fleet:
    """Gateways by name; those that died are simply not in it any more."""

    def __init__(self, *, bound: int, seed: int = 1, replicas: int = 3) -> None:
        self.bound = bound
        self.replicas = replicas
        self.rng = random.Random(seed)  # noqa: S311 - a simulation
        self.now = 0.0
        self.members: dict[str, Upkeep] = {}
        self.bytes: Counter[str] = Counter()
        """Sent so far, by what for: `join`, `leave`, `meet`, `seek` (fingers), `lookup`."""
        self.messages: Counter[str] = Counter()
        self._keys = Keys("fleet")
        self._rounds: list[tuple[float, str]] | None = None
        """When whose next round is, once time passes by `run`."""

        self._placed: list[tuple[int, str]] = []
        """Where every gateway stands that ever was in it, in order."""

    @property
    def ring(self) -> Ring:
        """The true ring, which nobody in it need know."""
        return Ring(self.members, virtual_nodes=1)

    def settled(self, names: Iterable[str], *, successors: int = 0) -> "Fleet":
        """Place gateways with the views that upkeep arrives at while nothing changes."""
        ring = Ring(names, virtual_nodes=1)
        for name in ring.names:
            view = View.settled(
                name, ring, bound=self.bound, replicas=self.replicas, rng=self.rng, successors=successors
            )
            self.members[name] = Upkeep(view, rng=self.rng, now=self.now)
            self._placed.append((view.origin, name))
        self._placed.sort()
        return self

    def any(self) -> str:
        """A gateway at random; takes time when there are many."""
        return self.rng.choice(list(self.members))

    def owner(self, target: int) -> str:
        """Whose a position is in truth."""
        at = bisect_left(self._placed, (target, ""))
        order = chain(range(at, len(self._placed)), range(at))
        return next(name for each in order if (name := self._placed[each][1]) in self.members)

    # --- what gateways do -------------------------------------------------------------------------------------

    def join(self, name: str) -> bool:
        """Let a gateway join through one at random; False when its lookup failed."""
        if not self.members:
            view = View.alone(name, bound=self.bound, replicas=self.replicas)
            insort(self._placed, (view.origin, name))
            self.members[name] = Upkeep(view, rng=self.rng, now=self.now)
            return True
        view = View(name, bound=self.bound, replicas=self.replicas)
        insort(self._placed, (view.origin, name))
        joiner = Upkeep(view, rng=self.rng, now=self.now)
        view.hear([self.any()])
        lookup = self.lookup((view.origin + 1) % RING_SIZE, view, what="join")
        if lookup.result is None:
            return False
        successor = lookup.result.owner
        ask = MeetAsk(name, all=True)
        told = self.members[successor].asked(ask, self.now)
        self._count("join", successor, "ring_meet", ask, told)
        self.members[name] = joiner
        joiner.joined(successor, told, self.now)
        self._plan(name)
        return True

    def leave(self, name: str) -> None:
        """Let a gateway say that it goes."""
        ask, near = self.members.pop(name).leaving()
        for each in near:
            self._count("leave", each, "ring_leave", ask, None)
            if each in self.members:
                self.members[each].left(ask, self.now)

    def lookup(self, target: int, view: View, *, what: str = "lookup") -> Lookup:
        """Look a position up from a view."""
        lookup = Lookup(target, view)
        while (name := lookup.next()) is not None:
            ask = NextAsk(f"{target:040x}", named=lookup.named(name))
            if name in self.members:
                step = self.members[name].view.step(target, named=ask.named)
                lookup.answered(name, step)
                self._count(what, name, "ring_next", ask, step)
            else:
                lookup.failed(name)
                self._count(what, name, "ring_next", ask, None)
        return lookup

    def round(self, name: str) -> None:
        """One round of a gateway's upkeep."""
        upkeep = self.members[name]
        match upkeep.due(self.now):
            case Meet(member):
                ask = MeetAsk(name)
                if member in self.members:
                    told = self.members[member].asked(ask, self.now)
                    upkeep.met(member, told, self.now)
                    self._count("meet", member, "ring_meet", ask, told)
                else:
                    upkeep.unreachable(member, self.now)
                    self._count("meet", member, "ring_meet", ask, None)
            case Seek(target):
                lookup = self.lookup(target, upkeep.view, what="seek")
                for gone in lookup.gone:
                    upkeep.unreachable(gone, self.now)
                if lookup.result is not None:
                    upkeep.found((lookup.result.owner, *lookup.result.replicas), self.now)
            case None:
                pass

    # --- time -------------------------------------------------------------------------------------------------

    def rounds(self, count: int) -> None:
        """Let every gateway do so many rounds, in random order, a second apart."""
        for _ in range(count):
            self.now += 1.0
            for name in self.rng.sample(sorted(self.members), len(self.members)):
                self.round(name)

    def run(self, until: float) -> None:
        """Let time pass: every gateway does its rounds when they are due."""
        if self._rounds is None:
            self._rounds = [(upkeep.next_at, name) for name, upkeep in self.members.items()]
            heapq.heapify(self._rounds)
        while self._rounds and self._rounds[0][0] <= until:
            at, name = heapq.heappop(self._rounds)
            if name not in self.members:
                continue
            self.now = max(self.now, at)
            if self.members[name].next_at <= at:
                self.round(name)
            self._plan(name)
        self.now = until

    def _plan(self, name: str) -> None:
        if self._rounds is not None:
            heapq.heappush(self._rounds, (self.members[name].next_at, name))

    def _count(self, what: str, to: str, verb: str, ask: Struct, answer: Struct | None) -> None:
        self.bytes[what] += FRAMING + len(self._keys.rpc(to, verb)) + len(encode(ask))
        self.messages[what] += 1
        if answer is not None:
            self.bytes[what] += FRAMING + len(self._keys.rpc(to, verb)) + len(encode(answer))
            self.messages[what] += 1
