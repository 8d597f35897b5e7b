"""Listens to any key of the plane, or of the log that is replayed; goes on when the connection was made anew."""

from typing import Protocol, runtime_checkable

from appliance.errors import PayloadError, SwiftbotError
from appliance.plane.keys import ROOT
from appliance.plane.session import Closer, Message, Session
from appliance.tui.data import View
from appliance.tui.logs.lines import Heard, heard
from appliance.tui.logs.tail import Tail
from appliance.tui.replay.source import Tap

LONGEST = 500


@runtime_checkable
class Tapped(Protocol):
    """A view that hands out what it hears: a replayed log."""

    def tap(self, expression: str, take: Tap) -> Closer:
        """Have all messages of matching keys delivered."""
        ...


def expression_of(text: str, fleet: str) -> str:
    """Return a key expression as typed, made whole: `gw/*/log` means this fleet's.

    Raises:
        PayloadError: it is none.
    """
    typed = text.strip().strip("/")
    whole = typed if typed == ROOT or typed.startswith((f"{ROOT}/", "**")) else f"{ROOT}/{fleet}/{typed}"
    chunks = whole.split("/")
    wrong = ""
    if not typed or len(whole) > LONGEST:
        wrong = "it is empty" if not typed else f"it is longer than {LONGEST} characters"
    elif any(not chunk for chunk in chunks):
        wrong = "it has an empty chunk"
    elif any(character in whole for character in "#?") or "**/**" in whole:
        wrong = "it has a # or ?, or ** twice in a row"
    elif any("*" in chunk.replace("$*", "") and chunk not in ("*", "**") for chunk in chunks):
        wrong = "within a chunk write $* instead of *"
    elif "$" in whole.replace("$*", ""):
        wrong = "a $ stands before a * only"
    if wrong:
        raise PayloadError(
            f"{text[:60]!r} is no key expression: {wrong}", remedy="such as gw/*/log or robot/rover_1/**"
        )
    return whole


class Listening:
    """One expression, listened to into a tail.

    Args:
        tail: takes what is heard.
    """

    def __init__(self, tail: Tail[Heard]) -> None:
        self.tail = tail
        self.expression = ""
        self.problem = ""
        """Why nothing is heard; empty when it is listened to."""
        self._closer: Closer | None = None
        self._source: object = None

    def listen(self, expression: str, view: View) -> None:
        """Listen to another expression."""
        self.stop()
        self.expression = expression
        self.tail.clear()
        self.check(view)

    def stop(self) -> None:
        """Listen to nothing."""
        if self._closer is not None:
            self._closer.close()
        self._closer = None
        self._source = None

    def check(self, view: View) -> None:
        """Begin again where the connection, or the view, is another one; called now and then."""
        if not self.expression:
            return
        try:
            source: object = view if isinstance(view, Tapped) else view.orders.plane.session
        except SwiftbotError as error:
            self.problem = error.message
            self._source = None
            return
        if source is self._source:
            return
        self.stop()
        try:
            if isinstance(source, Tapped):
                self._closer = source.tap(self.expression, self._take)
            else:
                assert isinstance(source, Session)  # noqa: S101 - the other kind of source
                self._closer = source.subscribe(self.expression, self._hear)
        except Exception as error:  # noqa: BLE001 - Zenoh's own words on an expression that it refuses
            self.problem = f"{self.expression} cannot be listened to: {error}"
        else:
            self.problem = ""
        self._source = source

    def _take(self, key: str, at_ns: int, payload: bytes, deleted: bool) -> None:
        self.tail.put(heard(self.tail.count + 1, key, at_ns, payload, deleted=deleted))

    def _hear(self, message: Message) -> None:
        self._take(message.key, message.at_ns, message.payload, message.deleted)
