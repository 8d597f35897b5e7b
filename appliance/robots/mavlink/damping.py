"""Storms of one message: found by its rate, let through in a trickle, reported once. Pure, the clock passed in.

Two programs that answer each other's answers never end, and each further one doubles what is sent: three vehicles that
took PARAM_VALUE for a question sent 45,000 a second. A gateway cannot tell such a message from one that is wanted, but
no message is wanted at such a rate, so what it passes on is cut until nearly nothing more comes.
"""

from collections import OrderedDict

from msgspec import Struct

BULK = frozenset(
    (
        "FILE_TRANSFER_PROTOCOL",
        "LOG_DATA",
        "REMOTE_LOG_DATA_BLOCK",
        "ENCAPSULATED_DATA",
        "TUNNEL",
        "SERIAL_CONTROL",
        "GPS_RTCM_DATA",
    )
)
"""Messages that carry files and streams as fast as the link does; the limit of all frames of an end holds for them."""
BURST_S = 4.0
"""So many seconds' worth may come at once: a list of 1,500 parameters does over a fast link."""
TRICKLE = 0.04
"""Share of the limit that a storm is cut to."""
WINDOW_S = 5.0
"""A storm is over when for so long less came than the trickle lets through."""
MAX_KINDS = 4096
"""Senders' messages that are followed; the longest silent is forgotten first."""

Kind = tuple[int, int, str]
"""System, component, message."""


class _Flow(Struct):
    level: float
    at: float
    damped: bool = False
    reported: bool = False
    since: float = 0.0
    came: int = 0


class Damper:
    """Damps storms of one link.

    Args:
        per_s: most frames a second of one message from one sender; 0 for no limit.
    """

    def __init__(self, per_s: float) -> None:
        self._per_s = per_s
        self._flows: OrderedDict[Kind, _Flow] = OrderedDict()
        self.damped: dict[Kind, None] = {}
        """What is being damped."""

    def passes(self, kind: Kind, now: float) -> bool:
        """Count a frame; whether it may go on."""
        if not self._per_s or kind[2] in BULK:
            return True
        flow = self._flows.get(kind)
        if flow is None:
            flow = self._flows[kind] = _Flow(self._per_s * BURST_S, now)
            while len(self._flows) > MAX_KINDS:
                gone, _ = self._flows.popitem(last=False)
                self.damped.pop(gone, None)
        else:
            self._flows.move_to_end(kind)
        if flow.damped:
            self._look(kind, flow, now)
        rate = self._per_s * (TRICKLE if flow.damped else 1.0)
        flow.level = min(rate * (1.0 if flow.damped else BURST_S), flow.level + (now - flow.at) * rate)
        flow.at = now
        flow.came += 1
        if flow.level >= 1.0:
            flow.level -= 1.0
            return True
        if not flow.damped:
            flow.damped, flow.since, flow.came = True, now, 0
            self.damped[kind] = None
        return False

    def _look(self, kind: Kind, flow: _Flow, now: float) -> None:
        """End the damping of what has become quiet."""
        passed = now - flow.since
        if passed < WINDOW_S:
            return
        if flow.came / passed < self._per_s * TRICKLE:
            flow.damped, flow.reported = False, False
            flow.level = self._per_s * BURST_S
            self.damped.pop(kind, None)
        flow.since, flow.came = now, 0

    def news(self, kind: Kind) -> bool:
        """Whether a storm is one that was not reported; notes that it is now."""
        flow = self._flows.get(kind)
        if flow is None or flow.reported:
            return False
        flow.reported = True
        return True

    def look(self, now: float) -> None:
        """End the damping of what has become silent altogether."""
        for kind in list(self.damped):
            flow = self._flows.get(kind)
            if flow is not None:
                self._look(kind, flow, now)
