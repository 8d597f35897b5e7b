"""How much disk logs may take: the oldest files go first, pinned ones never.

A file is pinned by an empty file beside it, `NAME.mcap.pin`: it needs no database, survives copies of the folder,
and anybody can see and remove it.
"""

import contextlib
import re
from collections.abc import Iterable
from pathlib import Path

import structlog
from msgspec import Struct

from appliance.errors import NotFoundError, RecordError

log = structlog.get_logger(__name__)

PIN = ".pin"


class Kept(Struct, frozen=True, kw_only=True):
    """A finished log file on the disk."""

    path: Path
    size_bytes: int
    modified_ns: int
    pinned: bool


def surplus(files: Iterable[Kept], *, budget_bytes: int) -> tuple[Kept, ...]:
    """Return the files to remove, oldest first, so that all are within the budget; pinned ones count but stay."""
    kept = sorted(files, key=lambda each: (each.modified_ns, each.path.name))
    over = sum(each.size_bytes for each in kept) - budget_bytes
    chosen: list[Kept] = []
    for each in kept:
        if over <= 0:
            break
        if not each.pinned:
            chosen.append(each)
            over -= each.size_bytes
    return tuple(chosen)


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


def make_room(folder: Path, prefix: str, *, budget_bytes: int) -> int:
    """Remove the oldest logs beyond the budget; returns how many. What cannot be removed is logged and left."""
    gone = 0
    for each in surplus(finished(folder, prefix), budget_bytes=budget_bytes):
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
