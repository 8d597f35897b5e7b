"""Greedy-Dual-Size-Frequency: what is used often, dear to start and small stays; what was once popular ages away.

Cherkasova 1998; for containers Fuerst and Sharma, "FaasCache", ASPLOS 2021, section 4. The priority of an idle
container is clock + frequency * cold cost / memory, where clock is the priority of the last one given up, read
when the container was last used. A container of 256 MB that takes 500 ms to start and has served 4 runs since the
clock stood at 3 is worth 3 + 5 * 500 / 256 = 12.8.
"""

from collections.abc import Sequence

from appliance.pool.policies.facts import Idle


class GreedyDual:
    """The floor that every other eviction policy has to beat. State: one number a container."""

    def __init__(self) -> None:
        self._clock = 0.0
        self._marks: dict[str, tuple[float, float]] = {}

    def arrived(self, image: str, now: float) -> None:
        """Nothing: each container counts its own runs."""

    def worths(self, idle: Sequence[Idle], now: float) -> list[float]:
        """Return the priorities, milliseconds a megabyte."""
        del now
        marks: dict[str, tuple[float, float]] = {}
        for each in idle:
            mark = self._marks.get(each.id)
            # Used since it was last seen: the clock of its last use is the clock now, for it only moves at evictions.
            marks[each.id] = mark if mark is not None and mark[0] == each.since else (each.since, self._clock)
        self._marks = marks
        return [marks[each.id][1] + (each.runs + 1) * each.cold_ms / each.memory_mb for each in idle]

    def evicted(self, idle: Idle, now: float) -> None:
        """Set the clock to the priority of the one given up."""
        del now
        mark = self._marks.pop(idle.id, None)
        if mark is not None:
            self._clock = max(self._clock, mark[1] + (idle.runs + 1) * idle.cold_ms / idle.memory_mb)
