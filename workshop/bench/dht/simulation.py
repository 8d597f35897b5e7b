"""Counting what the ring does at sizes that no machine here can run: hops, keys moved, failures, bytes.

Every figure comes from the plane's own pure code (`plane.overlay`), seeded; a lookup counts as failed when it ends
without an owner or at another than the first survivor from the position on. Counts do not depend on the machine.
"""

import math
import os
import random
import statistics
from bisect import bisect_right
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from multiprocessing import get_context
from typing import Any, NamedTuple

from appliance.plane.keys import Keys
from appliance.plane.overlay import Lookup, View, successor_count
from appliance.plane.ring import Ring, position
from workshop.bench.dht import chord
from workshop.bench.dht.fleet import FRAMING, Fleet
from workshop.simulators.overlay import Stretch, moves

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
    told: dict[str, Any] = {"seed": seed, "lookups": lookups, **found}
    if "hops" in parts:
        told["hops_published"] = chord.HOPS_SOURCE
    if "failures" in parts:
        told["failures_published"] = {
            "source": chord.FAILURES_SOURCE,
            "theorem": chord.FAILURES_THEOREM,
            **{f"{share:.0%}": {"failed_percent": chord.failed_percent(share)} for share in _SHARES},
        }
    return told


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
        "chord": round(chord.mean_hops(size), 2),
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
    token = FRAMING + len(Keys("fleet").alive(names_of(1)[0]))
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
