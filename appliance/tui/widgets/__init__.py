"""Textual's own widgets as they are used here: a field, a box that scrolls, a bar, and the prompt at the bottom.

In the prompt `/` filters and `:` commands are written, with completion and history. Larger widgets have modules of
their own: `grid`, `map`, `log_view`, `dialogs`.

Terminal multiplexers keep control keys for themselves (`screen` takes ^a, `tmux` ^b, both may take any other), so each
one that does something here has a name under which it is given other keys (`actions.keymap`).
"""

from collections.abc import Callable, Sequence

from rich.text import Text
from textual import events, on
from textual.app import ComposeResult
from textual.binding import Binding
from textual.containers import Vertical, VerticalScroll
from textual.message import Message
from textual.widgets import Input, Static

from appliance.tui.actions import line_bindings
from appliance.tui.part_keys import PANE, part_bindings
from appliance.tui.safe import clip


class Field(Input, inherit_bindings=False):
    """A line in which something is written."""

    BINDINGS = line_bindings()  # pyright: ignore[reportAssignmentType] - Textual wants a list of its own union

    def joined(self, lines: Sequence[str]) -> str:
        """Return lines that were pasted as one: Textual would keep the first of them alone."""
        return " ".join(lines)

    def _on_paste(self, event: events.Paste) -> None:
        lines = [line.strip() for line in event.text.splitlines()]
        text = self.joined([line for line in lines if line]) if len(lines) > 1 else event.text
        event.stop()
        event.prevent_default()
        if text:
            start, end = sorted(self.selection)
            self.replace(text, start, end)


class Pane(VerticalScroll, inherit_bindings=False):
    """A part of a screen that scrolls; without Textual's keys for scrolling sideways, which it has no use for."""

    BINDINGS = part_bindings(PANE)


class Bar(Static):
    """Lines of names that can be clicked, in their own colours: Textual would underline all of it, as links."""

    def __init__(self, *, id: str) -> None:  # noqa: A002 - Textual's name
        super().__init__(id=id)
        self.auto_links = False


LONGEST = 2000
"""Characters of a line."""
KEPT = 200
"""Lines remembered."""

Complete = Callable[[str], tuple[str, ...]]
"""Gives whole lines that go on from what was typed."""


def shared(texts: Sequence[str]) -> str:
    """Return the beginning that all have in common."""
    first, last = min(texts, default=""), max(texts, default="")
    for index, character in enumerate(first):
        if last[index : index + 1] != character:
            return first[:index]
    return first


class Lines:
    """Command lines written before, and a place among them; bounded."""

    def __init__(self) -> None:
        self._lines: list[str] = []
        self._at = 0
        self._draft = ""

    def add(self, line: str) -> None:
        """Remember a line; the same again is remembered once."""
        if line and (not self._lines or self._lines[-1] != line):
            self._lines = [*self._lines[-KEPT + 1 :], line]
        self._at, self._draft = len(self._lines), ""

    def step(self, step: int, now: str) -> str:
        """Return the line before (-1) or after (1); what was being written comes back after the last."""
        if self._at == len(self._lines):
            self._draft = now
        self._at = max(0, min(len(self._lines), self._at + step))
        return self._lines[self._at] if self._at < len(self._lines) else self._draft


class PromptInput(Field):
    """The field itself: Tab completes, the arrows bring back earlier lines, Esc leaves."""

    BINDINGS = [
        Binding("tab", "complete", show=False),
        Binding("up", "earlier(-1)", show=False),
        Binding("down", "earlier(1)", show=False),
        Binding("escape", "leave", show=False),
    ]

    def _prompt(self) -> "Prompt":
        prompt = self.parent
        assert isinstance(prompt, Prompt)  # noqa: S101 - only made there
        return prompt

    def action_complete(self) -> None:
        """Go on with what all completions have in common, or the next of them."""
        self._prompt().complete()

    def action_earlier(self, step: int) -> None:
        """Bring back another line."""
        self._prompt().earlier(step)

    def action_leave(self) -> None:
        """Leave without doing anything."""
        self._prompt().leave()


class Prompt(Vertical):
    """The prompt of a screen; hidden while nothing is written and no filter is set."""

    class Line(Message):
        """A note about the text."""

        def __init__(self, kind: str, text: str) -> None:
            super().__init__()
            self.kind = kind
            self.text = text

    class Typed(Line):
        """It has changed."""

    class Entered(Line):
        """Enter was pressed."""

    class Left(Line):
        """Esc was pressed."""

    def __init__(self, complete: Complete, lines: Lines) -> None:
        super().__init__(id="prompt")
        self._complete = complete
        self._lines = lines
        self._found: tuple[str, ...] = ()
        self._turn = -1
        self._ours = ""
        """What completion has put there; what differs was typed."""
        self.kind = ":"

    def compose(self) -> ComposeResult:
        """Make hints and field."""
        yield Static(id="hints")
        field = PromptInput(id="line", compact=True, max_length=LONGEST, select_on_focus=False)
        field.cursor_blink = False  # two writes a second to a terminal that may be far away
        yield field

    @property
    def field(self) -> PromptInput:
        """The field."""
        return self.query_one("#line", PromptInput)

    @property
    def writing(self) -> bool:
        """Whether a person types there."""
        return self.display and self.field.has_focus

    def open(self, kind: str, text: str = "", note: str = "") -> None:
        """Open it for a filter (`/`) or a command (`:`)."""
        self.kind = kind
        self.display = True
        field = self.field
        field.placeholder = (
            "filter: an expression, !expression for all others; Enter keeps it, Esc shows all"
            if kind == "/"
            else "command; Tab completes, ↑ earlier ones, Esc leaves"
        )
        field.value = text
        field.cursor_position = len(text)
        # At once, not with the next message: keys that were typed ahead would act on the screen instead.
        self.screen.set_focus(field)
        self._turn, self._ours = -1, text
        if note:
            self.hint(note)
        else:
            self._look()

    def hint(self, text: str) -> None:
        """Show a line above the field; nothing for an empty one."""
        hints = self.query_one("#hints", Static)
        hints.display = bool(text)
        hints.update(Text(text, no_wrap=True, overflow="ellipsis"))

    def close(self) -> None:
        """Hide it."""
        self.display = False
        self.hint("")

    # --- what is typed -----------------------------------------------------------------------------------------

    @on(Input.Changed)
    def _changed(self, event: Input.Changed) -> None:
        event.stop()
        if event.value != self._ours:
            self._turn = -1
            self._look()
        self.post_message(self.Typed(self.kind, event.value))

    @on(Input.Submitted)
    def _submitted(self, event: Input.Submitted) -> None:
        event.stop()
        if self.kind == ":":
            self._lines.add(event.value.strip())
        self.post_message(self.Entered(self.kind, event.value))

    def _look(self) -> None:
        """Show what may follow."""
        self._found = self._complete(self.field.value) if self.kind == ":" else ()
        last = [each.rstrip().rsplit(" ", 1)[-1] for each in self._found]
        self.hint(clip("  ".join(last), max(20, 2 * self.size.width or 80)) if last else "")

    def complete(self) -> None:
        """Go on with what all completions have in common; once there, one after the other."""
        if self.kind != ":" or not self._found:
            return
        common = shared(self._found)
        if self._turn < 0 and len(common) > len(self.field.value):
            self._put(common)
            if len(self._found) == 1:
                self._look()
            return
        self._turn = (self._turn + 1) % len(self._found)
        self._put(self._found[self._turn])

    def earlier(self, step: int) -> None:
        """Bring back another line."""
        if self.kind == ":":
            self._put(self._lines.step(step, self.field.value))

    def _put(self, text: str) -> None:
        self._ours = text
        self.field.value = text
        self.field.cursor_position = len(text)

    def leave(self) -> None:
        """Leave it."""
        self.post_message(self.Left(self.kind, self.field.value))
