"""Arrival traces, generated from a seed: which image is asked for when, where, and for how long.

`azure` has the shape, not the data, of the Azure Functions workload as Shahrad et al. describe it ("Serverless in the
Wild", USENIX ATC 2020, section 3): mean rates of functions spread evenly over eight orders of magnitude (figure 5),
29 % started by timers, so strictly periodic, the others Poisson or in bursts (figures 2 and 6: coefficients of
variation of 0, about 1, and far above), execution times log-normal with a mean of the logarithm of −0.38 and a
deviation of 2.36 (section 3.4, seconds), memory Burr-distributed (section 3.5; c = 11.652, k = 0.221, scale 107 MB:
half of them below 140 MB).
"""

import heapq
import math
import random
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta, Struct

from appliance.errors import ConfigError

MAX_LINES = 5_000_000
DAY_S = 86_400.0


class Arrival(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A run that wants a container."""

    at_s: Annotated[float, Meta(ge=0)]
    image: str
    service_s: Annotated[float, Meta(ge=0)]
    gateway: Annotated[int, Meta(ge=0, lt=10_000)] = 0


class Image(Struct, frozen=True, kw_only=True):
    """An image and what its containers cost."""

    name: str
    memory_mb: int = 256
    cold_ms: float = 500.0


class Trace(Struct, frozen=True, kw_only=True):
    """Arrivals in order of time."""

    name: str
    duration_s: float
    images: dict[str, Image]
    arrivals: tuple[Arrival, ...]
    gateways: int = 1


def poisson(rng: random.Random, rate: float, duration_s: float) -> Iterator[float]:
    """Yield times with independent exponential gaps, `rate` a second."""
    at = rng.expovariate(rate)
    while at < duration_s:
        yield at
        at += rng.expovariate(rate)


def on_off(rng: random.Random, rate: float, duration_s: float, *, on_s: float, off_s: float) -> Iterator[float]:
    """Yield times of bursts: exponential on and off phases; `rate` is the mean over both."""
    at = -rng.random() * (on_s + off_s)
    while at < duration_s:
        end = at + rng.expovariate(1 / on_s)
        within = rate * (on_s + off_s) / on_s
        at += rng.expovariate(within)
        while at < end:
            if 0 <= at < duration_s:
                yield at
            at += rng.expovariate(within)
        at = end + rng.expovariate(1 / off_s)


def diurnal(rng: random.Random, rate: float, duration_s: float) -> Iterator[float]:
    """Yield Poisson times whose rate goes up and down once in 24 h, from 0 to twice the mean (by thinning)."""
    for at in poisson(rng, 2 * rate, duration_s):
        if rng.random() < 0.5 - 0.5 * math.cos(2 * math.pi * at / DAY_S):
            yield at


def timer(rng: random.Random, rate: float, duration_s: float) -> Iterator[float]:
    """Yield strictly periodic times, but for a jitter of 1 % of the period."""
    period_s = 1 / rate
    at = rng.random() * period_s
    while at < duration_s:
        yield max(0.0, at + rng.gauss(0.0, 0.01 * period_s))
        at += period_s


def service(rng: random.Random, mean_s: float) -> float:
    """Return an execution time: exponential, at least 10 ms."""
    return max(0.01, rng.expovariate(1 / mean_s))


Times = Callable[[random.Random, float, float], Iterable[float]]


def _bursts(rng: random.Random, rate: float, duration_s: float) -> Iterator[float]:
    return on_off(rng, rate, duration_s, on_s=max(60.0, 5 / rate), off_s=max(540.0, 45 / rate))


KINDS: dict[str, Times] = {"poisson": poisson, "bursts": _bursts, "diurnal": diurnal, "timer": timer}


def plain(
    kind: str, *, seed: int = 1, images: int = 24, rate: float = 1.0, duration_s: float = 4 * 3600.0, gateways: int = 1
) -> Trace:
    """Return a trace of one kind whose images' rates follow Zipf's law (exponent 1).

    Args:
        kind: poisson, bursts, diurnal or timer.
        seed: of everything that is random.
        images: how many.
        rate: arrivals a second of all together.
        duration_s: of the trace.
        gateways: over which each image's arrivals are spread unevenly.
    """
    rng = random.Random(seed)  # noqa: S311 - a trace to repeat, not a secret
    norm = sum(1 / (rank + 1) for rank in range(images))
    made = [_image(rng, rank) for rank in range(images)]
    times = KINDS[kind]
    streams: list[Iterable[Arrival]] = []
    for rank, image in enumerate(made):
        mean_s = min(20.0, rng.lognormvariate(0.0, 1.0))
        streams.append(_stream(rng, image.name, times(rng, rate / (rank + 1) / norm, duration_s), mean_s, gateways))
    return _trace(kind, duration_s, made, streams, gateways)


def azure(
    *, seed: int = 1, images: int = 100, duration_s: float = 8 * 3600.0, gateways: int = 1, most_rate: float = 0.1
) -> Trace:
    """Return a trace of the shape of the Azure Functions workload (see the module).

    Args:
        seed: of everything that is random.
        images: how many functions.
        duration_s: of the trace.
        gateways: over which each image's arrivals are spread unevenly.
        most_rate: arrivals a second of the most popular image; the least popular has 10^-8 of it, so many never come.
    """
    rng = random.Random(seed)  # noqa: S311 - a trace to repeat, not a secret
    made = [_image(rng, rank) for rank in range(images)]
    streams: list[Iterable[Arrival]] = []
    for image in made:
        rate = most_rate * 10 ** -rng.uniform(0.0, 8.0)
        kind = rng.choices(("timer", "poisson", "bursts"), (0.29, 0.36, 0.35))[0]
        mean_s = min(60.0, rng.lognormvariate(-0.38, 2.36))
        mean_s = min(mean_s, 0.5 / rate)  # else a few long ones would be most of the work
        streams.append(_stream(rng, image.name, KINDS[kind](rng, rate, duration_s), mean_s, gateways))
    return _trace("azure", duration_s, made, streams, gateways)


def _image(rng: random.Random, rank: int) -> Image:
    """Return an image with heavy-tailed memory and a cold start that grows with it."""
    memory_mb = 107.083 * ((1 - rng.random()) ** (-1 / 0.221) - 1) ** (1 / 11.652)
    memory_mb = min(2048.0, max(64.0, memory_mb))
    cold_ms = rng.lognormvariate(math.log(300.0), 0.5) + memory_mb
    return Image(name=f"image-{rank:03}", memory_mb=round(memory_mb), cold_ms=round(cold_ms, 1))


def _stream(rng: random.Random, image: str, times: Iterable[float], mean_s: float, gateways: int) -> Iterable[Arrival]:
    """Spread an image's arrivals over gateways: half of them come to one home, the others anywhere."""
    home = rng.randrange(gateways)
    return sorted(
        (
            Arrival(
                at_s=at,
                image=image,
                service_s=service(rng, mean_s),
                gateway=home if rng.random() < 0.5 else rng.randrange(gateways),
            )
            for at in times
        ),
        key=_at,
    )


def _at(arrival: Arrival) -> float:
    return arrival.at_s


def _trace(
    name: str, duration_s: float, images: Iterable[Image], streams: list[Iterable[Arrival]], gateways: int
) -> Trace:
    return Trace(
        name=name,
        duration_s=duration_s,
        images={image.name: image for image in images},
        arrivals=tuple(heapq.merge(*streams, key=_at)),
        gateways=gateways,
    )


def read_trace(path: Path, images: Mapping[str, Image] | None = None) -> Trace:
    """Read a trace; times count from its first arrival. An image that is not described has the usual size and cost.

    Raises:
        ConfigError: a line is not an arrival, or there is none or far too many.
    """
    decoder = msgspec.json.Decoder(Arrival)
    arrivals: list[Arrival] = []
    with path.open("rb") as lines:
        for number, line in enumerate(lines, 1):
            if not line.strip():
                continue
            if number > MAX_LINES:
                raise ConfigError(f"{path}: more than {MAX_LINES} lines", remedy="cut it")
            try:
                arrival = decoder.decode(line)
            except msgspec.DecodeError as error:
                raise ConfigError(f"{path}, line {number}: {error}", remedy="see workshop/simulators/pool") from None
            arrivals.append(arrival)
    if not arrivals:
        raise ConfigError(f"{path}: no arrivals")
    return trace_of(path.stem, arrivals, images)


def trace_of(name: str, arrivals: Iterable[Arrival], images: Mapping[str, Image] | None = None) -> Trace:
    """Return arrivals, in any order, as a trace that begins at 0 and ends when the last run does."""
    ordered = sorted(arrivals, key=lambda each: each.at_s)
    first = ordered[0].at_s
    moved = tuple(msgspec.structs.replace(each, at_s=each.at_s - first) for each in ordered)
    known = images or {}
    return Trace(
        name=name,
        duration_s=max(each.at_s + each.service_s for each in moved),
        images={each.image: known.get(each.image, Image(name=each.image)) for each in moved},
        arrivals=moved,
        gateways=1 + max(each.gateway for each in moved),
    )


def write_trace(trace: Trace, path: Path) -> None:
    """Write a trace's arrivals."""
    encoder = msgspec.json.Encoder()
    with path.open("wb") as out:
        for arrival in trace.arrivals:
            out.write(encoder.encode(arrival) + b"\n")
