"""What is decided on and not committed yet: whether the next decision on a record can be made before the disk is asked.

An owner's decision needs the record's state as all earlier decisions leave it. Those that were made when they were
queued are known (`decided`); those that are made only when their turn comes are not, and hold up the others on their
key. Pure; whoever calls holds the lock under which calls are queued.
"""

from collections.abc import Callable
from typing import NamedTuple

from appliance.plane.versions import Record

Look = Callable[[str], tuple[bool, Record | None]]


class Mark(NamedTuple):
    """What a queued call is to do to records; neither: nothing."""

    touches: str | None = None
    """Key of a record whose new state is decided only when the call runs; "" when it may be any record's."""
    decided: Record | None = None
    """The record that was decided on before the call was queued."""


NOTHING = Mark()


class Known(NamedTuple):
    """A record as the next decision finds it, and whether that is still on its way to the disk."""

    record: Record | None
    on_its_way: bool


class Ahead:
    """The marks of the calls that are queued or run. `look` tells what is committed, where that is in memory."""

    def __init__(self) -> None:
        self._decided: dict[str, Record] = {}
        self._undecided: dict[str, int] = {}

    def known(self, key: str, look: Look) -> Known | None:
        """The record as it stands after all that is queued; None where that is not known."""
        if key in self._undecided or "" in self._undecided:
            return None
        if (record := self._decided.get(key)) is not None:
            return Known(record, on_its_way=True)
        known, record = look(key)
        return Known(record, on_its_way=False) if known else None

    def queued(self, mark: Mark) -> None:
        """A call was queued."""
        if mark.touches is not None:
            self._undecided[mark.touches] = self._undecided.get(mark.touches, 0) + 1
        if mark.decided is not None:
            self._decided[mark.decided.key] = mark.decided

    def settled(self, mark: Mark) -> None:
        """It is committed and `look` shows what it did, or it has failed: it stands in no decision's way any more."""
        if mark.touches is not None:
            if self._undecided[mark.touches] == 1:
                del self._undecided[mark.touches]
            else:
                self._undecided[mark.touches] -= 1
        # A later decision on the same key has taken its place.
        if mark.decided is not None and self._decided.get(mark.decided.key) is mark.decided:
            del self._decided[mark.decided.key]
