"""What the terminal UI asks: an instruction and whether its plan is wanted, whether something dangerous is meant."""

from io import StringIO

from rich.console import Console, RenderableType
from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding
from textual.containers import Vertical
from textual.screen import ModalScreen
from textual.widgets import Label, Static

from appliance.tui.safe import safe
from appliance.tui.widgets import Pane

LONGEST_PIECE = 4000
"""Characters of one piece of text in a line that was laid out."""


class ConfirmDialog(ModalScreen[bool]):
    """Asks yes or no; no is the answer of every key but y and Enter."""

    BINDINGS = [
        Binding("y,enter", "answer(True)", "Yes"),
        Binding("n,escape,q", "answer(False)", "No"),
    ]

    def __init__(self, question: str) -> None:
        super().__init__()
        self._question = question

    def compose(self) -> ComposeResult:
        """Make the dialog."""
        with Vertical(classes="dialog small"):
            yield Static(Text(self._question), classes="title")
            yield Static("y or Enter: yes · n or Esc: no", id="hint")

    def action_answer(self, yes: bool) -> None:
        """Give the answer."""
        self.dismiss(yes)


class TextDialog(ModalScreen[None]):
    """Something to be read at leisure, which was asked for.

    Args:
        title: above it.
        content: what Rich can render; control characters in it are shown and not obeyed.
    """

    BINDINGS = [Binding("escape,q,enter", "leave", "Leave")]

    def __init__(self, title: str, content: RenderableType) -> None:
        super().__init__()
        self._title = title
        self._content = content

    def compose(self) -> ComposeResult:
        """Make the dialog."""
        with Pane(classes="dialog"):
            yield Label(Text(self._title), classes="title")
            yield Static(id="content")
            yield Static("Esc leaves", id="hint")

    def on_mount(self) -> None:
        """Let the arrow keys scroll."""
        self.query_one(Pane).focus()

    def on_resize(self) -> None:
        """Lay the text out for the window."""
        width = max(20, self.query_one(Pane).size.width - 3)
        self.query_one("#content", Static).update(harmless(self._content, width))

    def action_leave(self) -> None:
        """Close it."""
        self.dismiss(None)


def harmless(content: RenderableType, width: int) -> Text:
    """Return what Rich makes of something at a width, each piece made safe: Rich lets escape sequences through."""
    console = Console(width=width, color_system=None, file=StringIO(), legacy_windows=False)
    found = Text()
    if isinstance(content, str):
        content = Text(content)  # as a string it would be markup
    for line in console.render_lines(content, pad=False):
        for segment in line:
            if not segment.control:
                found.append(safe(segment.text, LONGEST_PIECE, blanks=True), segment.style)
        found.append("\n")
    return found
