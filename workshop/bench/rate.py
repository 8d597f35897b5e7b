"""p99 of the start against the arrival rate, until it breaks, and why: four gateways, all modes, even and uneven.

Each mode gets a fleet of its own with the same containers, memory and queue; only how it uses them differs:

    cold       a new container for each run
    local      the paper's baseline: warm containers of this gateway only, kept for ten minutes after their last run,
               none started ahead beyond the first, which it is given so that it is not made worse than it has to be
    federated  those of other gateways too, and whatever the product's defaults start ahead

Rates are offered in rising order as an open loop (`load`), with a pause in between until nothing runs and nothing is
being started any more; the first one that is too much ends the ladder. What the pools start and give up while a rate
is offered is part of it. All of it shares the machine with the fleet, and the sender is seen too.
"""

import asyncio
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import psutil
from msgspec import Struct
from msgspec.structs import replace

from appliance.connection import FleetState
from appliance.errors import ConfigError
from appliance.model import GatewayStatus
from appliance.pool.settings import PoolConfig
from workshop.bench import fleet
from workshop.bench.figures import ratio
from workshop.bench.fleet import Orders, Progress
from workshop.bench.load import Sampled, Spread, account, arrivals, breaking, verdict, window_s

Mode = Literal["cold", "local", "federated"]
MODES: tuple[Mode, ...] = ("cold", "local", "federated")
SPREADS: tuple[Spread, ...] = ("even", "uneven")
RATES = (1.0, 2.0, 5.0, 10.0, 20.0, 40.0, 80.0, 160.0, 320.0)
GATEWAYS = ("gw-1", "gw-2", "gw-3", "gw-4")
PER_GATEWAY = 4
"""Containers that a gateway may hold: 4 busy for 150 ms serve 26 runs/s, so uneven arrivals overload one gateway
where all four together are not half busy."""
PROMISED_P99_MS = 60.0
PROMISED_RATE = 20.0
PROMISED_UNEVEN = 1.5
"""How many times lower federated p99 is than local p99 when arrivals are uneven."""
PATIENCE_S = 15.0
"""A run that has not ended by then is lost: it waits for a container, or for a core."""
SETTLE_S = 30.0
SAMPLE_S = 0.1


class Options(Struct, frozen=True, kw_only=True):
    """What to measure. The default takes about ten minutes."""

    modes: tuple[Mode, ...] = MODES
    spreads: tuple[Spread, ...] = SPREADS
    rates: tuple[float, ...] = RATES
    services_ms: tuple[float, ...] = (0.0, 150.0)
    """What the handler sleeps: 0 is the start alone; with 150 it matters how many run at once."""
    seconds: float = 6.0
    """For how long a rate is offered."""
    least: int = 12
    """Runs of a slow rate, which is offered longer for it, up to `most_s`."""
    most_s: float = 12.0
    limit_ms: float = 1000.0
    """p99 beyond which a load is too much."""
    seed: int = 1
    image: str = "base"

    def check(self) -> None:
        """Raise ConfigError for what cannot be measured."""
        if not self.rates or not all(0 < rate <= 1000 for rate in self.rates):
            raise ConfigError("rates are runs a second, above 0 and up to 1000")
        if not (0 < self.seconds <= 600 and all(0 <= each <= 5000 for each in self.services_ms)):
            raise ConfigError("at most 600 seconds for each rate, and at most 5000 ms of service")


def pool_of(mode: Mode, image: str) -> PoolConfig:
    """Return the pool of one gateway in a mode: in all of them as many containers, as much memory, the same queue."""
    alike = PoolConfig(
        mode=mode,
        floor={} if mode == "cold" else {image: 1},
        capacity=PER_GATEWAY,
        memory_mb=PER_GATEWAY * 256,
        container_memory_mb=256,
    )
    if mode == "federated":
        return alike
    return replace(alike, prewarm=(), keep="fixed", idle_s=600.0, eviction="lru")


async def run(options: Options, *, progress: Progress) -> dict[str, Any]:
    """Measure as `options` say.

    Returns:
        `ladders`: for each mode, spread and service time its `cells` by rate (see `load.account`) and where it
        `breaks`; `targets`: the promises and what was reached.

    Raises:
        ConfigError: something cannot be measured as told.
    """
    options.check()
    ladders: list[dict[str, Any]] = []
    for mode in options.modes:
        pools = {name: pool_of(mode, options.image) for name in GATEWAYS}
        async with fleet.running(pools, image=options.image, progress=progress) as (state, orders):
            for service_ms in options.services_ms:
                for spread in options.spreads:
                    progress(f"{mode}, {spread} arrivals, {service_ms:g} ms of work")
                    ladders.append(await _ladder(options, mode, spread, service_ms, state, orders, progress))
    return {
        "unit": "ms",
        "gateways": len(GATEWAYS),
        "containers_per_gateway": PER_GATEWAY,
        "seconds": options.seconds,
        "seed": options.seed,
        "limit_ms": options.limit_ms,
        "ladders": ladders,
        "targets": targets(ladders),
    }


async def _ladder(
    options: Options,
    mode: Mode,
    spread: Spread,
    service_ms: float,
    state: FleetState,
    orders: Orders,
    progress: Progress,
) -> dict[str, Any]:
    """Offer rising rates until one is too much."""
    cells: dict[float, dict[str, Any]] = {}
    whys: dict[float, list[str]] = {}
    for name in state.gateways:  # each pays for its first run now
        await orders.run(name)
    for rate in sorted(options.rates):
        settled_s = await _settle(orders, progress)
        window = window_s(rate, seconds=options.seconds, least=options.least, most_s=options.most_s)
        wanted = arrivals(rate, window, state.gateways, spread=spread, seed=options.seed)
        watch = Watch(state, orders)
        kept = await upkeep(orders)
        sampling = asyncio.create_task(watch.sample(), name="watch the machine")
        try:
            outcomes = await orders.offer(wanted, service_ms=service_ms, patience_s=PATIENCE_S, sent=watch.end)
        finally:
            sampling.cancel()
        seen = watch.seen
        cells[rate] = account(outcomes, seen) | {
            "seconds": round(window, 1),
            "settled_s": round(settled_s, 1),
            "upkeep": dict(await upkeep(orders) - kept),
        }
        whys[rate] = verdict(outcomes, seen, limit_ms=options.limit_ms)
        start = cells[rate]["start"]
        progress(
            f"  {rate:g}/s: {len(outcomes)} runs, start p50 {start.get('p50')} p99 {start.get('p99')} ms, "
            f"CPU {seen.cpu:.0%}" + (f" - too much: {'; '.join(whys[rate])}" if whys[rate] else "")
        )
        if whys[rate]:
            break
    return {
        "mode": mode,
        "spread": spread,
        "service_ms": service_ms,
        "cells": {f"{rate:g}": cell for rate, cell in cells.items()},
        "breaking": breaking(whys),
    }


async def _settle(orders: Orders, progress: Progress) -> float:
    """Wait until no gateway tells of runs in progress or waiting, nor of containers that are yet to be ready.

    A load that was too much takes a while; returns for how long, seconds, at most `SETTLE_S`.
    """
    began = time.monotonic()
    await asyncio.sleep(0.3)
    while not quiet(gateways := orders.client.plane.registry.gateways):
        waited_s = time.monotonic() - began
        if waited_s > SETTLE_S:
            progress(f"  not quiet after {waited_s:.0f} s: " + ", ".join(_at_work(gateways)))
            break
        await asyncio.sleep(0.1)
    return time.monotonic() - began


def quiet(gateways: Mapping[str, GatewayStatus]) -> bool:
    """Whether nothing runs, waits or is being started on any of the gateways."""
    return not _at_work(gateways)


def _at_work(gateways: Mapping[str, GatewayStatus]) -> list[str]:
    return [
        f"{name} has {each.running} runs, {each.queue} waiting, {each.containers - each.ready} containers not ready"
        for name, each in sorted(gateways.items())
        if each.running or each.queue or each.containers > each.ready
    ]


async def upkeep(orders: Orders) -> Counter[str]:
    """Return how many containers all pools together have started, given up and so on since they began, by kind."""
    found, _ = await orders.client.pool_decisions(0)
    return sum((Counter(each.counts) for each in found.values()), Counter[str]())


class Watch:
    """Sees what the machine does while a load is on it."""

    def __init__(self, state: FleetState, orders: Orders) -> None:
        self._orders = orders
        self._processes = {each.name: psutil.Process(each.pid) for each in state.processes}
        self._processes["sender"] = psutil.Process()
        self._queue: dict[str, int] = {}
        self._began, self._busy_s, self._used_s = time.monotonic(), busy_s(), self._used()
        self._refused = self._counters()
        self.seen = Sampled()

    async def sample(self) -> None:
        """Note queue lengths until cancelled."""
        while True:
            for name, status in self._orders.client.plane.registry.gateways.items():
                self._queue[name] = max(self._queue.get(name, 0), status.queue)
            await asyncio.sleep(SAMPLE_S)

    def end(self) -> None:
        """Sum up what was seen since it was made."""
        wall_s = max(1e-3, time.monotonic() - self._began)
        used = self._used()
        busy = busy_s() - self._busy_s
        cores = {name: (used[name] - before) / wall_s for name, before in self._used_s.items() if name in used}
        # Containers, Podman, the kernel, and whatever else the machine does.
        cores["others"] = max(0.0, busy / wall_s - sum(cores.values()))
        gateways = self._orders.client.plane.registry.gateways
        self.seen = Sampled(
            cpu=min(1.0, busy / wall_s / (psutil.cpu_count() or 1)),
            daemons=cores,
            queue=self._queue,
            refused=dict(self._counters() - self._refused),
            containers={name: status.containers for name, status in sorted(gateways.items())},
        )

    def _counters(self) -> Counter[str]:
        total: Counter[str] = Counter()
        for status in self._orders.client.plane.registry.gateways.values():
            total.update(status.refused)
            total.update({f"searches: {what}": count for what, count in status.searches.items()})
        return total

    def _used(self) -> dict[str, float]:
        found: dict[str, float] = {}
        for name, process in self._processes.items():
            try:
                times = process.cpu_times()
            except psutil.Error:  # it died: its gateway's runs tell
                continue
            found[name] = times.user + times.system
        return found


def busy_s() -> float:
    """Return the seconds that all cores together have been busy since boot."""
    times = psutil.cpu_times()
    return sum(times) - times.idle - getattr(times, "iowait", 0.0) - getattr(times, "guest", 0.0)


def targets(ladders: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the promises beside what was reached; those that were not measured are left out."""

    def p99(mode: str, spread: str, service_ms: float, rate: float) -> float | None:
        for each in ladders:
            if (each["mode"], each["spread"], each["service_ms"]) == (mode, spread, service_ms):
                return each["cells"].get(f"{rate:g}", {}).get("start", {}).get("p99")
        return None

    found: dict[str, Any] = {}
    for spread in SPREADS:
        reached = p99("federated", spread, 0.0, PROMISED_RATE)
        if reached is not None:
            found[f"p99_at_{PROMISED_RATE:g}_{spread}"] = {
                "promised_ms": PROMISED_P99_MS, "reached_ms": reached, "kept": reached <= PROMISED_P99_MS,
            }  # fmt: skip
    for each in ladders:
        if (each["mode"], each["spread"]) == ("local", "uneven") and each["service_ms"] > 0:
            # Where the baseline broke before, it is compared at its last rate.
            rate = min(PROMISED_RATE, max(float(rate) for rate in each["cells"]))
            above = p99("local", "uneven", each["service_ms"], rate)
            below = p99("federated", "uneven", each["service_ms"], rate)
            if (factor := ratio(above, below)) is not None:
                found[f"uneven_local_over_federated_p99_at_{rate:g}_of_{each['service_ms']:g}_ms"] = {
                    "promised": PROMISED_UNEVEN, "reached": factor, "kept": factor >= PROMISED_UNEVEN,
                }  # fmt: skip
    return found
