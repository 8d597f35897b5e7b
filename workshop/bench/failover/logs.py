"""What gateways write into their logs, read as it comes: they say there when they have reached what is measured."""

import asyncio
import json
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

from appliance.errors import DeadlineError

LOOK_S = 0.005
"""Between two looks at a file."""


class LogTail:
    """The lines of a log file from where it ends now, decoded; lines that are no JSON are left out."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._at = path.stat().st_size if path.exists() else 0
        self._rest = b""
        self._unread: list[dict[str, Any]] = []

    def read(self) -> list[dict[str, Any]]:
        """The lines that have come since, and those that `until` left."""
        found, self._unread = [*self._unread, *self._new()], []
        return found

    def _new(self) -> list[dict[str, Any]]:
        if not self._path.exists():
            return []
        with self._path.open("rb") as file:
            file.seek(self._at)
            found = file.read()
        self._at += len(found)
        *lines, self._rest = (self._rest + found).split(b"\n")
        decoded: list[dict[str, Any]] = []
        for line in lines:
            try:
                each = json.loads(line)
            except ValueError:
                continue
            if isinstance(each, dict):
                decoded.append(each)  # pyright: ignore[reportUnknownArgumentType]
        return decoded

    async def until(self, wanted: Callable[[dict[str, Any]], bool], what: str, *, wait_s: float) -> dict[str, Any]:
        """The next line that is wanted, without those before it; DeadlineError, which says `what`, after `wait_s`."""
        give_up = time.monotonic() + wait_s
        while time.monotonic() < give_up:
            lines = self.read()
            for number, line in enumerate(lines):
                if wanted(line):
                    self._unread = lines[number + 1 :]
                    return line
            await asyncio.sleep(LOOK_S)
        raise DeadlineError(f"{what}: not in {self._path} within {wait_s:g} s", remedy="see the end of that file")


def wall_s(line: dict[str, Any]) -> float:
    """When a line was written, Unix seconds of the machine that all processes share."""
    return datetime.fromisoformat(str(line["timestamp"])).timestamp()
