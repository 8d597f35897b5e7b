"""Plays an arrival trace against the planner, as the pools of one gateway or of a thousand would.

Event-driven, without a clock of its own, seeded by the trace: the same trace and settings give the same figures.
What is simulated is what the pool does: a run takes the ready container of its image here that selection would take;
in federated mode else one of another gateway, when its cost is below gamma times a cold start; else a container is
started for it, for which the planner makes room; else it waits, first come first served. A run whose container is
starting takes what comes free before, unless a start is to belong to its run (`binds`). Starting takes the image's cold
start, ending nothing.
"""

import hashlib
from collections import Counter, deque
from collections.abc import Callable, Sequence
from heapq import heappop, heappush
from typing import Literal

from msgspec import Struct
from msgspec.structs import replace

from appliance.pool.policies import ColdCosts, Evictor, Idle, Planner, Retire, View
from appliance.pool.settings import PoolConfig
from workshop.simulators.pool.traces import Arrival, Trace

WARM_MS = 2.5
"""Start on a local warm container, as measured (docs/benchmarks.md)."""
REMOTE_MS = 9.0
"""Start on a warm container of another gateway, as measured: search, two hops and the way back."""


class Outcome(Struct, frozen=True, kw_only=True):
    """What a policy made of a trace. Startups in milliseconds, memory in gigabyte-seconds."""

    runs: int
    local: int
    remote: int
    cold: int
    """Runs in a container that was started for a run and had none before."""
    cold_s: float
    """What the cold starts took together."""
    waited: int
    """Runs that had to wait for room; they count as warm or cold as well."""
    sooner: int
    """Runs that took what came free before the container was there that was started for them; they count as warm."""
    lost: int
    """Runs that were waiting still when the trace was over."""
    p50_ms: float
    p99_ms: float
    used_gb_s: float
    wasted_gb_s: float
    """Held by containers that were ready or being started ahead."""
    evictions: int
    """Given up because their place was needed."""
    retired: int
    """Given up because they had been kept for long enough."""
    prewarmed: int
    unused: int
    """Started ahead and given up without a run."""

    @property
    def cold_rate(self) -> float:
        """Cold starts a run."""
        return self.cold / self.runs if self.runs else 0.0


class _Container:
    __slots__ = ("cold_ms", "for_run", "gateway", "id", "image", "memory_mb", "runs", "since")

    def __init__(self, container_id: str, gateway: "_Gateway", image: str, memory_mb: int, cold_ms: float) -> None:
        self.id = container_id
        self.gateway = gateway
        self.image = image
        self.memory_mb = memory_mb
        self.cold_ms = cold_ms
        self.for_run = False
        """Started because a run waited, and not used yet."""
        self.runs = 0
        self.since = 0.0


class _Gateway:
    def __init__(self, number: int, planner: Planner, costs: ColdCosts, settings: PoolConfig) -> None:
        self.number = number
        self.planner = planner
        self.costs = costs
        self.settings = settings
        self.idle: dict[str, _Container] = {}
        self.by_image: dict[str, dict[str, _Container]] = {}
        self.busy: Counter[str] = Counter()
        self.starting: Counter[str] = Counter()
        self.memory_mb = 0
        self.containers = 0
        self.waiting: deque[tuple[Arrival, float]] = deque()
        self.expecting: dict[str, deque[tuple[Arrival, float]]] = {}
        """Runs whose container is starting, by image."""
        self.ticking = False

    def view(self) -> View:
        """Return what the planner is shown."""
        return View(
            idle=tuple(
                Idle(
                    id=each.id,
                    image=each.image,
                    memory_mb=each.memory_mb,
                    runs=each.runs,
                    cold_ms=each.cold_ms,
                    since=each.since,
                )
                for each in self.idle.values()
            ),
            busy=self.busy,
            starting=self.starting,
            memory_mb=self.memory_mb,
            containers=self.containers,
            budget_mb=self.settings.memory_mb,
            capacity=self.settings.capacity,
        )


_TICK, _END, _READY = 0, 1, 2


class Simulation:
    """One run of a trace.

    Args:
        trace: what arrives.
        settings: of each gateway's pool; its mode too.
        tick_s: how often the pool is gone through (the real one does it twice a second; the figures differ little).
        make_evictor: eviction policy of a gateway instead of the settings'.
        remote_ms: cost of a warm start on another gateway.
        binds: a run waits for the container that is started for it whatever comes free meanwhile, as where a start
            belongs to its run (OpenWhisk); the bounds of `clairvoyant` hold for that.
    """

    def __init__(
        self,
        trace: Trace,
        settings: PoolConfig,
        *,
        tick_s: float = 5.0,
        make_evictor: Callable[[int], Evictor | None] = lambda _: None,
        remote_ms: float = REMOTE_MS,
        binds: bool = False,
    ) -> None:
        self._trace = trace
        self._binds = binds or settings.mode == "cold"
        self._settings = settings
        self._tick_s = tick_s
        self._remote_ms = remote_ms
        self._gateways: list[_Gateway] = []
        for number in range(trace.gateways):
            costs = ColdCosts(settings.cold_ms)
            planner = Planner(settings, costs, self._size_mb, evictor=make_evictor(number))
            self._gateways.append(_Gateway(number, planner, costs, settings))
        self._offers: dict[str, dict[str, _Container]] = {}
        self._events: list[tuple[float, int, int, _Gateway, _Container | None, float]] = []
        self._count = 0
        self._now = 0.0
        self._startups: list[float] = []
        self._counts: Counter[str] = Counter()
        self._cold_ms = 0.0
        self._wasted_mb_s = 0.0
        self._used_mb_s = 0.0
        self._next_tick = 0.0

    def run(self) -> Outcome:
        """Play the trace to its end."""
        for gateway in self._gateways:
            if self._settings.floor:
                self._wake(gateway)
        events = self._events
        for arrival in self._trace.arrivals:
            while events and events[0][0] <= arrival.at_s:
                self._happen()
            self._now = arrival.at_s
            self._arrive(arrival)
        while events and events[0][0] <= self._trace.duration_s:
            self._happen()
        self._now = self._trace.duration_s
        for gateway in self._gateways:
            for each in gateway.idle.values():
                self._wasted_mb_s += (self._now - each.since) * each.memory_mb
        return self._outcome()

    def _outcome(self) -> Outcome:
        ordered = sorted(self._startups)
        counts = self._counts
        return Outcome(
            runs=len(self._trace.arrivals),
            local=counts["local"],
            remote=counts["remote"],
            cold=counts["cold"],
            cold_s=round(self._cold_ms / 1e3, 3),
            waited=counts["waited"],
            sooner=counts["sooner"],
            lost=sum(len(gateway.waiting) + sum(map(len, gateway.expecting.values())) for gateway in self._gateways),
            p50_ms=percentile(ordered, 0.5),
            p99_ms=percentile(ordered, 0.99),
            used_gb_s=round(self._used_mb_s / 1024, 3),
            wasted_gb_s=round(self._wasted_mb_s / 1024, 3),
            evictions=counts["evicted"],
            retired=counts["retired"],
            prewarmed=counts["prewarmed"],
            unused=counts["unused"],
        )

    # --- events -----------------------------------------------------------------------------------------------

    def _push(self, at: float, kind: int, gateway: _Gateway, container: _Container | None, value: float) -> None:
        self._count += 1
        heappush(self._events, (at, self._count, kind, gateway, container, value))

    def _happen(self) -> None:
        at, _, kind, gateway, container, value = heappop(self._events)
        self._now = at
        if kind == _TICK:
            gateway.ticking = False
            self._tend(gateway)
            if gateway.idle or gateway.busy or gateway.starting:
                self._wake(gateway)
        elif container is not None and kind == _END:
            gateway.planner.ended(container.image, value, at)
            self._less(gateway.busy, container.image)
            self._used_mb_s += (at - container.since) * container.memory_mb
            container.runs += 1
            self._free(container)
        elif container is not None:
            self._less(gateway.starting, container.image)
            gateway.costs.add(container.image, container.cold_ms)
            held_mb_s = (at - container.since) * container.memory_mb
            if container.for_run:
                self._used_mb_s += held_mb_s
            else:
                self._wasted_mb_s += held_mb_s
            self._free(container)

    @staticmethod
    def _less(counter: Counter[str], image: str) -> None:
        counter[image] -= 1
        if not counter[image]:
            del counter[image]

    def _wake(self, gateway: _Gateway) -> None:
        """Have the gateway gone through at the next of its ticks, which are not all at the same moment."""
        if not gateway.ticking:
            gateway.ticking = True
            phase = (gateway.number * 0.618) % 1.0
            at = (int(self._now / self._tick_s - phase) + 1 + phase) * self._tick_s
            self._push(at if at > self._now else at + self._tick_s, _TICK, gateway, None, 0.0)

    # --- runs -------------------------------------------------------------------------------------------------

    def _arrive(self, arrival: Arrival) -> None:
        gateway = self._gateways[arrival.gateway]
        self._wake(gateway)
        if self._place(arrival, gateway, self._now):
            return
        self._counts["waited"] += 1
        gateway.planner.arrived(arrival.image, self._now)
        gateway.waiting.append((arrival, self._now))

    def _place(self, arrival: Arrival, gateway: _Gateway, since: float, *, known: bool = False) -> bool:
        """Begin a run, warm here, warm elsewhere, or cold; False when there is no room."""
        image = arrival.image
        waited_ms = (self._now - since) * 1e3
        cold = self._settings.mode == "cold"
        here = gateway.by_image.get(image) if not cold else None
        if here:
            self._begin(arrival, here[max(here)], waited_ms + WARM_MS, "local", known=known)
            return True
        if self._settings.mode == "federated":
            offers = self._offers.get(image)
            if offers and self._remote_ms < self._settings.gamma * gateway.costs.of(image):
                there = offers[max(offers)]
                if known:  # it waited here and runs there
                    gateway.planner.ended(image, 0.0, self._now)
                self._begin(arrival, there, waited_ms + self._remote_ms, "remote")
                return True
        size_mb = self._size_mb(image)
        victims = gateway.planner.room(gateway.view(), size_mb, self._now, for_run=True)
        if victims is None:
            return False
        self._give_up(gateway, victims, "evicted")
        container = self._new(gateway, image)
        if not known:
            gateway.planner.arrived(image, self._now)
        if not self._binds:
            container.for_run = True
            gateway.starting[image] += 1
            gateway.expecting.setdefault(image, deque()).append((arrival, since))
            self._push(self._now + container.cold_ms / 1e3, _READY, gateway, container, 0.0)
            return True
        gateway.busy[image] += 1
        self._counts["cold"] += 1
        self._cold_ms += container.cold_ms
        self._startups.append(waited_ms + container.cold_ms)
        gateway.costs.add(image, container.cold_ms)
        service_s = arrival.service_s + container.cold_ms / 1e3
        self._push(self._now + service_s, _END, gateway, container, service_s)
        return True

    def _serve_expecting(self, container: _Container) -> bool:
        """Give a container that came free to the run of its image that has expected one for longest, if any has."""
        gateway, image = container.gateway, container.image
        expecting = gateway.expecting.get(image)
        if not expecting:
            return False
        arrival, since = expecting.popleft()
        took_ms = (self._now - since) * 1e3
        if container.for_run:
            self._counts["cold"] += 1
            self._cold_ms += container.cold_ms  # without the wait for room before it
        else:
            self._counts["local"] += 1
            self._counts["sooner"] += 1
            took_ms += WARM_MS
        container.for_run = False
        self._startups.append(took_ms)
        gateway.busy[image] += 1
        self._push(self._now + arrival.service_s, _END, gateway, container, arrival.service_s)
        return True

    def _begin(
        self, arrival: Arrival, container: _Container, startup_ms: float, how: str, *, known: bool = False
    ) -> None:
        gateway = container.gateway
        self._take(container)
        if not known:
            gateway.planner.arrived(arrival.image, self._now)
        gateway.busy[arrival.image] += 1
        self._wasted_mb_s += (self._now - container.since) * container.memory_mb
        container.since = self._now
        self._counts[how] += 1
        self._startups.append(startup_ms)
        self._push(self._now + arrival.service_s, _END, gateway, container, arrival.service_s)
        self._wake(gateway)

    def _serve(self, gateway: _Gateway) -> None:
        while gateway.waiting:
            arrival, since = gateway.waiting[0]
            if not self._place(arrival, gateway, since, known=True):
                return
            gateway.waiting.popleft()

    # --- containers -------------------------------------------------------------------------------------------

    def _size_mb(self, image: str) -> int:
        return self._trace.images[image].memory_mb

    def _new(self, gateway: _Gateway, image: str) -> _Container:
        self._count += 1
        facts = self._trace.images[image]
        # Random names, as in the pool, so that the tie between two containers falls as it does there.
        name = hashlib.blake2b(self._count.to_bytes(8, "big"), digest_size=6).hexdigest()
        container = _Container(name, gateway, image, facts.memory_mb, facts.cold_ms)
        container.since = self._now
        gateway.memory_mb += facts.memory_mb
        gateway.containers += 1
        return container

    def _free(self, container: _Container) -> None:
        gateway = container.gateway
        container.since = self._now
        if self._serve_expecting(container):
            return
        container.for_run = False
        gateway.idle[container.id] = container
        gateway.by_image.setdefault(container.image, {})[container.id] = container
        self._offers.setdefault(container.image, {})[container.id] = container
        if self._settings.mode == "cold":
            self._remove(container)
        if gateway.waiting:
            self._serve(gateway)

    def _take(self, container: _Container) -> None:
        gateway = container.gateway
        del gateway.idle[container.id]
        del gateway.by_image[container.image][container.id]
        del self._offers[container.image][container.id]

    def _remove(self, container: _Container) -> None:
        self._take(container)
        container.gateway.memory_mb -= container.memory_mb
        container.gateway.containers -= 1
        self._wasted_mb_s += (self._now - container.since) * container.memory_mb
        if not container.runs:
            self._counts["unused"] += 1

    def _give_up(self, gateway: _Gateway, retired: Sequence[Retire], how: str) -> None:
        for each in retired:
            container = gateway.idle[each.id]
            if how == "evicted":
                gateway.planner.evicted(
                    Idle(
                        id=container.id,
                        image=container.image,
                        memory_mb=container.memory_mb,
                        runs=container.runs,
                        cold_ms=container.cold_ms,
                        since=container.since,
                    ),
                    self._now,
                )
            self._remove(container)
            self._counts[how] += 1

    def _tend(self, gateway: _Gateway) -> None:
        if self._settings.mode == "cold":
            return
        starts, retired = gateway.planner.tend(gateway.view(), self._now)
        self._give_up(gateway, retired, "retired")
        for start in starts:
            container = self._new(gateway, start.image)
            gateway.starting[start.image] += 1
            self._counts["prewarmed"] += 1
            self._push(self._now + container.cold_ms / 1e3, _READY, gateway, container, 0.0)


def percentile(ordered: Sequence[float], part: float) -> float:
    """Return the nearest-rank percentile of what is in order; 0 of nothing."""
    return round(ordered[max(0, -int(-part * len(ordered) // 1) - 1)], 3) if ordered else 0.0


def simulate(
    trace: Trace,
    settings: PoolConfig,
    *,
    mode: Literal["cold", "local", "federated"] | None = None,
    tick_s: float = 5.0,
    make_evictor: Callable[[int], Evictor | None] = lambda _: None,
    binds: bool = False,
) -> Outcome:
    """Return what the settings make of a trace; `mode` instead of the settings', `binds` as for `Simulation`."""
    settings = replace(settings, mode=mode) if mode is not None else settings
    return Simulation(trace, settings, tick_s=tick_s, make_evictor=make_evictor, binds=binds).run()
