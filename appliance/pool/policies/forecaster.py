"""The interface of prewarming: whether the n-th container of an image is wanted by the time one could be ready."""

import enum
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


class Surety(enum.IntEnum):
    """How sure a forecast is, so what may be given up for it."""

    SPARE_ROOM = 0
    """Only started where there is room."""
    LESS_WORTH = 1
    """Takes the place of what is worth less."""
    CERTAIN = 2
    """Takes the place of whatever is not as certain; is spared by all but waiting runs."""


class Forecaster(Protocol):
    """Forecasters are asked in turn, the surest first; the first with an opinion counts."""

    surety: Surety
    """What a container it wants may do to those that are there."""

    def images(self, now: float) -> Iterable[str]:
        """Return the images it may want containers of."""
        ...

    def wants(self, level: Level, now: float) -> str | None:
        """Return why it is wanted, empty when it is not, None without an opinion."""
        ...
