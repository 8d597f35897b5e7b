"""Small questions between gateways as plain messages: a third less time there and back than a query of Zenoh's.

A query is kept in a table on its way, has a timer, and ends by a message of its own. A direct question is one message
to a door, and its answer one to the session that asked, `@answers/{session}`: keys that no wildcard matches, so that
neither the recorder nor a listener to everything is sent them. All keys that a gateway answers for have one door,
`gw/{gateway}/rpc/@direct`: so one way to each other gateway is made and kept. What a query tells is told here too:

- that nobody is there: Zenoh knows who listens at a door. Where nobody does, the question goes as a query, which says
  so; when whoever listened goes, the questions that wait for it end as those that may have been heard;
- that it came to the wrong door (`doors`): the key it is meant for goes with it. It is asked again as a query then,
  and so is one whose answer is too large for a message that may be dropped.
"""
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false, reportUnknownVariableType=false
# The library's stubs leave out the return types of methods that return nothing.

import itertools
import secrets
import threading
from collections import OrderedDict
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import structlog
import zenoh

from appliance.errors import SwiftbotError
from appliance.plane import link, threads
from appliance.plane.keys import door_of
from appliance.plane.wire import Closer, Wire

log = structlog.get_logger(__name__)

Answer = Callable[[bytes | None, SwiftbotError | None], None]
"""Answers one question, from any thread; an empty answer has it asked again as a query."""

_DROP, _HIGH = zenoh.CongestionControl.DROP, zenoh.Priority.DATA_HIGH
_MOST_WAYS = 256
_ANSWERED, _FAILED = b"+", b"-"
_SESSION = frozenset(b"0123456789abcdef")
_LONGEST = 32
_MOST_KEY = 200
"""Of a misrouted question's key that is logged."""


class Asked(NamedTuple):
    """What a question says of itself; `number` and `session` are for its answer."""

    number: int
    session: str
    key: bytes
    """What it is meant for."""


class _Waiting(NamedTuple):
    way: "Way"
    on_reply: Callable[[bytes | None, SwiftbotError | None], None]
    on_gone: Callable[[], None]
    here: bool = False
    """Both are called where they come, on Zenoh's threads."""


class _Door(NamedTuple):
    """What is served beside each other."""

    takes: dict[bytes, Callable[[Asked, zenoh.ZBytes], None]]
    """Key -> what has the questions for it; looked at on Zenoh's threads."""
    name: str
    subscriber: "zenoh.Subscriber[None]"


class Way:
    """The way to one door: says whether anybody listens there.

    To look is slow. Zenoh tells of each change, one after the other: who is known to listen does so until it says
    otherwise, or until a question stays unanswered (`doubt`); then it is looked again. Asked on the event loop's
    thread, told on Zenoh's: what is told while it is looked is the newer.
    """

    def __init__(self, raw: zenoh.Session, door: str, on_gone: Callable[["Way"], None]) -> None:
        self.door = door
        self._listened, self._told = False, 0
        self._lock = threading.Lock()
        self._publisher = raw.declare_publisher(door, congestion_control=_DROP, priority=_HIGH, express=True)
        self.put = self._publisher.put
        self._on_gone = on_gone
        handler = threads.callback(self._changed)
        self._listener = self._publisher.declare_matching_listener(handler)

    def _changed(self, status: "zenoh.MatchingStatus") -> None:
        with self._lock:
            # Before those who wait are told that nobody listens any more: who asks after that sees it here.
            self._listened, self._told = status.matching, self._told + 1
        if not status.matching:
            self._on_gone(self)

    def doubt(self) -> None:
        """A question stayed unanswered: look before the next."""
        with self._lock:
            self._listened = False

    @property
    def listened(self) -> bool:
        """Whether somebody is known to listen there, without looking; from any thread."""
        return self._listened

    @property
    def open(self) -> bool:
        """Whether somebody listens there just now."""
        return self._listened or self.look()

    def look(self) -> bool:
        """Ask Zenoh whether somebody listens there."""
        told = self._told
        # The stubs take the status for a bool; it is a structure with one.
        listened = self._publisher.matching_status.matching  # pyright: ignore[reportAttributeAccessIssue]
        with self._lock:
            if self._told == told:
                self._listened = listened
        return listened

    def close(self) -> None:
        """Forget the way."""
        self._listener.undeclare()
        self._publisher.undeclare()


class Direct:
    """The direct questions of one session, asked on the event loop's thread or (`ask_here`) any, and answered."""

    def __init__(self, wire: Wire) -> None:
        self._wire = wire
        self._session = str(wire.raw.zid())
        self._session_text = self._session.encode()
        self._ways: OrderedDict[str, Way] = OrderedDict()
        """Door -> the way there."""
        self._waiting: dict[int, _Waiting] = {}
        # An answer that Zenoh delivers to the wrong session finds nobody who waits for such a number.
        self._numbers = itertools.count(secrets.randbits(62))
        self._listening: zenoh.Subscriber[None] | None = None
        self._served: dict[str, _Door] = {}
        self._answers = wire.keys.answers("")

    # --- asking -----------------------------------------------------------------------------------------------

    def ask(
        self,
        key: str,
        payload: bytes,
        on_reply: Callable[[bytes | None, SwiftbotError | None], None],
        on_gone: Callable[[], None],
    ) -> int | None:
        """Ask whoever listens at the door of `key`; both callbacks come by the event loop.

        Returns:
            The question's number, to be forgotten (`forget`); None where nobody listens.
        """
        if self._wire.closed or self._wire.config.mode != "peer":
            # For whom a router stands between, each way would be kept there too.
            return None
        door = door_of(key)
        way = self._ways.get(door) or self._way(door)
        number = next(self._numbers)
        # Before it is looked whether anybody listens: who goes after that look ends it.
        self._waiting[number] = _Waiting(way, on_reply, on_gone)
        if not way.open:
            self._waiting.pop(number, None)
            return None
        if self._listening is None:
            self._listen()
        try:
            self._put(way, number, key, payload)
        except zenoh.ZError as error:
            link.not_sent(key, error)
        return number

    def _put(self, way: Way, number: int, key: str, payload: bytes) -> None:
        way.put(payload, attachment=b"%d %s %s" % (number, self._session_text, key.encode()))

    def known_way(self, key: str) -> Way | None:
        """The way to the door of `key`, where it is known that somebody listens; from any thread."""
        way = None if self._wire.closed or self._listening is None else self._ways.get(door_of(key))
        return way if way is not None and way.listened else None

    def make_way(self, key: str) -> None:
        """Have the way to the door of `key` ready before the first question; on the event loop's thread."""
        if not self._wire.closed and self._wire.config.mode == "peer" and len(self._ways) < _MOST_WAYS:
            door = door_of(key)
            way = self._ways.get(door) or self._way(door)
            if not way.listened:
                way.look()

    def ask_here(
        self,
        way: Way,
        key: str,
        payload: bytes,
        on_reply: Callable[[bytes | None, SwiftbotError | None], None],
        on_gone: Callable[[], None],
    ) -> int | None:
        """Do the same from any thread; both callbacks come on Zenoh's, and must not wait.

        Returns:
            The question's number; None: nobody listens any more, it is too large for a message, or could not be sent.
        """
        if len(payload) > link.MOST_DIRECT:
            return None
        number = next(self._numbers)
        self._waiting[number] = _Waiting(way, on_reply, on_gone, here=True)
        if way.listened:
            try:
                self._put(way, number, key, payload)
            except zenoh.ZError as error:
                link.not_sent(key, error)
            else:
                return number
        self._waiting.pop(number, None)
        return None

    def forget(self, number: int) -> None:
        """Wait for an answer no more."""
        waiting = self._waiting.pop(number, None)
        if waiting is not None:
            waiting.way.doubt()

    def _way(self, door: str) -> Way:
        while len(self._ways) >= _MOST_WAYS:
            _, oldest = self._ways.popitem(last=False)
            self._gone(oldest)
            oldest.close()
        way = self._ways[door] = Way(self._wire.raw, door, self._gone)
        return way

    def _gone(self, way: Way) -> None:
        """Nobody listens there any more; on a thread of Zenoh's."""
        for number, each in tuple(self._waiting.items()):
            if each.way is way and self._waiting.pop(number, None) is not None:
                self._deliver(each, each.on_gone)

    def _deliver(self, waiting: _Waiting, call: Callable[[], None], size: int = 0) -> None:
        if not waiting.here:
            self._wire.inbox.post(call, size, must=True)
            return
        try:
            call()
        except Exception:  # supervision boundary: a defect of whoever asked must not end what Zenoh has to tell others
            log.exception("whoever asked failed", door=waiting.way.door)

    def _listen(self) -> None:
        if self._listening is None:
            expr = self._wire.keys.answers(self._session)
            handler = threads.callback(self._take_answer)
            self._listening = self._wire.raw.declare_subscriber(expr, handler)

    def _take_answer(self, sample: zenoh.Sample) -> None:
        attached = sample.attachment
        raw = attached.to_bytes() if attached is not None else b""
        kind, number = raw[:1], raw[1:]
        waiting = self._waiting.pop(int(number), None) if number.isdigit() and len(number) < _LONGEST else None
        if waiting is None:
            return  # late, or nobody's
        data = sample.payload
        if kind == _ANSWERED and len(data) <= link.MOST_DIRECT:
            self._deliver(waiting, partial(waiting.on_reply, data.to_bytes(), None), len(data))
        else:
            error = link.error_from(data.to_bytes()[: link.MOST_ERROR])
            self._deliver(waiting, partial(waiting.on_reply, None, error))

    # --- answering --------------------------------------------------------------------------------------------

    def serve(self, key: str, take: Callable[[Asked, zenoh.ZBytes], None]) -> Closer:
        """Have the direct questions for `key` delivered, on Zenoh's threads."""
        self._listen()
        name = door_of(key)
        door = self._served.get(name)
        if door is None:
            door = self._served[name] = _Door({}, name, self._wire.raw.declare_subscriber(name, self._deliverer(name)))
        door.takes[key.encode()] = take

        def end() -> None:
            door.takes.pop(key.encode(), None)
            if not door.takes and self._served.get(name) is door:
                del self._served[name]
                door.subscriber.undeclare()

        return Closer(end)

    def _deliverer(self, name: str) -> "zenoh.handlers.Callback[zenoh.Sample]":
        beside = name.rpartition("/")[0].encode()
        malformed, misrouted = f"malformed {self._wire.name(name)}", f"misrouted {self._wire.name(name)}"

        def deliver(sample: zenoh.Sample) -> None:
            attached = sample.attachment
            asked = _read(attached.to_bytes()) if attached is not None else None
            door = self._served.get(name)
            if asked is None:
                self._wire.inbox.post(partial(self._wire.refuse, malformed, reason="it does not say who asks what"))
                return
            take = None if door is None else door.takes.get(asked.key)
            if take is not None:
                take(asked, sample.payload)
                return
            if asked.key.rpartition(b"/")[0] != beside:
                self._wire.inbox.post(partial(self._wire.refuse, misrouted, key=repr(asked.key[:_MOST_KEY])))
            # Asked again as a query it is refused, and whoever asked learns by whom.
            self.answer(asked, b"", None)

        return threads.callback(deliver)

    def answer(self, asked: Asked, answer: bytes | None, error: SwiftbotError | None) -> None:
        """Answer a question, from any thread; with nothing where it is to be asked again as a query."""
        if error is not None or answer is None:
            kind, body = _FAILED, link.error_body(error or SwiftbotError("no answer"))
        else:
            kind, body = _ANSWERED, b"" if len(answer) > link.MOST_DIRECT else answer
        try:  # noqa: SIM105 - this is in the way of every copy of a record
            self._wire.raw.put(
                self._answers + asked.session,
                body,
                attachment=b"%s%d" % (kind, asked.number),
                congestion_control=_DROP,
                priority=_HIGH,
                express=True,
            )
        except zenoh.ZError:
            pass


def _read(attached: bytes) -> Asked | None:
    """What a question says of itself; None where that is not to be read."""
    number, _, rest = attached.partition(b" ")
    session, _, key = rest.partition(b" ")
    if not number.isdigit() or not 1 <= len(session) <= _LONGEST or len(number) >= _LONGEST:
        return None
    # It becomes part of a key: nothing else may be.
    return Asked(int(number), session.decode(), key) if _SESSION.issuperset(session) else None
