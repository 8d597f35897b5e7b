"""What a cold start of an image costs on this gateway."""

from collections import deque


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
