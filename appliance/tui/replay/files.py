"""Which recorded logs there are: in the folders where a local fleet's recorder and the service's write."""

import os
from collections.abc import Sequence
from pathlib import Path

from msgspec import Struct

MOST = 200
"""Files listed, the newest."""
MOST_SEEN = 5000
"""Names looked at in one folder."""
SERVICE = Path("/var/lib/swiftbot/record")


class LogFile(Struct, frozen=True, kw_only=True):
    """A file that may be a log."""

    path: Path
    size: int
    written_s: float


def folders(fleet: str) -> tuple[Path, ...]:
    """Return where logs of a fleet usually are, this folder among them."""
    state = os.environ.get("XDG_STATE_HOME") or str(Path.home() / ".local" / "state")
    return (Path(state) / "swiftbot" / fleet / "record", SERVICE, Path.cwd())


def find_logs(own: Sequence[str], fleet: str) -> list[LogFile]:
    """Return the logs there are, the newest first; folders that cannot be read have none.

    Args:
        own: further folders.
        fleet: whose.
    """
    found: dict[Path, LogFile] = {}
    for folder in (*(Path(each).expanduser() for each in own), *folders(fleet)):
        try:
            with os.scandir(folder) as entries:
                for number, entry in enumerate(entries):
                    if number >= MOST_SEEN:
                        break
                    if entry.name.endswith(".mcap") and entry.is_file():
                        told = entry.stat()
                        path = Path(entry.path)
                        found[path] = LogFile(path=path, size=told.st_size, written_s=told.st_mtime)
        except OSError:
            continue
    return sorted(found.values(), key=lambda each: each.written_s, reverse=True)[:MOST]
