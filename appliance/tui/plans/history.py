"""Instructions that were submitted from this account: kept in a file, newest last, for the arrow keys.

A file that cannot be read or written costs the history and nothing else: the cause is told once, as a sentence.
"""

import contextlib
import os
import tempfile
from pathlib import Path

import msgspec

MOST = 500
MOST_BYTES = 2**20


def default_file() -> Path:
    """Where the history is: under XDG_STATE_HOME."""
    state = os.environ.get("XDG_STATE_HOME") or str(Path.home() / ".local" / "state")
    return Path(state) / "swiftbot" / "instructions.json"


class History:
    """The instructions, and a place among them while the arrow keys are used."""

    def __init__(self, file: Path | None = None) -> None:
        self.file = file
        self.problem = ""
        """Why it was not read or kept; empty when all is well."""
        self.entries: list[str] = self._read()
        self._at = len(self.entries)
        self._begun = ""

    def _read(self) -> list[str]:
        if self.file is None:
            return []
        try:
            with self.file.open("rb") as stream:
                data = stream.read(MOST_BYTES + 1)
            if len(data) > MOST_BYTES:
                self.problem = f"{self.file} is larger than {MOST_BYTES} bytes: the history begins anew"
                return []
            return msgspec.json.decode(data, type=list[str])[-MOST:]
        except FileNotFoundError:
            return []
        except (OSError, msgspec.MsgspecError) as error:
            self.problem = f"{self.file} cannot be read: {error}"
            return []

    def add(self, instruction: str) -> None:
        """Keep an instruction as the newest; the same one is kept once."""
        instruction = instruction.strip()
        if not instruction:
            return
        self.entries = [*(each for each in self.entries if each != instruction), instruction][-MOST:]
        self.rewind()
        self._write()

    def _write(self) -> None:
        if self.file is None:
            return
        temporary = ""
        try:
            self.file.parent.mkdir(parents=True, exist_ok=True)
            # Instructions may name people and places: for this account alone (mkstemp makes it 0600).
            handle, temporary = tempfile.mkstemp(dir=self.file.parent, prefix=".instructions-")
            with os.fdopen(handle, "wb") as stream:
                stream.write(msgspec.json.encode(self.entries))
            Path(temporary).replace(self.file)
        except OSError as error:
            self.problem = f"{self.file} cannot be written: {error.strerror}"
            if temporary:
                with contextlib.suppress(OSError):
                    Path(temporary).unlink()

    # --- going through it ---------------------------------------------------------------------------------------

    def rewind(self) -> None:
        """Stand after the newest again."""
        self._at = len(self.entries)
        self._begun = ""

    def older(self, text: str) -> str:
        """Return the instruction before; `text` is what is written now, which comes back at the end."""
        if self._at == len(self.entries):
            self._begun = text
        self._at = max(0, self._at - 1)
        return self.entries[self._at] if self.entries else text

    def newer(self, text: str) -> str:
        """Return the instruction after, at the end what had been begun."""
        if self._at >= len(self.entries):
            return text
        self._at += 1
        return self.entries[self._at] if self._at < len(self.entries) else self._begun
