"""Which log files were being written when: what recorders have told of themselves. Pure; the clock is passed in."""

from collections.abc import Iterable

from msgspec import Struct

MOST_FILES = 500
"""Files remembered; with a new one each half hour, ten days of one recorder."""
MOST_NAMED = 3
SLACK_NS = 5 * 10**9
"""A recorder tells of itself once a second, and clocks of gateways differ a little."""


class Span(Struct, kw_only=True):
    """A file and the time in which its recorder said that it writes to it; Unix nanoseconds."""

    recorder: str
    file: str
    since_ns: int
    until_ns: int


class LogFiles:
    """The files of a fleet's recorders, as far as they were heard of."""

    def __init__(self, spans: Iterable[Span] = ()) -> None:
        self.spans = list(spans)[-MOST_FILES:]
        """In the order in which they were begun."""

    def heard(self, recorder: str, file: str, now_ns: int) -> None:
        """Take in what a recorder tells; `file`: the one it writes to, empty when it writes to none."""
        if not file:
            return
        for span in reversed(self.spans):
            if span.recorder == recorder:
                if span.file == file:
                    span.until_ns = max(span.until_ns, now_ns)
                    return
                break
        self.spans.append(Span(recorder=recorder, file=file, since_ns=now_ns, until_ns=now_ns))
        del self.spans[:-MOST_FILES]

    def at(self, when_ns: int) -> str:
        """Return the names of the files written to at a time, by recorder, at most 3; empty where none is known."""
        found: dict[str, str] = {}
        for span in self.spans:
            if span.since_ns - SLACK_NS <= when_ns <= span.until_ns + SLACK_NS:
                found[span.recorder] = span.file
        return ", ".join(found[recorder] for recorder in sorted(found)[:MOST_NAMED])
