"""The file under a log: every write goes to the kernel at once, and a failed one leaves nothing half-written.

The MCAP writer keeps its place only as long as each write succeeds. So when a write fails (disk full, file size
limit, I/O error) the log is cut back to the end of the last whole flush and ended with a bare footer: a legal
file, and what was in it stays.
"""

import contextlib
import os
import struct
from pathlib import Path

_ENDING = (
    struct.pack("<BQI", 0x0F, 4, 0)  # DataEnd, no checksum
    + struct.pack("<BQQQI", 0x02, 20, 0, 0, 0)  # Footer without summary
    + bytes((137, 77, 67, 65, 80, 48, 13, 10))
)
"""The shortest legal end of an MCAP file: no summary, so readers stream it."""


class LogFile:
    """A new file opened for a log (FileExistsError when it is there). Raises OSError from every method that writes."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o640)
        self._position = 0
        self._whole = 0

    def write(self, data: bytes) -> int:
        """Write all of `data`."""
        rest = memoryview(data)
        while rest:
            written = os.write(self._handle, rest)
            rest = rest[written:]
            self._position += written
        return len(data)

    def tell(self) -> int:
        """Return the number of bytes written."""
        return self._position

    def flush(self) -> None:
        """Take what is written so far for whole: the mcap writer calls this with no record in the middle."""
        self._whole = self._position

    def sync(self) -> None:
        """Have the kernel put it on the disk."""
        os.fdatasync(self._handle)

    def close(self) -> None:
        """Close after a good end."""
        os.close(self._handle)

    def abandon(self) -> bool:
        """Cut back to the last whole flush, end the file there as well as the disk allows, close it.

        Returns:
            Whether anything is left; False when the file was removed because nothing of it was whole.
        """
        with contextlib.suppress(OSError):
            os.ftruncate(self._handle, self._whole)
            os.lseek(self._handle, self._whole, os.SEEK_SET)
            if self._whole and os.write(self._handle, _ENDING) < len(_ENDING):
                os.ftruncate(self._handle, self._whole)
        with contextlib.suppress(OSError):
            os.close(self._handle)
        if not self._whole:
            with contextlib.suppress(OSError):
                self.path.unlink()
        return bool(self._whole)


def free_bytes(folder: Path) -> int:
    """Return what an unprivileged process may still write on the file system of `folder`, bytes."""
    stat = os.statvfs(folder)
    return stat.f_bavail * stat.f_frsize
