"""The disk that a container's volumes are on, watched while a run is in progress.

It exists because `file_mb` bounds a file and nothing bounds the number of files: a volume is a folder of the gateway's
own disk, and a run that writes into it without end would take the room that the gateway itself needs. So what counts
is what is left there. A run is ended only when it is one of those who took it: others fill disks too.

The folder of the runner's socket is the gateway's as well, and in memory. No handler has any business there, but none
can be kept out: it is the same user, and the socket must be made.
"""

import os
import stat
import time
from collections.abc import Iterable
from pathlib import Path

MB = 2**20
LOOK_S = 0.1
"""How often what is left is asked for while a run is in progress: 20 µs; in that time a fast disk takes 200 MB."""
WALK_S = 1.0
"""How often, while it is short, what the run has written is looked for."""
OWN_MB = 16
"""What a run may write, in all its volumes together, however little is left."""
OWN_FILES = 10_000
"""And so many files: an empty one takes an inode, and a disk may run out of those first."""
STRAY_MB = 1
"""What it may write beside the socket; it is swept up afterwards."""
STRAY_FILES = 100
LEAST_INODES = 20_000
"""Fewer free ones are short."""
MOST_WALKED = 50_000
"""Files that are looked at, in about 0.3 s; a volume of more counts as written by the run."""


class Disk:
    """Says whether a run has to be ended so that its gateway keeps some room.

    Args:
        volumes: the folder that the volumes are mounted in.
        cache: the folder that runs cache in, watched like a volume.
        beside: the folder of the runner's socket.
        reserve_mb: what is to be left free on the disk of the volumes, MB; 0: they are not watched.
    """

    def __init__(self, volumes: Path, cache: Path | None = None, *, beside: Path, reserve_mb: int) -> None:
        self._reserve = reserve_mb * MB
        self._beside = beside
        self._mounts = sorted(volumes.iterdir()) if reserve_mb and volumes.is_dir() else []
        if reserve_mb and cache is not None:
            self._mounts.append(cache)
        # All are on one disk, unless somebody has moved one of them.
        self._disks = list({each.stat().st_dev: each for each in self._mounts}.values())
        self._since = 0.0
        self._walk_at = 0.0

    def begin(self) -> None:
        """Note that a run begins: files that change from now on are its own."""
        # Files are stamped with a clock that is some milliseconds behind: what is written in these is not counted, but
        # nothing of the run before is.
        self._since = time.time()
        self._walk_at = 0.0

    def overrun(self, now: float) -> bool:
        """Whether the run has written more than is its part where there is little. `now`: monotonic seconds."""
        if self._written([self._beside], STRAY_MB, STRAY_FILES):
            return True
        if now < self._walk_at or not any(self._short(each) for each in self._disks):
            return False
        self._walk_at = now + WALK_S
        return self._written(self._mounts, OWN_MB, OWN_FILES)

    def _short(self, folder: Path) -> bool:
        try:
            left = os.statvfs(folder)
        except OSError:
            return False
        # `f_files` is 0 where there is no bound on them.
        return left.f_bavail * left.f_frsize < self._reserve or 0 < left.f_favail < min(LEAST_INODES, left.f_files)

    def _written(self, folders: Iterable[Path], most_mb: int, most_files: int) -> bool:
        """Whether the files in these folders that have changed since the run began are more than it may write."""
        size = files = walked = 0
        left = [os.fspath(each) for each in folders]
        while left:
            try:
                with os.scandir(left.pop()) as entries:
                    inside = list(entries)
            except OSError:
                continue  # removed meanwhile, or closed to us before the run began
            for entry in inside:
                try:
                    found = entry.stat(follow_symlinks=False)
                except OSError:
                    continue
                walked += 1
                if stat.S_ISDIR(found.st_mode):
                    left.append(entry.path)
                if found.st_ctime > self._since:
                    size += found.st_blocks * 512
                    files += 1
                    if stat.S_ISDIR(found.st_mode) and not os.access(entry.path, os.R_OK | os.X_OK):
                        return True  # only a handler that hides what it writes closes a folder to itself
                if size > most_mb * MB or files > most_files or walked > MOST_WALKED:
                    return True
        return False
