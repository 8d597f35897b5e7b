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

from msgspec.structs import replace

from appliance.model import PoolHint
from appliance.pool.policies.costs import ColdCosts
from appliance.pool.policies.evictor import Evictor
from appliance.pool.policies.facts import Idle, Retire, Start, View
from appliance.pool.policies.greedy_dual import GreedyDual
from appliance.pool.settings import PoolConfig


class Planner:
    """Prewarming, keeping and eviction of one gateway's containers.

    Args:
        settings: floor, idle_s, starts_at_once and the choice of policies.
        costs: what cold starts of each image cost here.
        size_mb: memory that a container of an image gets.
    """

    def __init__(self, settings: PoolConfig, costs: ColdCosts, size_mb: Callable[[str], int]) -> None:
        self._settings = settings
        self._costs = costs
        self._size_mb = size_mb
        self._evictor: Evictor = GreedyDual()

    # --- what happens ---------------------------------------------------------------------------------------

    def arrived(self, image: str, now: float) -> None:
        """Note that a run asked for a container of this image here, whether it found a warm one or not."""
        self._evictor.arrived(image, now)

    def ended(self, image: str, service_s: float, now: float) -> None:
        """Note that a run has ended here that had its container for `service_s`."""

    def hinted(self, hint: PoolHint, now: float) -> None:
        """Note what a plan will need."""

    def evicted(self, idle: Idle, now: float) -> None:
        """Note that a container was given up for want of room: to be told of each that `room` or `tend` named so."""
        self._evictor.evicted(idle, now)

    # --- what to do -----------------------------------------------------------------------------------------

    def room(self, view: View, memory_mb: int, now: float, *, for_run: bool) -> tuple[Retire, ...] | None:
        """Return whom to give up for one more container of `memory_mb`, worth least first; None: there is no room.

        Args:
            view: what there is.
            memory_mb: memory of the one to come.
            now: clock, seconds.
            for_run: a run waits for it, so floors need not be spared.
        """
        chosen = self._victims(
            view,
            slots=view.containers + 1 - view.capacity,
            memory_mb=view.memory_mb + memory_mb - view.budget_mb,
            spare=None if for_run else self._settings.floor,
            now=now,
        )
        if chosen is None:
            return None
        return tuple(Retire(id=each.id, why="its place is needed") for each in chosen)

    def tend(self, view: View, now: float) -> tuple[tuple[Start, ...], tuple[Retire, ...]]:
        """Return what to start ahead and what to give up, to be carried out together."""
        retired: dict[str, str] = {}
        ready = Counter(each.image for each in view.idle)
        coming = {image: ready[image] + view.starting.get(image, 0) for image in {*ready, *view.starting}}
        for each in sorted(view.idle, key=lambda each: each.since):
            old = now - each.since > self._settings.idle_s
            if old and coming[each.image] > self._settings.floor.get(each.image, 0):
                coming[each.image] -= 1
                retired[each.id] = "idle for long"
        view = without(view, retired)
        starts: list[Start] = []
        places = self._settings.starts_at_once - sum(view.starting.values())
        for image in missing(self._settings.floor, coming):
            if len(starts) >= places:
                break
            size_mb = self._size_mb(image)
            if image in view.blocked or (victims := self.room(view, size_mb, now, for_run=False)) is None:
                continue
            starts.append(Start(image=image, why="floor"))
            retired |= {each.id: each.why for each in victims}
            view = with_start(without(view, retired), image, size_mb)
        return tuple(starts), tuple(Retire(id=key, why=why) for key, why in retired.items())

    def _victims(
        self, view: View, *, slots: int, memory_mb: int, spare: Mapping[str, int] | None, now: float
    ) -> tuple[Idle, ...] | None:
        if slots <= 0 and memory_mb <= 0:
            return ()
        return victims(
            view.idle, self._evictor.worths(view.idle, now), slots=slots, memory_mb=memory_mb, spare=spare or {}
        )


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
