"""Another gateway with this one's id, met after both have joined: they began at one moment, or a cut has healed.

Who joins asks whether its name is free; that tells nothing of one that cannot be seen just then. Two of one name answer
the same questions and order writes of the same keys, so one of the two must go. Each hears what the other tells of
itself under their key and can tell it from its own by the process that tells it. Pure; time is passed in.
"""

from appliance.errors import ConfigError
from appliance.model import GatewayStatus

HEARD = 3
"""Statuses of another process before it counts: the last words of one that has just ended may still be on their way."""
HEARD_S = 3.0
"""The least time from the first of these to the last; a status comes every two seconds, whatever happens."""

_MOST = 8
"""Processes remembered: those heard of last."""

_Process = tuple[int, int]


def _process(status: GatewayStatus) -> _Process:
    """What tells a process from all others: when it began, to the nanosecond, and its number."""
    return status.started_ns, status.pid


class Namesake:
    """Finds out whether another process goes by this gateway's id, and which of the two has to go."""

    def __init__(self) -> None:
        self._others: dict[_Process, tuple[float, int]] = {}
        """Processes heard under this gateway's key -> when first, and how often."""
        self.goes = False
        """Whether there is one, and it is this process that goes: of the two the one that says it began later. That
        needs no right clocks, only that both decide alike."""

    def heard(self, status: GatewayStatus, own: GatewayStatus | None, now: float) -> bool:
        """Take in a status that was put under this gateway's key; returns whether another process puts them.

        Args:
            status: what was put.
            own: what this process has told of itself last; None: nothing yet.
            now: by the monotonic clock.
        """
        other = _process(status)
        if own is None or not own.started_ns or not status.started_ns or other == _process(own):
            return False
        since, count = self._others.pop(other, (now, 0))
        if len(self._others) >= _MOST:
            del self._others[next(iter(self._others))]
        self._others[other] = since, count + 1
        if count + 1 < HEARD or now - since < HEARD_S:
            return False
        self.goes = self.goes or _process(own) > other
        return True


def displaced(gateway: str) -> ConfigError:
    """Return what is wrong, for the one that goes."""
    return ConfigError(
        f"another gateway named {gateway} is in the fleet, and began before this one",
        remedy="give each gateway an id of its own",
    )
