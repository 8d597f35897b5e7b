"""What a cold start of an image costs on this gateway."""

from collections import deque
from collections.abc import Mapping


class ColdCosts:
    """ColdCost(T): the moving 75th percentile of this gateway's own cold starts of each image, milliseconds."""

    def __init__(self, initial_ms: float, *, window: int = 16) -> None:
        self._initial_ms = initial_ms
        self._window = window
        self._seen: dict[str, deque[float]] = {}
        self._costs: dict[str, float] = {}
        self._usual_ms = initial_ms

    def add(self, image: str, took_ms: float) -> None:
        """Note a cold start."""
        seen = self._seen.setdefault(image, deque(maxlen=self._window))
        seen.append(took_ms)
        self._costs[image] = sorted(seen)[(3 * len(seen)) // 4]
        self._usual_ms = sum(self._costs.values()) / len(self._costs)

    def of(self, image: str) -> float:
        """Return what a cold start of this image is expected to cost."""
        return self._costs.get(image, self._initial_ms)

    def usual_ms(self) -> float:
        """Return the mean over the images that were started here; the initial guess before any was."""
        return self._usual_ms

    def state(self) -> dict[str, tuple[float, ...]]:
        """Return what was measured, to be kept."""
        return {image: tuple(seen) for image, seen in self._seen.items()}

    def restore(self, state: Mapping[str, tuple[float, ...]]) -> None:
        """Go on from what was measured before."""
        for image, seen in state.items():
            for took_ms in seen:
                self.add(image, took_ms)
