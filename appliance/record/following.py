"""Follows the numbers of those who put (`plane.backlog`): what is missing is asked for, and told in its place.

Messages of a session that come behind a hole wait until the hole is filled or given up, so that the log has a
session's messages in its order. Other sessions' messages do not wait for them. Pure state: no clock, no I/O.
"""

from collections import OrderedDict
from collections.abc import Iterable, Mapping

from msgspec import Struct

from appliance.plane.backlog import UNKNOWN, after, moved
from appliance.record.facts import LoggedMessage

MOST_SESSIONS = 20_000
"""Sessions that are followed; the one that was silent for longest is forgotten first."""
MOST_HELD, MOST_HELD_BYTES = 20_000, 32 * 2**20
"""What waits behind the hole of one session; beyond that the hole is given up."""
_FAR = 2**30
"""So far back it is asked for what a session put before it was heard of."""


class Hole(Struct, frozen=True):
    """Numbers `first` to `last` of a session are missing. `fresh`: nothing of that session was heard before."""

    source: str
    first: int
    last: int
    fresh: bool = False

    @property
    def count(self) -> int:
        """How many."""
        return after(self.last, self.first) + 1


class Lost(Struct, frozen=True):
    """So many messages of a session stay missing, by kind of key."""

    source: str
    keys: dict[str, int]
    at_ns: int


class Taken(Struct):
    """What follows from messages: those to log, in order, holes to ask about, and what is lost."""

    messages: list[LoggedMessage]
    holes: list[Hole]
    lost: list[Lost]


class _Session(Struct):
    last: int
    hole: Hole | None = None
    held: list[LoggedMessage] = []
    held_bytes: int = 0
    lost: set[int] = set()
    """Numbers that were given up, and may yet come."""


class Follower:
    """Follows all sessions of a fleet."""

    def __init__(self) -> None:
        self._sessions: OrderedDict[str, _Session] = OrderedDict()

    def take(self, messages: Iterable[LoggedMessage]) -> Taken:
        """Take messages as they came."""
        out = Taken([], [], [])
        for message in messages:
            if message.source and message.number:
                self._take(message, out)
            else:
                out.messages.append(message)
        return out

    def fill(self, hole: Hole, found: Iterable[LoggedMessage], lost: Mapping[str, int]) -> Taken:
        """End a hole with what was found of it, in order of its numbers, and let those go on that wait behind it.

        Args:
            hole: as it was told.
            found: of its numbers; others are left out.
            lost: what stays missing, by kind of key.
        """
        out = Taken([], [], [])
        session = self._sessions.get(hole.source)
        if session is None or session.hole != hole:
            return out  # it was given up
        fitting = (each for each in found if after(each.number, hole.first) >= 0 and after(hole.last, each.number) >= 0)
        out.messages += sorted(fitting, key=lambda each: after(each.number, hole.first))
        held, session.held, session.held_bytes = session.held, [], 0
        session.hole, session.last = None, hole.last
        if lost:
            there = {each.number for each in out.messages}
            if hole.count <= MOST_HELD:
                numbers = (moved(hole.first, offset) for offset in range(hole.count))
                session.lost = {number for number in numbers if number not in there}
            out.lost.append(Lost(hole.source, dict(lost), held[0].at_ns if held else 0))
        for message in held:
            self._take(message, out)
        return out

    def give_up(self, hole: Hole) -> Taken:
        """End a hole of which nothing can be learned: its session has gone, or keeps nothing.

        What was before the first message of a session that was not known is nobody's loss for all that is known.
        """
        return self.fill(hole, (), {} if hole.fresh else {UNKNOWN: hole.count})

    def give_all_up(self) -> Taken:
        """End all holes: recording ends."""
        out = Taken([], [], [])
        for session in list(self._sessions.values()):
            while session.hole is not None:
                found = self.give_up(session.hole)
                out.messages += found.messages
                out.lost += found.lost
        return out

    def _take(self, message: LoggedMessage, out: Taken) -> None:
        session = self._sessions.get(message.source)
        if session is None:
            session = self._sessions[message.source] = _Session(last=0)
            if message.number != 1:
                first = max(1, message.number - _FAR)
                self._open(session, Hole(message.source, first, message.number - 1, fresh=True), message, out)
            else:
                session.last = 1
                out.messages.append(message)
            self._bound()
            return
        self._sessions.move_to_end(message.source)
        if session.hole is not None:
            self._hold(session, message, out)
            return
        ahead = after(message.number, session.last)
        if ahead == 1:
            session.last = message.number
            out.messages.append(message)
        elif ahead > 1:
            hole = Hole(message.source, moved(session.last, 1), moved(message.number, -1))
            self._open(session, hole, message, out)
        elif message.number in session.lost:
            session.lost.discard(message.number)  # counted as lost, and here after all: the log has it
            out.messages.append(message)
        # Otherwise it is there already: fetched, and then delivered all the same.

    def _open(self, session: _Session, hole: Hole, message: LoggedMessage, out: Taken) -> None:
        session.hole, session.held, session.held_bytes = hole, [message], len(message.payload)
        out.holes.append(hole)

    def _hold(self, session: _Session, message: LoggedMessage, out: Taken) -> None:
        session.held.append(message)
        session.held_bytes += len(message.payload)
        hole = session.hole
        if hole is not None and (len(session.held) > MOST_HELD or session.held_bytes > MOST_HELD_BYTES):
            ended = self.give_up(hole)
            out.messages += ended.messages
            out.holes += ended.holes
            out.lost += ended.lost

    def _bound(self) -> None:
        while len(self._sessions) > MOST_SESSIONS:
            # One with a hole has messages that wait: it is at work, and stays.
            oldest = next((name for name, each in self._sessions.items() if each.hole is None), None)
            if oldest is None:
                return
            del self._sessions[oldest]
