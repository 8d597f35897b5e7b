"""Publishes what runs on this gateway tell: numbered, stamped, and with the time of their last sign of life."""

import time
from collections import OrderedDict
from collections.abc import Callable

from msgspec.structs import replace

from appliance.model import RunEvent, RunEventKind, encode
from appliance.plane.node import Plane

MOST_RUNS = 4000
"""Runs whose numbers are remembered: more than a gateway keeps of ended ones."""


class Telling:
    """The voice of one gateway's runs. `on_told` hears all that is published."""

    def __init__(self, plane: Plane) -> None:
        self._plane = plane
        self._numbers: OrderedDict[tuple[str, str, int], int] = OrderedDict()
        self._heard: dict[tuple[str, str, int], float] = {}
        self.on_told: Callable[[RunEvent], None] = lambda _: None

    def tell(self, event: RunEvent) -> None:
        """Publish an event."""
        run = (event.task, event.subtask, event.attempt)
        # A mere sign of life is no line of anybody's stream: it takes no number, so that none seems to be missing.
        number = self._numbers.get(run, 0) + (event.kind is not RunEventKind.ALIVE)
        self._numbers[run] = number
        self._numbers.move_to_end(run)
        self._heard[run] = time.monotonic()
        while len(self._numbers) > MOST_RUNS:
            self._heard.pop(self._numbers.popitem(last=False)[0], None)
        event = replace(event, number=number, at_ns=time.time_ns())
        self._plane.session.put(self._plane.keys.run(event.task, event.subtask), encode(event), express=True)
        self.on_told(event)

    def silent_s(self, task: str, subtask: str, attempt: int) -> float | None:
        """Return the seconds since a run's last sign of life; None when nothing was told of it."""
        heard = self._heard.get((task, subtask, attempt))
        return None if heard is None else time.monotonic() - heard
