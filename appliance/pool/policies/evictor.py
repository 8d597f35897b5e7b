"""The interface of eviction: what an idle container is worth."""

from collections.abc import Sequence
from typing import Protocol

from appliance.pool.policies.facts import Idle


class Evictor(Protocol):
    """Says what idle containers are worth; the planner gives up the one worth least.

    Worths are compared with each other only, within one call; they have no unit in common between policies.
    """

    def arrived(self, image: str, now: float) -> None:
        """Note that a run asked for this image here."""
        ...

    def worths(self, idle: Sequence[Idle], now: float) -> list[float]:
        """Return what each of these containers is worth, in their order; one without id is yet to be started."""
        ...

    def evicted(self, idle: Idle, now: float) -> None:
        """Note that it was given up for want of room."""
        ...
