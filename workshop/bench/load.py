"""The load that is put on a fleet, and what is made of how it took it: pure, so that both can be tested.

Arrivals are an open loop: when a run is wanted is fixed beforehand, whatever became of those before it, and its
time counts from then. A closed loop, or counting from when the order was really sent, would leave out just the waits
that an overloaded system causes ("coordinated omission").
"""

import random
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, Literal

from msgspec import Struct

from workshop.bench.figures import finite, quantile, summary

Spread = Literal["even", "uneven"]

ZIPF = 1.5
"""Exponent of uneven arrivals, weight 1 / rank^1.5: of four gateways the first gets 60 % of the runs."""
MOST_UNSERVED = 0.01
"""Share of runs that may be refused, fail or be lost before the load counts as too much: p99 stays defined."""
SLOWEST = 12
"""Starts that are listed one by one, the slowest first: what the tail is made of."""
SATURATED = 0.9
"""A machine, or a daemon's one core, that is busy for more than this part of the time is full."""


class Arrival(Struct, frozen=True, kw_only=True):
    """A run that is wanted: when, in seconds from the beginning, and at which gateway."""

    at_s: float
    gateway: str


class Outcome(Struct, kw_only=True):
    """What became of a run. Times are milliseconds from its intended arrival, `inf` for what never came."""

    sent_ms: float = 0.0
    """How late the order left: what the sender itself could not keep up with."""
    started_ms: float = float("inf")
    ended_ms: float = float("inf")
    within_ms: float = float("inf")
    """What the gateway where it ran took of that, from its order to the handler's first line; the rest is the way there
    and back, and for a run elsewhere what the asked gateway took to find that."""
    asked: str = ""
    """Where it was ordered."""
    gateway: str = ""
    """Where it ran."""
    phase: str = ""
    problem: str = ""
    """Why it did not work: an error code, or `lost` when nothing more was heard; empty when it did."""


class Sampled(Struct, frozen=True, kw_only=True):
    """What the machine was seen doing meanwhile."""

    cpu: float = 0.0
    """Busy part of all cores, 0 to 1."""
    daemons: dict[str, float] = {}
    """Cores used by each process of the fleet, by `sender` (this benchmark) and by `others` (containers, Podman)."""
    queue: dict[str, int] = {}
    """The most runs seen waiting for a container, by gateway."""
    containers: dict[str, int] = {}
    """Containers held at the end, by gateway."""
    refused: dict[str, int] = {}
    """What gateways have counted as refused meanwhile, by kind: full queues, offers that had gone, ..."""


def arrivals(rate: float, seconds: float, gateways: Sequence[str], *, spread: Spread, seed: int) -> tuple[Arrival, ...]:
    """Return Poisson arrivals, the same for the same seed: exponential gaps of mean 1 / rate.

    Args:
        rate: runs a second over all gateways.
        seconds: for how long.
        gateways: the first of them is the hot one when the spread is uneven.
        spread: `even`, or `uneven` by Zipf's law.
        seed: of the generator; times and places.
    """
    generator = random.Random(seed)  # noqa: S311 - load, not secrets
    weights = [1.0 if spread == "even" else rank**-ZIPF for rank in range(1, len(gateways) + 1)]
    found: list[Arrival] = []
    at_s = generator.expovariate(rate)
    while at_s < seconds:
        found.append(Arrival(at_s=at_s, gateway=generator.choices(gateways, weights)[0]))
        at_s += generator.expovariate(rate)
    return tuple(found)


def window_s(rate: float, *, seconds: float, least: int, most_s: float) -> float:
    """Return how long a rate is offered: `seconds`, longer for slow ones until `least` runs, at most `most_s`."""
    return min(max(seconds, least / rate), max(seconds, most_s))


def account(outcomes: Sequence[Outcome], seen: Sampled) -> dict[str, Any]:
    """Return the figures of one rate: start and end (ms), unserved, phases, the sender's lag, the machine."""
    sent = sorted(each.sent_ms for each in outcomes)
    return {
        "start": summary([each.started_ms for each in outcomes]),
        "end": summary([each.ended_ms for each in outcomes]),
        "unserved": dict(Counter(each.problem for each in outcomes if each.problem)),
        "phases": dict(Counter(each.phase for each in outcomes if each.phase)),
        "ways": {phase: _way([each for each in outcomes if each.phase == phase]) for phase in _phases(outcomes)},
        "slowest": [_slow(each) for each in sorted(outcomes, key=lambda each: -each.started_ms)[:SLOWEST]],
        "ran_on": dict(sorted(Counter(each.gateway for each in outcomes if each.gateway).items())),
        "sender_late_p99": finite(quantile(sent, 0.99)) if sent else None,
        "cpu": round(seen.cpu, 3),
        "cores_by_process": {name: round(cores, 2) for name, cores in seen.daemons.items()},
        "queue": {name: length for name, length in seen.queue.items() if length},
        "containers": seen.containers,
        "counted": seen.refused,
    }


def _phases(outcomes: Sequence[Outcome]) -> list[str]:
    return sorted({each.phase for each in outcomes if each.phase})


def _way(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Return how long the starts of one phase took, and the gateways where they ran of that."""
    return {
        "start": summary([each.started_ms for each in outcomes]),
        "within": summary([each.within_ms for each in outcomes]),
    }


def _slow(outcome: Outcome) -> dict[str, Any]:
    return {
        "start": finite(outcome.started_ms),
        "within": finite(outcome.within_ms),
        "sent": finite(outcome.sent_ms),
        "phase": outcome.phase,
        "asked": outcome.asked,
        "ran_on": outcome.gateway,
    }


def verdict(outcomes: Sequence[Outcome], seen: Sampled, *, limit_ms: float) -> list[str]:
    """Return why a load is too much, in words, symptom first, then the causes seen; empty when it is carried.

    It is too much when more than 1 % of the runs are not served, or when p99 of the start exceeds `limit_ms`.
    """
    if not outcomes:
        return []
    found: list[str] = []
    unserved = Counter(each.problem for each in outcomes if each.problem)
    if sum(unserved.values()) > MOST_UNSERVED * len(outcomes):
        kinds = ", ".join(f"{count} {problem}" for problem, count in unserved.most_common())
        found.append(f"not served: {kinds} of {len(outcomes)}")
    served = sorted(each.started_ms for each in outcomes if not each.problem)
    if served and (p99 := quantile(served, 0.99)) > limit_ms:
        found.append(f"p99 of the start is {p99:.0f} ms, beyond {limit_ms:.0f} ms")
    return found + _causes(outcomes, seen) if found else []


def _causes(outcomes: Sequence[Outcome], seen: Sampled) -> list[str]:
    found: list[str] = []
    if seen.cpu >= SATURATED:
        first = sorted(seen.daemons.items(), key=lambda each: -each[1])[:3]
        most = ", ".join(f"{name} {cores:.2f} cores" for name, cores in first)
        found.append(f"CPU: all cores {seen.cpu:.0%} busy ({most})")
    else:
        full = [name for name, cores in seen.daemons.items() if cores >= SATURATED and name != "others"]
        found += [f"CPU: {name} fills its one core" for name in full]
    if waiting := sorted(((length, name) for name, length in seen.queue.items() if length), reverse=True):
        lengths = ", ".join(f"{length} at {name}" for length, name in waiting)
        found.append(f"queue: up to {lengths} waited for a container")
    if gone := seen.refused.get("stale offer", 0):
        found.append(f"offers: {gone} containers of other gateways were gone when asked for")
    cold = sum(each.phase == "cold" for each in outcomes)
    if cold:
        found.append(f"cold starts: {cold} of {len(outcomes)}")
    late = quantile(sorted(each.sent_ms for each in outcomes), 0.99)
    if late > 20:
        found.append(f"the sender itself was {late:.0f} ms late at p99")
    return found or ["no cause was seen: neither CPU, nor queue, nor cold starts"]


def breaking(cells: Mapping[float, Sequence[str]]) -> dict[str, Any]:
    """Return where a ladder of rates broke: the highest rate carried below, the first one not, and why."""
    held: float | None = None
    for rate in sorted(cells):
        if cells[rate]:
            return {"holds": held, "breaks": rate, "why": list(cells[rate])}
        held = rate
    return {"holds": held, "breaks": None, "why": []}
