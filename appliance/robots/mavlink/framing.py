"""Where frames begin and end in a stream of bytes, damage and foreign frames in it included.

Every decision belongs to one byte: it is made when that byte has come, by the bytes up to it alone. So any cut of a
stream gives the same frames and the same counters. Four rules:

- In step, a marker where a frame is due is believed: its frame is waited for, and nothing within is looked at, since
  payloads may carry whole frames (TUNNEL, files). One that announces more than its message can hold, or flags that
  nobody knows, is believed only as long as no good frame is found within.
- A whole frame that is damaged or foreign is counted at once. Its end is where the next one is due, as for MAVLink's C
  parser and pymavlink: a good frame there settles it, whatever its body looked like.
- That end was false where no frame begins there, or where a good frame lies across it. Then its bytes are searched.
- Out of step, a marker begins a frame only where message, length and flags may be those of one that could be found
  good; every other is passed over. What such a frame carries is not looked at before it has proved to be none.
"""

from collections.abc import Callable, Iterator

from appliance.robots.mavlink.frames import (
    HEADER_V1,
    HEADER_V2,
    MARKER_V1,
    MARKER_V2,
    Damage,
    Frame,
    check,
    frame_length,
    next_marker,
)
from appliance.robots.mavlink.kinds import KINDS
from appliance.robots.mavlink.signing import SIGNED_FLAG

LONGEST = 280
"""Bytes of the longest frame."""


class Reader:
    """Frames out of one stream. `unproven` returns why a frame whose checksum is right is not believed, or nothing."""

    def __init__(self, unproven: Callable[[Frame], str]) -> None:
        self._unproven = unproven
        self._data = b""
        self._at = 0
        """Before it everything is decided."""
        self._ends: list[int] = []
        """Ends of the damaged frames from `_at` on, one behind the other."""
        self._lost = False
        self._from = 0
        """While lost: where the search goes on."""
        self._kind = ""
        self._quiet = 0
        """Bytes up to here belong to damage that was counted; what is lost beyond them is counted as noise."""
        self._base = 0
        self._checked: dict[int, bool] = {}
        """Whether a frame is good, by its place in the stream."""

    @property
    def pending(self) -> int:
        """Bytes that are not decided yet: of two damaged frames and one that has begun, at most."""
        return len(self._data) - self._at

    def feed(self, data: bytes, *, end: bool = False) -> Iterator[Frame | Damage]:
        """Yield what these bytes decide; never raises. `end`: no more will come, so that nothing stays undecided."""
        gone, self._at = self._at, 0
        self._data = self._data[gone:] + data
        self._base += gone
        self._from -= gone
        self._quiet -= gone
        self._ends = [each - gone for each in self._ends]
        while self._at < len(self._data):
            if self._lost:
                found = self._search(end=end)
            elif self._ends:
                found = self._step(end=end)
            else:
                yield from self._frames()
                found = self._step(end=end) if self._at < len(self._data) else ()
            if found is None:
                return
            yield from found

    def _frames(self) -> Iterator[Frame | Damage]:
        """Yield good frames as long as they come one behind the other."""
        data, at = self._data, self._at
        self._checked.clear()
        while at < len(data) and data[at] in (MARKER_V2, MARKER_V1):
            length = frame_length(data, at)
            if length is None or at + length > len(data):
                return
            found = check(data[at : at + length])
            if isinstance(found, Damage) or data[at + 1] > KINDS[found.number].size:
                return
            at = self._at = at + length
            yield self._judged(found)

    def _judged(self, frame: Frame) -> Frame | Damage:
        problem = self._unproven(frame)
        return Damage(problem, len(frame.raw)) if problem else frame

    # --- in step -----------------------------------------------------------------------------------------------

    def _step(self, *, end: bool) -> tuple[Frame | Damage, ...] | None:
        """Decide the next byte that decides anything; None when it has not come."""
        data, at = self._data, self._at
        here = self._ends[-1] if self._ends else at
        whole = self._whole(here)
        refuted, inside = self._refuted(here, whole)
        if refuted is not None and (whole is None or refuted < whole):
            # The byte that shows a third frame to follow ends the doubt about the first of two damaged ones.
            if len(self._ends) > 1 and refuted > here and self._marks(here):
                return self._trim()
            first = ()
            if inside:
                flags = data[here] == MARKER_V2 and data[here + 2] & ~SIGNED_FLAG
                first = self._report("incompatible" if flags else "truncated", here)
            elif not self._ends:
                first = self._report("noise", here)
            self._lose()
            return first
        if len(self._ends) > 1 and self._marks(here):
            return self._trim()
        if whole is not None:
            found = check(data[here:whole])
            if isinstance(found, Damage):
                self._ends.append(whole)
                return self._report(found.kind, whole)
            gone = self._gone(here)
            self._at, self._ends = whole, []
            return (*gone, self._judged(found))
        if not end:
            return None
        if here == len(data):
            self._ends = []
            return self._gone(here)
        first = self._report("truncated", here)
        self._lose()
        return first

    def _whole(self, here: int) -> int | None:
        """Return where the frame that is due here ends, None where none is or it is not whole."""
        if not self._marks(here):
            return None
        length = frame_length(self._data, here)
        return None if length is None or here + length > len(self._data) else here + length

    def _refuted(self, here: int, whole: int | None) -> tuple[int | None, bool]:
        """Return how many bytes tell that no frame is due here, and whether one within what is announced does."""
        data = self._data
        first: int | None = None
        if here < len(data) and not self._marks(here):
            first = here + 1
        # A good frame across the end of a damaged one, or just up to it, was swallowed by a false length.
        start = next_marker(data, self._at + 1) if self._ends else here
        while start < here:
            stop = self._good(start)
            if stop is not None and stop >= here and (first is None or stop < first):
                first = stop
            start = next_marker(data, start + 1)
        inside = False
        seen = self._doubtful(here)
        if seen is not None:
            start = next_marker(data, here + 1)
            while start < min(whole or len(data), first or len(data)):
                stop = self._good(start)
                if stop is not None and (first is None or max(stop, seen) < first):
                    first, inside = max(stop, seen), True
                start = next_marker(data, start + 1)
        return first, inside

    def _doubtful(self, here: int, *, known: bool = False) -> int | None:
        """Return by which byte a header here is seen to announce what cannot be; None when it is not seen to.

        With `known` messages that nobody here knows cannot be either.
        """
        data = self._data
        there = len(data) - here
        if not self._marks(here) or there < 3:
            return None
        if data[here] == MARKER_V1:
            size, number = HEADER_V1, data[here + 5] if there >= HEADER_V1 else -1
        elif data[here + 2] & ~SIGNED_FLAG:
            return here + 3
        else:
            size = HEADER_V2
            number = data[here + 7] | data[here + 8] << 8 | data[here + 9] << 16 if there >= HEADER_V2 else -1
        if number < 0:
            return None
        kind = KINDS.get(number)
        wrong = known if kind is None else data[here + 1] > kind.size
        return here + size if wrong else None

    def _trim(self) -> tuple[Damage, ...]:
        gone = self._gone(self._ends[-2])
        self._ends = self._ends[-1:]
        return gone

    def _report(self, kind: str, upto: int) -> tuple[Damage, ...]:
        self._kind, self._quiet = kind, upto + LONGEST
        return (Damage(kind, 0),)

    def _gone(self, to: int) -> tuple[Damage, ...]:
        """Give up the bytes up to there, which were counted; what goes on for longer than a frame is, again."""
        length, self._at = to - self._at, to
        found = [Damage(self._kind, length, counted=False)] if length else []
        while to > self._quiet:
            found += self._report("noise", self._quiet)
        return tuple(found)

    def _marks(self, at: int) -> bool:
        return at < len(self._data) and self._data[at] in (MARKER_V2, MARKER_V1)

    # --- out of step -------------------------------------------------------------------------------------------

    def _lose(self) -> None:
        self._lost, self._from, self._ends = True, self._at + 1, []

    def _search(self, *, end: bool) -> tuple[Frame | Damage, ...] | None:
        """Find the next good frame; None when it has not come."""
        data = self._data
        start = next_marker(data, self._from)
        while start < len(data):
            length = frame_length(data, start)
            whole = length is not None and start + length <= len(data)
            if self._doubtful(start, known=True) is None and (whole or not end):
                if not whole:
                    break
                # Good or damaged, what is due behind it decides, as in step. It belongs to damage that was counted.
                gone = self._gone(start)
                self._lost = False
                if length is not None and self._good(start) is None:
                    self._ends = [start + length]
                return gone or ()
            start = next_marker(data, start + 1)
        self._from = start
        gone = self._gone(start)
        return gone if gone or end else None

    def _good(self, start: int) -> int | None:
        """Return where the frame that begins there ends; None when it is not whole, or not good."""
        data = self._data
        length = frame_length(data, start)
        if length is None or start + length > len(data):
            return None
        stop = start + length
        good = self._checked.get(self._base + start)
        if good is None:
            good = self._checked[self._base + start] = isinstance(check(data[start:stop]), Frame)
            if len(self._checked) > 8 * LONGEST:
                self._checked = {place: each for place, each in self._checked.items() if place >= self._base + self._at}
        return stop if good else None
