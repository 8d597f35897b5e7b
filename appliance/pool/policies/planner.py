"""Decides which containers a gateway starts ahead and which it gives up. Plain code: the clock is passed in.

The keeper of the pool and the simulator use the same planner: they tell it what happens (`arrived`, `ended`,
`hinted`, `evicted`), show it what there is (`View`), and carry out what it answers (`Start`, `Retire`).

Guarantees, each a property test:
    - What `room` and `tend` order never leaves more containers or memory than the view allows, unless busy ones
      alone take more.
    - An image never falls below its floor, except for a run that waits or when the budget itself has shrunk.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence

from msgspec import Struct
from msgspec.structs import replace

from appliance.model import PoolHint
from appliance.pool.policies.costs import ColdCosts
from appliance.pool.policies.demand import Demand
from appliance.pool.policies.evictor import Evictor
from appliance.pool.policies.facts import Idle, Retire, Start, View
from appliance.pool.policies.forecaster import Forecaster, Level
from appliance.pool.policies.greedy_dual import GreedyDual
from appliance.pool.policies.hints import PlanHints
from appliance.pool.policies.histogram import Histogram
from appliance.pool.policies.keeping import KeepFixed, KeepHistogram, Keeping
from appliance.pool.policies.learned import Learned, LearnedState
from appliance.pool.policies.least_recent import LeastRecent
from appliance.pool.policies.rate import Rate
from appliance.pool.settings import PoolConfig

AHEAD = 1.5
"""A start is ordered so many times its usual duration ahead …"""
AHEAD_S = 0.5
"""… and this much, for the pool is gone through twice a second."""
LEAST_STAY_S = 5.0
"""A container that was started ahead stays for at least so long: a forecast may waver."""


class PlannerState(Struct, frozen=True, kw_only=True):
    """What the policies have learned, to survive a restart."""

    learned: LearnedState | None = None


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
        histogram = Histogram(self._demand)
        rate = Rate(self._demand, hit_target=settings.hit_target, horizon_s=settings.idle_s)
        known: dict[str, Forecaster] = {"hints": self._hints, "histogram": histogram, "rate": rate}
        self._forecasters = [each for name, each in known.items() if name in settings.prewarm]
        fixed = KeepFixed(settings.idle_s)
        self._keeping: Keeping = KeepHistogram(histogram, fixed) if settings.keep == "histogram" else fixed
        self._learned = Learned(self._demand, next_hint_s=self._hints.next_s, hour=hour)
        policies: dict[str, Evictor] = {
            "greedy-dual": GreedyDual(),
            "lru": LeastRecent(),
            "learned": self._learned,
        }
        self._evictor = evictor or policies[settings.eviction]

    # --- what happens ---------------------------------------------------------------------------------------

    def arrived(self, image: str, now: float) -> None:
        """Note that a run begins here, or waits for a container here, whether it found a warm one or not."""
        self._demand.arrived(image, now)
        self._hints.arrived(image, now)
        self._evictor.arrived(image, now)

    def ended(self, image: str, service_s: float, now: float) -> None:
        """Note that a run that had arrived is over, having had its container for `service_s` (0: it had none)."""
        self._demand.ended(image, service_s, now)

    def hinted(self, hint: PoolHint, now: float) -> None:
        """Note what a plan, or an operator, will need."""
        self._hints.hinted(hint, now)

    def evicted(self, idle: Idle, now: float) -> None:
        """Note that a container that `room` named was given up. What `tend` orders is noted already."""
        self._evictor.evicted(idle, now)

    def state(self) -> PlannerState:
        """Return what was learned, to be kept."""
        return PlannerState(learned=self._learned.state())

    def restore(self, state: PlannerState) -> None:
        """Go on from what was learned before."""
        if state.learned is not None:
            self._learned.restore(state.learned)

    # --- what to do -----------------------------------------------------------------------------------------

    def room(self, view: View, memory_mb: int, now: float, *, for_run: bool) -> tuple[Retire, ...] | None:
        """Return whom to give up for one more container of `memory_mb`, worth least first; None: there is no room.

        Args:
            view: what there is.
            memory_mb: memory of the one to come.
            now: clock, seconds.
            for_run: a run waits for it, so neither floors nor forecasts need be spared.
        """
        spare = {} if for_run else self._spared(view, now)
        return self._room(view, memory_mb, now, spare)

    def tend(self, view: View, now: float) -> tuple[tuple[Start, ...], tuple[Retire, ...]]:
        """Return what to start ahead and what to give up, to be carried out together, retirements first."""
        wanted = self._wanted(view, now)
        retired = self._overdue(view, {image: count for image, (count, _) in wanted.items()}, now)
        view = without(view, retired)
        for each in self._beyond_budget(view, now):
            retired[each.id] = "the budget has shrunk"
            self._evictor.evicted(each, now)
        view = without(view, retired)
        ready = Counter(each.image for each in view.idle)
        coming = {image: ready[image] + view.starting.get(image, 0) for image in wanted}
        spare = {image: count for image, (count, _) in wanted.items()}
        starts: list[Start] = []
        places = self._settings.starts_at_once - sum(view.starting.values())
        for image in missing(spare, coming):
            if len(starts) >= places:
                break
            size_mb = self._size_mb(image)
            if image in view.blocked or (victims := self._room(view, size_mb, now, spare)) is None:
                continue
            starts.append(Start(image=image, why=wanted[image][1]))
            gone = {each.id: each.why for each in victims}
            for each in view.idle:
                if each.id in gone:
                    self._evictor.evicted(each, now)
            retired |= gone
            view = with_start(without(view, retired), image, size_mb)
        return tuple(starts), tuple(Retire(id=key, why=why) for key, why in retired.items())

    def _wanted(self, view: View, now: float) -> dict[str, tuple[int, str]]:
        """Return how many idle or starting containers of each image are wanted, and why the last of them is."""
        images = {*self._settings.floor}
        for forecaster in self._forecasters:
            images.update(forecaster.images(now))
        wanted: dict[str, tuple[int, str]] = {}
        for image in images:
            floor = self._settings.floor.get(image, 0)
            busy = view.busy.get(image, 0)
            ahead_s = self._ahead_s(image)
            count, reason = 0, ""
            while count < view.capacity:
                why = self._wants(Level(image, busy + count + 1, busy, ahead_s), now)
                if not why:
                    break
                count, reason = count + 1, why
            if count > floor:
                wanted[image] = (count, reason)
            elif floor:
                wanted[image] = (floor, "floor")
        return wanted

    def _wants(self, level: Level, now: float) -> str:
        for forecaster in self._forecasters:
            why = forecaster.wants(level, now)
            if why is not None:
                return why
        return ""

    def _ahead_s(self, image: str) -> float:
        return AHEAD * self._costs.of(image) / 1e3 + AHEAD_S

    def _spared(self, view: View, now: float) -> dict[str, int]:
        return {image: count for image, (count, _) in self._wanted(view, now).items()}

    def _overdue(self, view: View, wanted: Mapping[str, int], now: float) -> dict[str, str]:
        """Return who has been kept for long enough: of each image those used last are the last to go."""
        by_image: dict[str, list[Idle]] = {}
        for each in view.idle:
            by_image.setdefault(each.image, []).append(each)
        overdue: dict[str, str] = {}
        for image, idle in by_image.items():
            busy = view.busy.get(image, 0)
            spare = max(0, wanted.get(image, 0) - view.starting.get(image, 0))
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

    def _room(self, view: View, memory_mb: int, now: float, spare: Mapping[str, int]) -> tuple[Retire, ...] | None:
        slots = view.containers + 1 - view.capacity
        needed_mb = view.memory_mb + memory_mb - view.budget_mb
        if slots <= 0 and needed_mb <= 0:
            return ()
        worths = self._evictor.worths(view.idle, now)
        chosen = victims(view.idle, worths, slots=slots, memory_mb=needed_mb, spare=spare)
        return None if chosen is None else tuple(Retire(id=each.id, why="its place is needed") for each in chosen)


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
