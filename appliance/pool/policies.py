"""What to keep, what to give up and what to start, as plain functions of facts.

Eviction is Greedy-Dual-Size-Frequency (Cherkasova 1998, as FaasCache uses it for containers): the priority of an
idle container is clock + frequency * cold cost / memory, clock being the priority of the last one given up. So
what is used often, dear to start and small stays, and what was once popular ages away.
"""

from collections import Counter, deque
from collections.abc import Mapping, Sequence

from msgspec import Struct


class Idle(Struct, frozen=True, kw_only=True):
    """An idle container, as eviction sees it. `clock` is the pool's clock when it was last used."""

    id: str
    image: str
    memory_mb: int
    runs: int
    cold_ms: float
    clock: float


def priority(container: Idle) -> float:
    """Return clock + frequency * cold cost / memory; the least is given up first. ms per MB."""
    return container.clock + (container.runs + 1) * container.cold_ms / container.memory_mb


def victims(
    idle: Sequence[Idle], *, slots: int, memory_mb: int, floor: Mapping[str, int], spare_floor: bool
) -> tuple[Idle, ...] | None:
    """Return whom to give up to free `slots` places and `memory_mb`, least valuable first; None when it is not enough.

    Args:
        idle: containers that may be given up.
        slots: places needed.
        memory_mb: memory needed.
        floor: containers of each image to keep ready.
        spare_floor: leave as many of each image as its floor says (a prewarm must not eat another's floor; a
            subtask that waits may).
    """
    if slots <= 0 and memory_mb <= 0:
        return ()
    left = Counter(each.image for each in idle)
    chosen: list[Idle] = []
    for each in sorted(idle, key=lambda each: (priority(each), each.id)):
        if spare_floor and left[each.image] <= floor.get(each.image, 0):
            continue
        left[each.image] -= 1
        chosen.append(each)
        slots -= 1
        memory_mb -= each.memory_mb
        if slots <= 0 and memory_mb <= 0:
            return tuple(chosen)
    return None


def wanted(floor: Mapping[str, int], coming: Mapping[str, int]) -> tuple[str, ...]:
    """Return the images to start containers of, one entry a container, the most wanting first.

    Args:
        floor: containers of each image to keep ready.
        coming: containers of each image that are ready or starting.
    """
    missing = {image: count - coming.get(image, 0) for image, count in floor.items()}
    order: list[str] = []
    for depth in range(max(missing.values(), default=0)):
        order += [image for image in sorted(missing) if missing[image] > depth]
    return tuple(sorted(order, key=lambda image: coming.get(image, 0)))


class ColdCosts:
    """ColdCost(T): the moving 75th percentile of this gateway's own cold starts of each image, milliseconds."""

    def __init__(self, initial_ms: float, *, window: int = 16) -> None:
        self._initial_ms = initial_ms
        self._window = window
        self._seen: dict[str, deque[float]] = {}

    def add(self, image: str, took_ms: float) -> None:
        """Note a cold start."""
        self._seen.setdefault(image, deque(maxlen=self._window)).append(took_ms)

    def of(self, image: str) -> float:
        """Return what a cold start of this image is expected to cost."""
        seen = sorted(self._seen.get(image, ()))
        return seen[(3 * len(seen)) // 4] if seen else self._initial_ms


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
