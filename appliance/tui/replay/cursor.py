"""Reads a log up to a moment: on from where it is, or from the beginning with only the last word on each key.

A log may be larger than memory and its end may be missing, so it is streamed. To go back, or far ahead, it is read
again from the front without decoding anything: of each key only the last message up to the moment counts, as it does
for the screens, and of what is a stream (log lines, run events) the last lines. Blocking: it is called in a thread.
"""

from collections import OrderedDict, deque
from collections.abc import Callable, Iterator
from pathlib import Path

from msgspec import Struct

from appliance.record.facts import LoggedMessage
from appliance.record.reader import info, read

MOST_KEYS = 50_000
"""Keys whose last message is kept while seeking; the one not heard for longest goes first."""
MOST_LINES = 2000
"""Messages of streams kept while seeking."""
MOST_BYTES = 256 * 2**20
"""Payloads kept while seeking."""


class Read(Struct, frozen=True, kw_only=True):
    """What was read: messages in the order recorded, the moment they reach up to, whether that is all."""

    messages: tuple[LoggedMessage, ...]
    reached_ns: int
    ended: bool = False
    fresh: bool = False
    """They are the whole state at that moment: what was known before is to be forgotten."""


class Cursor:
    """A place in a log file.

    Args:
        path: the file.
        skip: keys that no screen shows (pictures, raw frames): they are passed over.
        stream: whether a key's messages are a stream, all of which count, and not the latest alone.

    Raises:
        NotFoundError, RecordError: it cannot be read.
    """

    def __init__(self, path: Path, *, skip: Callable[[str], bool], stream: Callable[[str], bool]) -> None:
        self.path = path
        self.about = info(path)
        self.problems: list[str] = []
        """What was found damaged, a sentence each."""
        self._skip = skip
        self._stream = stream
        self._messages: Iterator[LoggedMessage] = iter(())
        self._next: LoggedMessage | None = None
        self.reached_ns = 0
        self._rewind()

    def _rewind(self) -> None:
        self.problems = []
        self._messages = read(self.path, problems=self.problems)
        self._next = next(self._messages, None)
        self.reached_ns = 0

    def on_to(self, at_ns: int, *, most: int) -> Read:
        """Read on, up to a moment or so many messages."""
        found: list[LoggedMessage] = []
        while self._next is not None and self._next.at_ns <= at_ns and len(found) < most:
            if not self._skip(self._next.key):
                found.append(self._next)
            self.reached_ns = max(self.reached_ns, self._next.at_ns)
            self._next = next(self._messages, None)
        if self._next is None or self._next.at_ns > at_ns:
            self.reached_ns = max(self.reached_ns, at_ns)
        return Read(messages=tuple(found), reached_ns=self.reached_ns, ended=self._next is None)

    def to(self, at_ns: int, *, stop: Callable[[], bool] = lambda: False) -> Read:
        """Read from the front up to a moment: the last message of each key, and the last lines of streams.

        Args:
            at_ns: the moment.
            stop: asked now and then; True ends it, with what was read until then.
        """
        self._rewind()
        last: OrderedDict[str, tuple[int, LoggedMessage]] = OrderedDict()
        lines: deque[tuple[int, LoggedMessage]] = deque(maxlen=MOST_LINES)
        number = size = 0
        while self._next is not None and self._next.at_ns <= at_ns:
            message = self._next
            number += 1
            self.reached_ns = max(self.reached_ns, message.at_ns)
            if not self._skip(message.key):
                if self._stream(message.key):
                    lines.append((number, message))
                else:
                    before = last.pop(message.key, None)
                    size += len(message.payload) - (len(before[1].payload) if before else 0)
                    last[message.key] = (number, message)
                    while len(last) > MOST_KEYS or size > MOST_BYTES:
                        size -= len(last.popitem(last=False)[1][1].payload)
            self._next = next(self._messages, None)
            if not number % 4096 and stop():
                break
        else:
            self.reached_ns = max(self.reached_ns, at_ns)
        kept = sorted([*last.values(), *lines], key=lambda each: each[0])
        return Read(
            messages=tuple(message for _, message in kept),
            reached_ns=self.reached_ns,
            ended=self._next is None,
            fresh=True,
        )
