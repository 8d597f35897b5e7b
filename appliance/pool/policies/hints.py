"""Plan hints: the plan says which image its next steps need and when, so the container is there by then."""

from collections.abc import Iterable

from msgspec import Struct
from msgspec.structs import replace

from appliance.model import PoolHint
from appliance.pool.policies.forecaster import Level, Surety

MAX_HINTS = 256
OPERATOR = "operator"
"""The `task` of an operator's wish: containers are to be ready, whatever runs come."""
EARLY_S = 10.0
"""A run of the image counts as the announced one when it comes at most so much before its time."""


class _Hint(Struct, frozen=True):
    count: int
    at: float
    until: float


class PlanHints:
    """What plans have announced. A hint of the same task and image replaces the earlier one."""

    surety = Surety.CERTAIN

    def __init__(self) -> None:
        self._hints: dict[tuple[str, str], _Hint] = {}

    def hinted(self, hint: PoolHint, now: float) -> None:
        """Note a hint; the oldest of too many is dropped."""
        key = (hint.image, hint.task)
        self._hints.pop(key, None)
        at = now + max(0.0, hint.in_s)
        if hint.count > 0 and hint.keep_s > 0:
            self._hints[key] = _Hint(hint.count, at, at + hint.keep_s)
        if len(self._hints) > MAX_HINTS:
            del self._hints[next(iter(self._hints))]

    def arrived(self, image: str, now: float) -> None:
        """Note a run: of a plan's announced needs that are due, the earliest is met."""
        due = [
            (hint.at, key)
            for key, hint in self._hints.items()
            if key[0] == image and key[1] != OPERATOR and hint.at - EARLY_S <= now
        ]
        if not due:
            return
        _, key = min(due)
        hint = self._hints[key]
        if hint.count > 1:
            self._hints[key] = replace(hint, count=hint.count - 1)
        else:
            del self._hints[key]

    def images(self, now: float) -> Iterable[str]:
        """Return the images that somebody has announced a need of."""
        for key in [key for key, hint in self._hints.items() if hint.until <= now]:
            del self._hints[key]
        return {image for image, _ in self._hints}

    def wants(self, level: Level, now: float) -> str | None:
        """Want as many idle ones as are announced for the time until a new one could be ready."""
        if not self._hints:
            return None
        due = sum(
            hint.count
            for key, hint in self._hints.items()
            if key[0] == level.image and hint.at - level.ahead_s <= now < hint.until
        )
        return "a plan or an operator will need it" if level.number <= level.busy + due else None

    def next_s(self, image: str, now: float) -> float | None:
        """Return in how many seconds the next announced need of this image is; None: none is."""
        if not self._hints:
            return None
        times = [max(0.0, hint.at - now) for key, hint in self._hints.items() if key[0] == image and hint.until > now]
        return min(times, default=None)
