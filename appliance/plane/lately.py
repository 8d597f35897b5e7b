"""What became of the writes that this gateway ordered last, by their ids.

A writer whose answer was lost asks again with the same id. While its write is the newest that is told by the record
itself; once another has followed it, only whoever ordered it knows that it is done, and a writer that heard of a
conflict would do it a second time. Bounded: who asks again does so within seconds.
"""

import threading
from collections import OrderedDict

from appliance.model import VersionVector

_MOST = 4096


class Lately:
    """Writes under way, and the last that were acknowledged, at most `most` together; from any thread."""

    def __init__(self, most: int = _MOST) -> None:
        self._most = most
        self._known: OrderedDict[tuple[str, str], VersionVector | None] = OrderedDict()
        """Key and id -> the version it made; None: it is under way."""
        self._lock = threading.Lock()

    def began(self, key: str, write: str) -> None:
        """A write was ordered, and is not acknowledged yet."""
        self._note(key, write, None)

    def ended(self, key: str, write: str, version: VersionVector) -> None:
        """It was acknowledged."""
        self._note(key, write, version)

    def failed(self, key: str, write: str) -> None:
        """It was not: asked again, it is looked at anew."""
        with self._lock:
            self._known.pop((key, write), None)

    def of(self, key: str, write: str) -> tuple[bool, VersionVector | None]:
        """Whether a write is known here, and the version it made once it is acknowledged."""
        with self._lock:
            return (key, write) in self._known, self._known.get((key, write))

    def _note(self, key: str, write: str, version: VersionVector | None) -> None:
        if not write:
            return
        with self._lock:
            self._known[key, write] = version
            self._known.move_to_end((key, write))
            while len(self._known) > self._most:
                self._known.popitem(last=False)
