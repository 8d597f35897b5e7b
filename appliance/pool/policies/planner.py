"""Decides which containers a gateway starts ahead and which it gives up. Plain code: the clock is passed in.

The manager of the pool and the simulator use the same planner: they tell it what happens (`arrived`, `ended`,
`hinted`, `evicted`), show it what there is (`View`), and carry out what it answers (`Start`, `Retire`).

Guarantees, each a property test:
    - What `room` and `tend` order never leaves more containers or memory than the view allows, unless busy ones
      alone take more.
    - An image never falls below its floor, except for a run that waits or when the budget itself has shrunk.

`Quarantine` says which images are not to be started: one that does not start is left alone for a while.
"""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence

from msgspec import Struct
from msgspec.structs import replace

from appliance.model import PoolHint
from appliance.pool.policies.eviction import (
    EVICTION,
    KEEPING,
    ColdCosts,
    Evictor,
    Idle,
    Learned,
    LearnedState,
    Retire,
    Start,
    View,
)
from appliance.pool.policies.forecast import (
    OPERATOR,
    Demand,
    DemandState,
    Forecaster,
    Histogram,
    Level,
    PlanHints,
    Rate,
    Surety,
    containers_for,
)
from appliance.pool.settings import PoolConfig


class Quarantine:
    """Images whose containers fail to start are left alone for a while, with the reason. The clock is passed in."""

    def __init__(self, *, after: int, for_s: float) -> None:
        self._after = after
        self._for_s = for_s
        self._failures: Counter[str] = Counter()
        self._until: dict[str, tuple[float, str]] = {}

    def failed(self, image: str, reason: str, now: float) -> None:
        """Note a failed start."""
        self._failures[image] += 1
        if self._failures[image] >= self._after:
            self._until[image] = (now + self._for_s, reason)

    def succeeded(self, image: str) -> None:
        """Note a start that worked."""
        self._failures.pop(image, None)
        self._until.pop(image, None)

    def reason(self, image: str, now: float) -> str:
        """Return why the image is left alone; empty when it is not. After the time one more start is tried."""
        until, reason = self._until.get(image, (0.0, ""))
        if not reason or now >= until:
            return ""
        return f"{self._failures[image]} starts of image {image} failed in a row, left alone for a while: {reason}"

    def reasons(self, now: float) -> tuple[str, ...]:
        """Return the reasons of all that are left alone."""
        return tuple(text for image in sorted(self._until) if (text := self.reason(image, now)))


AHEAD = 1.5
"""A start is ordered so many times its usual duration ahead …"""
AHEAD_S = 0.5
"""… and this much, for the pool is gone through twice a second."""
LESS = 0.8
"""A container is given up for one that is only forecast when it is worth less than this part of it."""
FRESH_S = 60.0
"""A container that was started ahead is not given up within that time to start another one ahead."""
TRIES = 4
"""Forecasts, the most valuable first, for which room is looked for in vain before the rest waits for the next time."""
LEAST_STAY_S = 5.0
"""A container that was started ahead stays for at least so long: a forecast may waver."""


class PlannerState(Struct, frozen=True, kw_only=True):
    """What the policies have learned, to survive a restart."""

    learned: LearnedState | None = None
    demand: dict[str, DemandState] = {}


class Weighed(Struct, frozen=True):
    """Whom `room` gave up for a run, and what it weighed."""

    idle: tuple[Idle, ...]
    worths: tuple[float, ...]
    slots: int
    memory_mb: int
    chosen: tuple[Idle, ...]


class Planner:
    """Prewarming, keeping and eviction of one gateway's containers.

    Args:
        settings: floor, idle_s, starts_at_once, hit_target and the choice of policies.
        costs: what cold starts of each image cost here.
        size_mb: memory that a container of an image gets.
        hour: the hour of the day, 0 to 24, at a reading of the clock.
        evictor: eviction policy instead of the settings' (the simulator's clairvoyant one).
    """

    def __init__(
        self,
        settings: PoolConfig,
        costs: ColdCosts,
        size_mb: Callable[[str], int],
        *,
        hour: Callable[[float], float] = lambda now: now / 3600.0 % 24.0,
        evictor: Evictor | None = None,
    ) -> None:
        self._settings = settings
        self._costs = costs
        self._size_mb = size_mb
        self._demand = Demand()
        self._hints = PlanHints()
        self._wishes = PlanHints()
        """Of operators: they are met whatever `prewarm` says."""
        histogram = Histogram(self._demand)
        rate = Rate(self._demand, hit_target=settings.hit_target, horizon_s=settings.idle_s)
        known: dict[str, Forecaster] = {"hints": self._hints, "histogram": histogram, "rate": rate}
        chosen = [each for name, each in known.items() if name in settings.prewarm]
        self._forecasters: list[Forecaster] = [self._wishes, *chosen]
        self._learned = Learned(self._demand, next_hint_s=self._hints.next_s, hour=hour)
        self._keeping = KEEPING[settings.keep](settings, self._learned, histogram, costs)
        self._learns = settings.keep == "worth" or settings.eviction == "learned"
        self._evictor = evictor or EVICTION[settings.eviction](self._learned)
        self.weighed: Weighed | None = None
        """What the last room for a run was made from, where it took the place of something."""

    # --- what happens ---------------------------------------------------------------------------------------

    def arrived(self, image: str, now: float) -> None:
        """Note that a run begins here, or waits for a container here, whether it found a warm one or not."""
        self._demand.arrived(image, now)
        self._hints.arrived(image, now)
        self._evictor.arrived(image, now)
        if self._learns and self._evictor is not self._learned:
            self._learned.arrived(image, now)

    def ended(self, image: str, service_s: float, now: float) -> None:
        """Note that a run that had arrived is over, having had its container for `service_s` (0: it had none)."""
        self._demand.ended(image, service_s, now)

    def hinted(self, hint: PoolHint, now: float) -> None:
        """Note what a plan, or an operator, will need."""
        (self._wishes if hint.task == OPERATOR else self._hints).hinted(hint, now)

    def evicted(self, idle: Idle, now: float) -> None:
        """Note that a container that `room` named was given up. What `tend` orders is noted already."""
        self._evictor.evicted(idle, now)

    def state(self) -> PlannerState:
        """Return what was learned, to be kept."""
        return PlannerState(learned=self._learned.state(), demand=self._demand.state())

    def restore(self, state: PlannerState, now: float) -> None:
        """Go on from what was learned before."""
        self._demand.restore(state.demand, now)
        if state.learned is not None:
            self._learned.restore(state.learned)

    # --- what to do -----------------------------------------------------------------------------------------

    def room(self, view: View, memory_mb: int, now: float, *, for_run: bool) -> tuple[Retire, ...] | None:
        """Return whom to give up for one more container of `memory_mb`, worth least first; None: there is no room.

        Args:
            view: what there is.
            memory_mb: memory of the one to come.
            now: clock, seconds.
            for_run: a run waits for it, so nothing idle need be spared.
        """
        slots, needed_mb = _lacking(view, memory_mb)
        if slots <= 0 and needed_mb <= 0:
            return ()
        worths = self._evictor.worths(view.idle, now)
        if for_run:
            chosen = victims(view.idle, worths, slots=slots, memory_mb=needed_mb, spare={})
            self.weighed = Weighed(view.idle, tuple(worths), slots, needed_mb, chosen or ())
        else:
            chosen = self._cheaper(view, worths, slots, needed_mb, self._wanted(view, now), now)
        return None if chosen is None else tuple(Retire(id=each.id, why="its place is needed") for each in chosen)

    def tend(self, view: View, now: float) -> tuple[tuple[Start, ...], tuple[Retire, ...]]:
        """Return what to start ahead and what to give up, to be carried out together, retirements first."""
        self._demand.settle({image for counts in (view.busy, view.starting) for image in counts if counts[image]}, now)
        if self._learns:
            self._learned.observed(view.idle, now)
        wanted = self._wanted(view, now)
        retired = self._overdue(view, wanted, now)
        view = without(view, retired)
        for each in self._beyond_budget(view, now):
            retired[each.id] = "the budget has shrunk"
            self._evictor.evicted(each, now)
        view = without(view, retired)
        ready = Counter(each.image for each in view.idle)
        coming = {image: ready[image] + view.starting.get(image, 0) for image in wanted}
        starts: list[Start] = []
        worths: dict[str, float] = {}
        places = self._settings.starts_at_once - sum(view.starting.values())
        sure = missing({image: each.sure for image, each in wanted.items()}, coming)
        guessed = [image for image in sorted(wanted) if wanted[image].count > max(coming[image], wanted[image].sure)]
        if places <= 0:
            sure, guessed = (), []
        elif guessed and not _fits(view, sum(map(self._size_mb, guessed)), len(guessed)):
            worths = self._worths(view, guessed, now)
            guessed.sort(key=lambda image: -worths[_new(image)])
        failed = 0
        for image in (*sure, *guessed):
            if len(starts) >= places or failed >= TRIES:
                break
            if image in view.blocked:
                continue
            size_mb = self._size_mb(image)
            slots, needed_mb = _lacking(view, size_mb)
            chosen: tuple[Idle, ...] | None = ()
            if (slots > 0 or needed_mb > 0) and coming[image] >= wanted[image].firm:
                chosen = None
            elif slots > 0 or needed_mb > 0:
                worths = worths or self._worths(view, guessed, now)
                bar = math.inf if coming[image] < wanted[image].sure else worths[_new(image)] * LESS
                here = [worths[each.id] for each in view.idle]
                chosen = self._cheaper(view, here, slots, needed_mb, wanted, now, bar=bar)
            if chosen is None:
                failed += 1
                continue
            coming[image] += 1
            starts.append(Start(image=image, why=wanted[image].why))
            for each in chosen:
                retired[each.id] = "its place is needed"
                self._evictor.evicted(each, now)
            view = with_start(without(view, retired), image, size_mb)
        return tuple(starts), tuple(Retire(id=key, why=why) for key, why in retired.items())

    def _worths(self, view: View, short: Sequence[str], now: float) -> dict[str, float]:
        """Return what the idle ones are worth, and what the next one of each image that is short would be."""
        new = [
            Idle(id="", image=image, memory_mb=self._size_mb(image), runs=0, cold_ms=self._costs.of(image), since=now)
            for image in short
        ]
        worths = self._evictor.worths((*view.idle, *new), now)
        return dict(zip((*(each.id for each in view.idle), *map(_new, short)), worths, strict=True))

    @staticmethod
    def _cheaper(
        view: View,
        worths: Sequence[float],
        slots: int,
        memory_mb: int,
        wanted: Mapping[str, "_Wanted"],
        now: float,
        *,
        bar: float = math.inf,
    ) -> tuple[Idle, ...] | None:
        """Return whom to give up for one that is started ahead: nobody who is surely wanted, new, or worth as much."""
        open_to = [
            (each, worth)
            for each, worth in zip(view.idle, worths, strict=True)
            if worth < bar and (each.runs or now - each.since >= FRESH_S)
        ]
        if not open_to:
            return None
        # What is spared counts all idle ones, also those that are not open to it.
        closed = Counter(each.image for each in view.idle) - Counter(each.image for each, _ in open_to)
        return victims(
            [each for each, _ in open_to],
            [worth for _, worth in open_to],
            slots=slots,
            memory_mb=memory_mb,
            spare={
                image: wanted[image].sure - closed[image]
                for image in {each.image for each, _ in open_to}
                if image in wanted
            },
        )

    def _wanted(self, view: View, now: float) -> dict[str, "_Wanted"]:
        """Return how many idle or starting containers of each image are wanted, and why the last of them is."""
        images = {*self._settings.floor}
        for forecaster in self._forecasters:
            images.update(forecaster.images(now))
        wanted: dict[str, _Wanted] = {}
        for image in images:
            busy = view.busy.get(image, 0)
            ahead_s = self._ahead_s(image)
            floor = self._settings.floor.get(image, 0)
            count = firm = sure = max(0, floor - self._soon_free(view, image, now))
            why = f"pool.floor keeps {floor} ready"
            while count < view.capacity:
                reason, surety = self._wants(Level(image, busy + count + 1, busy, ahead_s), now)
                if not reason:
                    break
                count, why = count + 1, reason
                firm = count if surety >= Surety.LESS_WORTH else firm
                sure = count if surety >= Surety.CERTAIN else sure
            if count:
                wanted[image] = _Wanted(count, firm, sure, why)
        return wanted

    def _soon_free(self, view: View, image: str, now: float) -> int:
        """Return how many busy containers of an image count as ready: free again before a new one would be.

        None where runs usually take longer than a start, and none of those that do. Else those beyond what the load
        keeps busy (`rate`): with two runs a second of 3 ms that is none, so that the one of this moment is no reason to
        start another.
        """
        demand = self._demand.images.get(image)
        busy = view.busy.get(image, 0) - view.lasting.get(image, 0)
        if not busy or demand is None or demand.service_s * 1e3 >= self._costs.of(image):
            return 0
        load = demand.service_s / max(1e-9, demand.gap_s(now))
        return max(0, busy + 1 - containers_for(load, self._settings.hit_target))

    def _wants(self, level: Level, now: float) -> tuple[str, Surety]:
        """Return why a level is wanted, empty when it is not, and how surely."""
        for forecaster in self._forecasters:
            why = forecaster.wants(level, now)
            if why is not None:
                return why, forecaster.surety
        return "", Surety.SPARE_ROOM

    def _ahead_s(self, image: str) -> float:
        return AHEAD * self._costs.of(image) / 1e3 + AHEAD_S

    def _overdue(self, view: View, wanted: Mapping[str, "_Wanted"], now: float) -> dict[str, str]:
        """Return who has been kept for long enough: of each image those used last are the last to go."""
        by_image: dict[str, list[Idle]] = {}
        for each in view.idle:
            by_image.setdefault(each.image, []).append(each)
        overdue: dict[str, str] = {}
        for image, idle in by_image.items():
            busy = view.busy.get(image, 0)
            spare = wanted[image].count - view.starting.get(image, 0) if image in wanted else 0
            spare = max(0, spare)
            if len(idle) <= spare:
                continue
            ahead_s = self._ahead_s(image)
            idle.sort(key=lambda each: (-each.since, each.id))
            for rank in range(len(idle) - 1, spare - 1, -1):
                each = idle[rank]
                if not each.runs and now - each.since < LEAST_STAY_S:
                    continue
                why = self._keeping.rests(each, Level(image, busy + rank + 1, busy, ahead_s), now)
                if why:
                    overdue[each.id] = why
        return overdue

    def _beyond_budget(self, view: View, now: float) -> tuple[Idle, ...]:
        """Return whom to give up when the budget has shrunk below what is held: floors last."""
        slots, memory_mb = view.containers - view.capacity, view.memory_mb - view.budget_mb
        if slots <= 0 and memory_mb <= 0:
            return ()
        worths = self._evictor.worths(view.idle, now)
        for spare in (self._settings.floor, {}):
            chosen = victims(view.idle, worths, slots=slots, memory_mb=memory_mb, spare=spare)
            if chosen is not None:
                return chosen
        return view.idle


class _Wanted(Struct, frozen=True):
    """Containers of an image that are wanted beside the busy ones."""

    count: int
    firm: int
    """Of these, how many may take the place of what is worth less."""
    sure: int
    """Of those, how many are the floor or announced by a plan."""
    why: str


def _new(image: str) -> str:
    return f"new {image}"


def _fits(view: View, memory_mb: int, containers: int) -> bool:
    return view.memory_mb + memory_mb <= view.budget_mb and view.containers + containers <= view.capacity


def _lacking(view: View, memory_mb: int) -> tuple[int, int]:
    """Return the places and megabytes that are missing for one more container."""
    return view.containers + 1 - view.capacity, view.memory_mb + memory_mb - view.budget_mb


def victims(
    idle: Sequence[Idle], worths: Sequence[float], *, slots: int, memory_mb: int, spare: Mapping[str, int]
) -> tuple[Idle, ...] | None:
    """Return whom to give up to free `slots` places and `memory_mb`, worth least first; None when it is not enough.

    Args:
        idle: containers that may be given up.
        worths: what each is worth.
        slots: places needed.
        memory_mb: memory needed.
        spare: so many idle ones of each image are left.
    """
    if slots <= 0 and memory_mb <= 0:
        return ()
    left = Counter(each.image for each in idle)
    chosen: list[Idle] = []
    for _, _, each in sorted(zip(worths, (each.id for each in idle), idle, strict=True), key=lambda one: one[:2]):
        if left[each.image] <= spare.get(each.image, 0):
            continue
        left[each.image] -= 1
        chosen.append(each)
        slots -= 1
        memory_mb -= each.memory_mb
        if slots <= 0 and memory_mb <= 0:
            return tuple(chosen)
    return None


def missing(floor: Mapping[str, int], coming: Mapping[str, int]) -> tuple[str, ...]:
    """Return the images to start containers of, one entry a container, the most wanting first.

    Args:
        floor: containers of each image to keep ready.
        coming: containers of each image that are ready or starting.
    """
    short = {image: count - coming.get(image, 0) for image, count in floor.items()}
    order: list[str] = []
    for depth in range(max(short.values(), default=0)):
        order += [image for image in sorted(short) if short[image] > depth]
    return tuple(sorted(order, key=lambda image: coming.get(image, 0)))


def without(view: View, gone: Mapping[str, str]) -> View:
    """Return the view as it is once these idle containers are gone."""
    if not gone:
        return view
    kept = tuple(each for each in view.idle if each.id not in gone)
    freed = sum(each.memory_mb for each in view.idle) - sum(each.memory_mb for each in kept)
    containers = view.containers - len(view.idle) + len(kept)
    return replace(view, idle=kept, memory_mb=view.memory_mb - freed, containers=containers)


def with_start(view: View, image: str, memory_mb: int) -> View:
    """Return the view as it is once a start of this image has begun."""
    starting = {**view.starting, image: view.starting.get(image, 0) + 1}
    return replace(view, starting=starting, memory_mb=view.memory_mb + memory_mb, containers=view.containers + 1)
