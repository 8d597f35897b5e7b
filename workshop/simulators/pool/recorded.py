"""Traces of real fleets: one JSON object a line, {"at_s": 12.5, "image": "vision", "service_s": 0.8, "gateway": 0}."""

from collections.abc import Iterable, Mapping
from pathlib import Path

import msgspec

from appliance.errors import ConfigError
from workshop.simulators.pool.traces import Arrival, Image, Trace

MAX_LINES = 5_000_000


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
