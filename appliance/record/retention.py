"""How much disk logs may take, and for how long: the oldest files go first, pinned ones never.

A file is pinned by an empty file beside it, `NAME.mcap.pin`: it needs no database, survives copies of the folder,
and anybody can see and remove it.
"""

import contextlib
import re
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path

import structlog
from msgspec import Struct

from appliance.errors import NotFoundError, RecordError

log = structlog.get_logger(__name__)

PIN = ".pin"
MOST_BY_AGE = 2
"""Files that go for their age with each new one: more than come, and a clock that is years ahead loses few before the
alert is seen."""


class Kept(Struct, frozen=True, kw_only=True):
    """A finished log file on the disk."""

    path: Path
    size_bytes: int
    modified_ns: int
    pinned: bool


class Budget(Struct, frozen=True, kw_only=True):
    """What files may take together. Pinned ones count and stay."""

    most_bytes: int | None = None
    most_s: float | None = None
    """How long a file is kept after it was written to."""


def _by_age(files: Iterable[Kept]) -> list[Kept]:
    return sorted(files, key=lambda each: (each.modified_ns, each.path.name))


def surplus(files: Iterable[Kept], budget: Budget, *, now_ns: int) -> tuple[Kept, ...]:
    """Return the files to remove, oldest first, so that all are within the budget."""
    kept = _by_age(files)
    over = sum(each.size_bytes for each in kept) - budget.most_bytes if budget.most_bytes is not None else 0
    chosen: list[Kept] = []
    by_age = 0
    for each in kept:
        old = budget.most_s is not None and now_ns - each.modified_ns > budget.most_s * 1e9 and by_age < MOST_BY_AGE
        if not each.pinned and (over > 0 or old):
            chosen.append(each)
            by_age += over <= 0
            over -= each.size_bytes
    return tuple(chosen)


def next_to_go(files: Iterable[Kept], budget: Budget, *, now_ns: int) -> tuple[Kept, float] | None:
    """Return the file that goes next, and in how many seconds at the rate of those that are there.

    Args:
        files: that are kept.
        budget: what they may take.
        now_ns: now, Unix nanoseconds.

    Returns:
        None where none can go, or there are too few to tell.
    """
    kept = _by_age(files)
    oldest = next((each for each in kept if not each.pinned), None)
    if oldest is None:
        return None
    waits: list[float] = []
    if budget.most_s is not None:
        waits.append(oldest.modified_ns / 1e9 + budget.most_s - now_ns / 1e9)
    span_s = (now_ns - kept[0].modified_ns) / 1e9
    if budget.most_bytes is not None and span_s > 0:
        # What the oldest holds was written before the span began.
        rate = sum(each.size_bytes for each in kept[1:]) / span_s
        left = budget.most_bytes - sum(each.size_bytes for each in kept)
        if rate > 0:
            waits.append(left / rate)
    return (oldest, max(0.0, min(waits))) if waits else None


def going_text(files: Iterable[Kept], budget: Budget, *, now_ns: int, warn_s: float) -> str:
    """Return which logs go within a time if nobody keeps them, in words; empty when none does."""
    found = next_to_go(files, budget, now_ns=now_ns)
    if found is None or found[1] >= warn_s:
        return ""
    until = datetime.fromtimestamp(found[0].modified_ns / 1e9, tz=UTC)
    return f"logs up to {until:%Y-%m-%d %H:%M} UTC are removed within {max(1, round(warn_s / 3600))} h"


def finished(folder: Path, prefix: str) -> list[Kept]:
    """Return the log files of a folder that are called `prefix`, time and number, as the recorder calls them."""
    ours = re.compile(re.escape(prefix) + r"\d{8}T\d{6}Z-\d+\.mcap")
    found: list[Kept] = []
    for path in folder.glob("*.mcap"):
        if not ours.fullmatch(path.name):
            continue
        with contextlib.suppress(FileNotFoundError):  # somebody moved it away just now
            stat = path.stat()
            pinned = pin_of(path).exists()
            found.append(Kept(path=path, size_bytes=stat.st_size, modified_ns=stat.st_mtime_ns, pinned=pinned))
    return found


def make_room(folder: Path, prefix: str, budget: Budget, *, now_ns: int) -> int:
    """Remove the oldest logs beyond the budget; returns how many. What cannot be removed is logged and left."""
    gone = 0
    for each in surplus(finished(folder, prefix), budget, now_ns=now_ns):
        try:
            each.path.unlink(missing_ok=True)
        except OSError as error:
            log.warning("old log could not be removed", path=str(each.path), reason=error.strerror)
            continue
        gone += 1
        log.info("old log removed", path=str(each.path), size_bytes=each.size_bytes)
    return gone


def pin_of(path: Path) -> Path:
    """Return the file that pins a log by being there."""
    return path.with_name(path.name + PIN)


def pin(path: Path, *, pinned: bool) -> None:
    """Keep a log whatever the budget, or no longer.

    Raises:
        NotFoundError: no such file.
        RecordError: its folder cannot be written.
    """
    try:
        if not path.is_file():
            raise NotFoundError(f"no log file {path}", remedy="`swiftbot log info FILE` tells what is in one")
        if pinned:
            pin_of(path).touch()
        else:
            pin_of(path).unlink(missing_ok=True)
    except OSError as error:
        raise RecordError(
            f"{pin_of(path)} cannot be changed: {error.strerror}", remedy="as the recorder's user"
        ) from error
