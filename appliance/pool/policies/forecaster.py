"""The interface of prewarming: whether the n-th container of an image is wanted by the time one could be ready."""

from collections.abc import Iterable
from typing import Protocol

from msgspec import Struct


class Level(Struct, frozen=True):
    """The n-th container of an image."""

    image: str
    number: int
    """1 is the first."""
    busy: int
    """Containers of the image that have a run: those are the levels 1 to `busy`."""
    ahead_s: float
    """How long a new one takes to be ready, with a margin, seconds."""


class Forecaster(Protocol):
    """Forecasters are asked in turn, the surest first; the first with an opinion counts."""

    def images(self, now: float) -> Iterable[str]:
        """Return the images it may want containers of."""
        ...

    def wants(self, level: Level, now: float) -> str | None:
        """Return why it is wanted, empty when it is not, None without an opinion."""
        ...
