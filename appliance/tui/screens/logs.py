"""The screen of the log: notices, news of runs and log lines as they come; or what is put on keys that are typed.

`Listening` listens to any key of the plane, or of the log that is replayed, and goes on after a reconnect.
"""

from typing import Protocol, runtime_checkable

from rich.text import Text
from textual.app import ComposeResult
from textual.widgets import Static

from appliance.errors import PayloadError, SwiftbotError
from appliance.model.keys import ROOT
from appliance.plane.session import Closer, Message, Session
from appliance.reasons import time_of_day
from appliance.tui import status_styles
from appliance.tui.actions import bindings
from appliance.tui.base_screen import FleetScreen
from appliance.tui.formatting import Heard, heard, line_text, plain, said
from appliance.tui.replay import Tap
from appliance.tui.store import Entry, Store
from appliance.tui.subscriptions import View
from appliance.tui.widgets.log_view import LineView, Tail

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


MOST = 2000
"""Lines kept, of each kind."""
FEED_S = 0.5
"""How often lines are taken over while the screen is not seen."""


def entry_text(entry: Entry) -> Text:
    """Return a line of the log screen."""
    sign = status_styles.level("notice" if entry.kind == "notice" else entry.level)
    return Text.assemble(
        (time_of_day(entry.at_ns), "dim"),
        " ",
        (f"{entry.kind:<6}", "bold"),
        " ",
        (f"{entry.source[:14]:<14}", "cyan"),
        f" {sign.glyph} ",
        (entry.text, sign.style),
        no_wrap=True,
        end="",
    )


def entry_plain(entry: Entry) -> str:
    """Return a line as filters see it."""
    return f"{time_of_day(entry.at_ns)} {entry.kind} {entry.level} {entry.source} {entry.text}"


def heard_text(message: Heard) -> Text:
    """Return a line of any key."""
    return line_text(said(message))


class LogScreen(FleetScreen):
    """Lines as they come, capped; a filter chooses before the cap does."""

    scope = "log"
    shows = ("entries",)
    BINDINGS = bindings("log")

    def __init__(self) -> None:
        super().__init__()
        self.entries: Tail[Entry] = Tail(MOST, entry_plain)
        self.heard: Tail[Heard] = Tail(MOST, plain)
        self._listening = Listening(self.heard)
        self._last = 0
        self._drawn_lines: object = None
        self._on_log: LineView[Entry] = LineView(entry_text, lambda entry: entry.serial, id="lines")
        self._on_keys: LineView[Heard] = LineView(heard_text, lambda message: message.number, id="heard")

    def title_of(self) -> str:
        """Return the keys that are listened to."""
        return self._listening.expression

    def body(self) -> ComposeResult:
        """Make the parts."""
        yield Static(id="what")
        yield self._on_log
        yield self._on_keys

    def on_mount(self) -> None:
        """Begin to take lines over."""
        self._on_keys.display = False
        self.set_interval(FEED_S, self._feed)

    def _feed(self) -> None:
        """Take over what has come, seen or not: a filter's rare line must not be lost to the store's own bound."""
        store = self.store
        if store.entries and store.entries[-1].serial < self._last:
            self._last = 0
            self.entries.clear()
        for entry in store.entries:
            if entry.serial > self._last:
                self.entries.put(entry)
        if store.entries:
            self._last = store.entries[-1].serial
        self._listening.check(self.view)
        if self.is_current:
            self._draw_lines()

    def draw_body(self, store: Store) -> None:
        """Show the lines."""
        _ = store
        self.entries.set_filter(self.filter)
        self.heard.set_filter(self.filter)
        self._feed()
        self._draw_lines()

    @property
    def window(self) -> LineView[Entry] | LineView[Heard]:
        """What is seen: the log, or what is heard on keys."""
        return self._on_keys if self._listening.expression else self._on_log

    def _draw_lines(self) -> None:
        window = self.window
        on_keys = window is self._on_keys
        lines, count = (self.heard.lines, self.heard.count) if on_keys else (self.entries.lines, self.entries.count)
        revision = self.heard.revision if on_keys else self.entries.revision
        drawn = (on_keys, revision, window.following, self._listening.problem)
        if drawn == self._drawn_lines:
            return
        self._drawn_lines = drawn
        empty = "no line matches the filter" if self.filter and count else "no line has come yet"
        if on_keys:
            self._on_keys.show(self.heard.lines, empty=self._listening.problem or empty)
        else:
            self._on_log.show(self.entries.lines, empty=empty)
        what = self._listening.expression or "notices, runs, log lines"
        state = "follows" if window.following else "stays: f follows"
        self.query_one("#what", Static).update(
            Text(f"{what} · {len(lines)} of {count} lines · {state}", no_wrap=True, overflow="ellipsis")
        )

    # --- actions -----------------------------------------------------------------------------------------------------

    def do_follow(self, _given: object) -> None:
        """Stay at the newest line, or where it is."""
        self.window.follow(on=not self.window.following)
        self._draw_lines()

    def do_listen(self, given: dict[str, str]) -> None:
        """Listen to the keys of an expression; without one, to the log again."""
        text = given.get("keys", "")
        if not text:
            self._listening.stop()
            self._listening.expression = self._listening.problem = ""
        else:
            try:
                expression = expression_of(text, self.view.fleet)
            except PayloadError as error:
                self.notify(f"{error.message}\n→ {error.remedy}", severity="error", markup=False)
                return
            self._listening.listen(expression, self.view)
        on_keys = bool(self._listening.expression)
        self._on_keys.display = on_keys
        self._on_log.display = not on_keys
        self.window.focus()
        self.flush(force=True)

    def do_write_keys(self, _given: object) -> None:
        """Have an expression written."""
        self.prompt.open(":", f"listen {self._listening.expression}", "keys such as gw/*/log or robot/rover_1/**")

    def do_wipe(self, _given: object) -> None:
        """Forget the lines that are shown."""
        (self.heard if self._listening.expression else self.entries).clear()
        self.flush(force=True)

    def on_unmount(self) -> None:
        """Listen no more."""
        self._listening.stop()
