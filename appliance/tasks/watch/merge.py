"""Puts the lines of several gateways into one order, with bounds; pure, the clock passed in.

Gateways' clocks may differ by an hour, so times are first brought to the reader's clock by what each gateway's clock
showed when it was asked (Cristian's method: half the round trip is the error). A line is held back for a moment so that
one that was said earlier elsewhere, and comes later, stands before it. Within a source, lines keep their numbers' order
and a number that is missing is counted. What would not fit is dropped, log lines first, and counted as well.
"""

import heapq
from collections import Counter
from collections.abc import Mapping

from msgspec.structs import replace

from appliance.tasks.watch.lines import Line, LineKind

HOLD_S = 0.3
"""Twice what a line usually takes through a loaded gateway; longer would only delay what people see."""
MOST_HELD = 5000
"""Lines held back at once; beyond it the least important are dropped."""
MOST_KNOWN = 50_000
"""Lines that are remembered so that none is shown twice: those kept by gateways come a second time."""
_LEAST = (LineKind.LOG, LineKind.GATEWAY, LineKind.PARTIAL, LineKind.PROGRESS)


class Merge:
    """One reader's stream of one task. Times are seconds of the reader's monotonic clock."""

    def __init__(self, *, hold_s: float = HOLD_S, most: int = MOST_HELD) -> None:
        self._hold_s = hold_s
        self._most = most
        self._offsets: dict[str, int] = {}
        self._heap: list[tuple[int, int, float, Line]] = []
        self._known: dict[tuple[str, str, int, int], None] = {}
        self._count = 0
        self._last_at: dict[tuple[str, str], int] = {}
        self._numbers: dict[tuple[str, str], int] = {}
        self._told: dict[tuple[str, str], int] = {}
        self._dropped: Counter[str] = Counter()

    def set_clock(self, gateway: str, *, theirs_ns: int, ours_ns: int) -> None:
        """Note what a gateway's clock showed when ours showed that."""
        self._offsets[gateway] = ours_ns - theirs_ns

    @property
    def clocks(self) -> frozenset[str]:
        """The gateways whose clocks are known."""
        return frozenset(self._offsets)

    @property
    def dropped(self) -> Mapping[str, int]:
        """Lines dropped since they were last told, by gateway; those of no one in particular under ""."""
        return self._dropped

    def missed(self, count: int, gateway: str = "") -> None:
        """Count lines that never came here."""
        if count > 0:
            self._dropped[gateway] += count

    def add(self, line: Line, now_s: float, *, from_ns: int = 0) -> None:
        """Take a line in, unless it was said before `from_ns` (the reader's clock)."""
        if line.key in self._known:
            return
        self._known[line.key] = None
        while len(self._known) > MOST_KNOWN:
            del self._known[next(iter(self._known))]
        source = (line.gateway, line.source)
        at_ns = line.at_ns + self._offsets.get(line.gateway, 0)
        if at_ns < from_ns:
            return
        # A clock that is set back must not turn a source's own order around.
        last = self._numbers.get(source, 0)
        if line.number > last:
            at_ns = max(at_ns, self._last_at.get(source, at_ns))
            self._last_at[source] = at_ns
            self._numbers[source] = line.number
        self._count += 1
        heapq.heappush(self._heap, (at_ns, self._count, now_s, replace(line, at_ns=at_ns)))
        if len(self._heap) > self._most:
            self._drop()

    def _drop(self) -> None:
        """Drop the oldest of the least important line held; of none such, the oldest of all."""
        least = [each for each in self._heap if each[3].kind in _LEAST]
        gone = min(least or self._heap)
        self._heap.remove(gone)
        heapq.heapify(self._heap)
        if not gone[3].counted:
            self._dropped[gone[3].gateway] += 1  # else the gap in its source's numbers says so

    def due(self, now_s: float, *, all_of_it: bool = False) -> list[Line]:
        """Return the lines that need not be held back any longer, in order; those before a line that is due are too."""
        due_at = [entry[0] for entry in self._heap if all_of_it or now_s - entry[2] >= self._hold_s]
        if not due_at:
            return []
        until = max(due_at)
        found: list[Line] = []
        while self._heap and self._heap[0][0] <= until:
            line = heapq.heappop(self._heap)[3]
            self._count_gap(line)
            if self._dropped:
                found.extend(self._drops(line))
            found.append(line)
        return found

    def _count_gap(self, line: Line) -> None:
        """Count the lines of its source that should have come before a line and did not."""
        source = (line.gateway, line.source)
        last = self._told.get(source, 0)
        if line.counted and line.number:
            if last and line.number > last + 1:
                self._dropped[line.gateway] += line.number - last - 1
            self._told[source] = max(last, line.number)

    def _drops(self, before: Line) -> list[Line]:
        """Lines that say what is missing, to stand before a line."""
        told = [
            Line(
                kind=LineKind.DROPPED,
                task=before.task,
                at_ns=before.at_ns,
                gateway=gateway,
                level="warning",
                text=f"{count} lines are missing here",
                fields={"count": count},
                source="reader",
            )
            for gateway, count in sorted(self._dropped.items())
        ]
        self._dropped.clear()
        return told

    def wait_s(self, now_s: float) -> float | None:
        """Seconds until the next line is due; None when none is held."""
        if not self._heap:
            return None
        return max(0.0, min(entry[2] for entry in self._heap) + self._hold_s - now_s)
