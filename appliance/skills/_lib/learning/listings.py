"""What a data set holds: its items, what of it is damaged, and what a client refuses to train on.

A listing is made of names, lists and file headers alone, so it takes a moment and needs no decoder; what only decoding
shows (a file that ends early) is added by `loading`. More than `MOST_DAMAGED` of the files damaged means that something
is wrong with the whole folder: then nothing is trained, and the list of them is the reason.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

MOST_DAMAGED = 0.05
SHOWN = 20
"""Damaged files that a message names."""


class DataError(ValueError):
    """A data set cannot be used; `remedy` says what to do about it."""

    def __init__(self, message: str, remedy: str = "") -> None:
        super().__init__(message)
        self.message, self.remedy = message, remedy


class Item(NamedTuple):
    """A file to learn from.

    Attributes:
        path: Relative to the data set's folder.
        label: Class of a clip; the words said in a recording, upper case.
        group: Scene of a clip, speaker of a recording: what a client holds whole.
    """

    path: str
    label: str
    group: str


class Damage(NamedTuple):
    """A file that is left out, and why."""

    path: str
    reason: str


class Listing(NamedTuple):
    """A split of a data set.

    Attributes:
        folder: Where paths begin.
        items: In order of their paths: the same on each machine.
        classes: Labels in the order of their numbers; empty where labels are free text.
        damaged: What was left out.
        notes: What is odd and stops nothing.
    """

    folder: Path
    items: tuple[Item, ...]
    classes: tuple[str, ...] = ()
    damaged: tuple[Damage, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def groups(self) -> tuple[str, ...]:
        """The groups, sorted."""
        return tuple(sorted({item.group for item in self.items}))

    def without(self, damaged: Iterable[Damage]) -> "Listing":
        """Return the listing without files that turned out to be damaged."""
        more = tuple(damaged)
        gone = {damage.path for damage in more}
        items = tuple(item for item in self.items if item.path not in gone)
        return self._replace(items=items, damaged=(*self.damaged, *more))


def refuse_if_damaged(damaged: Sequence[Damage], good: int, *, what: str) -> None:
    """Raise DataError with the list where more than 5 % of the files are damaged, or none is good.

    Args:
        damaged: files that are left out.
        good: number of the others.
        what: what the files are of, for the message.
    """
    if not damaged and good:
        return
    total = len(damaged) + good
    if not total:
        raise DataError(f"{what} has no files", "see that the folder is laid out as docs/learning.md shows")
    if len(damaged) > MOST_DAMAGED * total or not good:
        shown = "; ".join(f"{damage.path}: {damage.reason}" for damage in damaged[:SHOWN])
        more = f"; and {len(damaged) - SHOWN} others" if len(damaged) > SHOWN else ""
        raise DataError(
            f"{what}: {len(damaged)} of {total} files are damaged, more than {MOST_DAMAGED:.0%}: {shown}{more}",
            "copy the data again, or take the damaged files out of it",
        )
