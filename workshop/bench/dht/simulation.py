"""Counting what the ring does at sizes that no machine here can run: hops, keys moved, failures, bytes.

Every figure comes from the plane's own pure code (`plane.overlay`), seeded; a lookup counts as failed when it ends
without an owner or at another than the first survivor from the position on. Counts do not depend on the machine.
"""

import heapq
import math
import os
import random
import statistics
from bisect import bisect_left, bisect_right, insort
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from itertools import chain
from multiprocessing import get_context
from typing import Any, NamedTuple

from msgspec import Struct

from appliance.model import encode, keyspace
from appliance.model.keys import Keys
from appliance.plane.overlay import Lookup, Meet, MeetAsk, NextAsk, Seek, Upkeep, View, successor_count
from appliance.plane.ring import RING_SIZE, Ring, position
from workshop.simulators.overlay import Stretch, moves

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
        self.bytes[what] += FRAMING + len(self._keys(keyspace.RPC, to, verb)) + len(encode(ask))
        self.messages[what] += 1
        if answer is not None:
            self.bytes[what] += FRAMING + len(self._keys(keyspace.RPC, to, verb)) + len(encode(answer))
            self.messages[what] += 1


REPLICAS = 3
PARTS = ("hops", "join", "failures", "traffic")
_KEYS = 100_000
_MANY = 1000
_FAILING = 1000
"""Besides the largest ring the one that failures are counted for by all lengths of the successor list."""
_SHARES = (0.1, 0.2, 0.3, 0.4, 0.5)

Progress = Callable[[str], None]


def view_bound(members: int) -> int:
    """The bound under test: 4·log2 N."""
    return int(4 * math.log2(members))


def run(
    sizes: Sequence[int], *, lookups: int, seconds: float, seed: int, progress: Progress,
    parts: Collection[str] = PARTS,
) -> dict[str, Any]:  # fmt: skip
    """Run these parts for these ring sizes.

    Args:
        sizes: Members of the rings; failures are counted for all with the list of successors that grows with the ring,
            for those of 1,000 and for the largest with others too.
        lookups: Lookups behind each figure.
        seconds: Simulated time of each figure of traffic, after as long to settle; half of it beyond 1,000 members.
        seed: Of everything drawn.
        progress: Told what is being done.
        parts: Any of `PARTS`.
    """
    jobs = [job for size in sizes for job in _jobs(size, max(sizes), lookups, seconds, seed) if job.part in parts]
    found: dict[str, dict[str, Any]] = {part: {} for part in PARTS if part in parts}
    for job, result in zip(jobs, _all(jobs, progress), strict=True):
        found[job.part].setdefault(str(job.size), {}).update(result)
    return {"seed": seed, "lookups": lookups, **found}


def _jobs(size: int, largest: int, lookups: int, seconds: float, seed: int) -> list["_Job"]:
    """All that is counted of a ring."""
    # A mean over so many members needs less time to be as exact, but not less to settle.
    for_s = seconds if size <= _MANY else seconds / 2
    jobs = [
        _Job("hops", size, partial(hops, size, lookups=lookups, seed=seed)),
        _Job("join", size, partial(joins, size, seed=seed)),
        _Job(
            "traffic", size, partial(bytes_sent, size, seconds=for_s, settle_s=seconds, lookups=lookups // 4, seed=seed)
        ),
    ]
    grown = successor_count(size, view_bound(size))
    jobs += [
        _Job("failures", size, partial(failures, size, lookups=lookups, seed=seed, lengths=(length,)))
        for length in (successor_lengths(size) if size in (_FAILING, largest) else (grown,))
    ]
    return jobs


class _Job(NamedTuple):
    """One figure of one ring; each has its own seeded numbers, so that the order does not matter."""

    part: str
    size: int
    work: Callable[[], dict[str, Any]]

    def weight(self) -> float:
        """About how long it takes beside others."""
        return self.size * {"traffic": 5.0, "hops": 1.5, "failures": 1.0, "join": 0.3}[self.part]


def _all(jobs: Sequence[_Job], progress: Progress) -> list[dict[str, Any]]:
    """Do all jobs, those that take longest first, on as many processes as there are processors."""
    pool = ProcessPoolExecutor(max_workers=min(len(jobs), os.cpu_count() or 1), mp_context=get_context("spawn"))
    try:
        running = {pool.submit(job.work): job for job in sorted(jobs, key=_Job.weight, reverse=True)}
        for number, done in enumerate(as_completed(running)):
            job = running[done]
            progress(f"{number + 1} of {len(jobs)}: ring of {job.size:,}, {job.part}")
        results = {id(job): done.result() for done, job in running.items()}
    finally:
        pool.shutdown(cancel_futures=True)
    return [results[id(job)] for job in jobs]


def names_of(size: int) -> list[str]:
    """Names as long as real ones are."""
    return [f"gw-{number:05d}" for number in range(size)]


def hops(size: int, *, lookups: int, seed: int) -> dict[str, Any]:
    """Members that answer in a lookup, the owner among them: with the ring known whole, and with a bounded view."""
    bound = view_bound(size)
    fleet = Fleet(bound=bound, seed=seed, replicas=REPLICAS).settled(names_of(size))
    ring = fleet.ring
    asker = ring.names[0]
    whole = View.settled(asker, ring, bound=size, replicas=REPLICAS, rng=fleet.rng)
    bounded: list[int] = []
    full: list[int] = []
    wrong = 0
    for _ in range(lookups):
        target = fleet.rng.getrandbits(160)
        owner = ring.holders(target, 1)[0]
        for view, counts in ((fleet.members[fleet.rng.choice(ring.names)].view, bounded), (whole, full)):
            lookup = fleet.lookup(target, view)
            wrong += lookup.result is None or lookup.result.owner != owner
            counts.append(lookup.hops)
    return {
        "full_view": {"mean": _mean(full), "p99": _p99(full), "max": max(full)},
        "bounded_view": {
            "members": bound,
            "successors": successor_count(size, bound) if size - 1 > bound else size - 1,
            "mean": _mean(bounded),
            "p99": _p99(bounded),
            "max": max(bounded),
        },
        "half_log2": round(0.5 * math.log2(size), 2),
        "wrong": wrong,
    }


def joins(size: int, *, seed: int, count: int = 20, keys: int = _KEYS) -> dict[str, Any]:
    """Keys that a join moves, of `keys` spread over the ring: mean and most over `count` joins, and r·K/N beside."""
    rng = random.Random(seed)  # noqa: S311 - a simulation
    placed = sorted(position(f"task/{rng.getrandbits(64):x}") for _ in range(keys))
    found: dict[str, Any] = {"keys": keys, "share": round(keys / (size + 1), 1)}
    for points in (1, 32):
        if size * points > 40_000:
            continue
        ring = Ring(names_of(size), virtual_nodes=points)
        owned: list[int] = []
        copied: list[int] = []
        elsewhere = 0
        for number in range(count if points == 1 else 3):
            joiner = f"joiner-{number}"
            copies, _ = moves(ring, ring.with_member(joiner), replicas=REPLICAS)
            elsewhere += sum(move.to != joiner for move in copies)
            owned.append(sum(_within(placed, move.stretch) for move in copies if move.owner))
            copied.append(sum(_within(placed, move.stretch) for move in copies))
        found[f"virtual_nodes_{points}"] = {
            "owned_mean": round(statistics.mean(owned), 1),
            "owned_max": max(owned),
            "copied_mean": round(statistics.mean(copied), 1),
            "to_others": elsewhere,
        }
    return found


def successor_lengths(size: int) -> tuple[int, ...]:
    """Lengths of the successor list that failures are counted for; the largest is the one that grows with the ring."""
    return tuple(sorted({3, 5, 10, math.ceil(math.log2(size)), successor_count(size, view_bound(size))}))


def failures(size: int, *, lookups: int, seed: int, lengths: Sequence[int] = ()) -> dict[str, Any]:
    """Lookups after a share of all members died at once and nothing was mended, by length of the successor list."""
    bound = view_bound(size)
    found: dict[str, Any] = {"grown_successors": successor_count(size, bound)}
    for length in lengths or successor_lengths(size):
        rows: dict[str, Any] = {}
        fleet = Fleet(bound=bound, seed=seed, replicas=REPLICAS).settled(names_of(size), successors=length)
        everybody, ring = dict(fleet.members), fleet.ring
        for share in _SHARES:
            fleet.members = dict(everybody)
            for name in fleet.rng.sample(ring.names, int(share * size)):
                del fleet.members[name]
            rows[f"{share:.0%}"] = _after(fleet, ring, lookups)
        found[f"successors_{length}"] = rows
    return found


def _after(fleet: Fleet, before: Ring, lookups: int) -> dict[str, Any]:
    ring, alive = fleet.ring, list(fleet.members)
    failed = unreplicated = unowned = 0
    done: list[Lookup] = []
    for _ in range(lookups):
        target = fleet.rng.getrandbits(160)
        lookup = fleet.lookup(target, fleet.members[fleet.rng.choice(alive)].view)
        failed += lookup.result is None or lookup.result.owner != ring.holders(target, 1)[0]
        holders = before.holders(target, REPLICAS)
        unowned += holders[0] not in fleet.members
        unreplicated += not any(name in fleet.members for name in holders)
        done.append(lookup)
    return {
        "failed_percent": round(100 * failed / lookups, 3),
        "hops": _mean([each.hops for each in done]),
        "timeouts": _mean([len(each.gone) for each in done]),
        "owner_dead_percent": round(100 * unowned / lookups, 3),
        "all_replicas_dead_percent": round(100 * unreplicated / lookups, 3),
    }


def bytes_sent(
    size: int, *, seconds: float, lookups: int, seed: int, settle_s: float = 0.0, churn: float = 0.01
) -> dict[str, Any]:
    """Bytes a member sends each second: at rest, and while `churn` of all members die, and as many join, each second.

    Counted over so many seconds each time, after `settle_s` or, where that is 0, as long: intervals adapt slowly.

    Who dies says nothing: others notice when they ask. With the full view, every change reaches every member as a
    liveliness token (given beside it; it keeps nothing up at rest, since Zenoh watches the links).
    """
    fleet = Fleet(bound=view_bound(size), seed=seed, replicas=REPLICAS).settled(names_of(size))
    for upkeep in fleet.members.values():
        upkeep.settle(fleet.now)
    settle_s = settle_s or seconds
    fleet.run(fleet.now + settle_s)
    fleet.bytes.clear()
    fleet.messages.clear()
    fleet.run(fleet.now + seconds)
    rest = sum(fleet.bytes.values()) / seconds / size
    state = _Churn(fleet, churn * size, seed)
    state.run(settle_s)
    fleet.bytes.clear()
    fleet.messages.clear()
    state.failed = 0
    state.lookups.clear()
    state.joins = 0
    state.run(seconds, lookups=lookups)
    kinds = {what: round(count / seconds / size, 1) for what, count in sorted(fleet.bytes.items()) if what != "lookup"}
    token = FRAMING + len(Keys("fleet")(keyspace.GATEWAY_ALIVE, names_of(1)[0]))
    return {
        "rest": round(rest, 1),
        "churn": round(sum(kinds.values()), 1),
        "churn_by_kind": kinds,
        "churn_messages": round(
            sum(count for what, count in fleet.messages.items() if what != "lookup") / seconds / size, 2
        ),
        "full_view_tokens_churn": round(2 * churn * size * token, 1),
        "lookups_failed_percent": round(100 * state.failed / max(1, len(state.lookups)), 3),
        "lookup_hops": _mean([each.hops for each in state.lookups]),
        "lookup_timeouts": _mean([len(each.gone) for each in state.lookups]),
    }


class _Churn:
    """Members that die and join at random moments, a Poisson process each."""

    def __init__(self, fleet: Fleet, rate: float, seed: int) -> None:
        self.fleet = fleet
        self.rate = rate
        self.failed = 0
        self.joins = 0
        self.lookups: list[Lookup] = []
        self._rng = random.Random(seed + 1)  # noqa: S311 - a simulation
        self._number = 0

    def run(self, seconds: float, *, lookups: int = 0) -> None:
        """Let so much time pass, with lookups spread over it."""
        fleet, rng = self.fleet, self._rng
        start = fleet.now
        events = [(start + seconds * rng.random(), "lookup") for _ in range(lookups)]
        for what in ("die", "join"):
            at = start + rng.expovariate(self.rate)
            while at < start + seconds:
                events.append((at, what))
                at += rng.expovariate(self.rate)
        for at, what in sorted(events):
            fleet.run(at)
            if what == "die" and len(fleet.members) > 2:
                del fleet.members[fleet.any()]
            elif what == "join":
                self._number += 1
                self.joins += fleet.join(f"jn-{self._number:05d}")
            elif what == "lookup":
                self._look_up()
        fleet.run(start + seconds)

    def _look_up(self) -> None:
        fleet, target = self.fleet, self._rng.getrandbits(160)
        lookup = fleet.lookup(target, fleet.members[fleet.any()].view)
        self.failed += lookup.result is None or lookup.result.owner != fleet.owner(target)
        self.lookups.append(lookup)


def _within(placed: Sequence[int], stretch: Stretch) -> int:
    """How many of these positions, ascending, lie in a stretch."""
    count = bisect_right(placed, stretch.upto) - bisect_right(placed, stretch.after)
    return count if stretch.after < stretch.upto else count + len(placed)


def _mean(values: Sequence[float]) -> float:
    return round(statistics.mean(values), 3) if values else 0.0


def _p99(values: Sequence[float]) -> float:
    return sorted(values)[int(0.99 * (len(values) - 1))]
