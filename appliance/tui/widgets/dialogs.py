"""Dialogs of the terminal UI: an instruction, whether something dangerous is meant, and the help.

The help is made from the registry of actions: keys and commands of the screen it was asked on first.
"""

from collections.abc import Mapping
from io import StringIO

from rich.console import Console, Group, RenderableType
from rich.table import Table
from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding
from textual.containers import Vertical
from textual.screen import ModalScreen
from textual.widgets import Label, Static

from appliance.model.roles import Role
from appliance.operations import Operation
from appliance.tui import status_styles
from appliance.tui.actions import ACTIONS, key_name, keys_of
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


def help_text(scope: str, own: Mapping[str, str]) -> RenderableType:
    """Return the help for a screen, with a person's own keys."""
    here = [action for action in ACTIONS if scope in action.screens]
    general = [action for action in ACTIONS if not action.screens]
    elsewhere = [action for action in ACTIONS if action.screens and scope not in action.screens]
    parts: list[RenderableType] = []
    for title, found in (("On this screen", here), ("Everywhere", general), ("On other screens", elsewhere)):
        if found:
            parts += [Text(title, "bold"), _table(found, own)]
    legend = Text.assemble(
        ("Signs\n", "bold"),
        status_styles.LEGEND,
        "\n! asks first · w needs the UI unlocked (:write); it starts read-only\n"
        "operator, engineer: the least role that may do it, where there are keys; all else is open to viewers",
    )
    return Group(*parts, legend)


def _table(found: list[Operation], own: Mapping[str, str]) -> Table:
    table = Table(box=None, pad_edge=False, show_header=False, expand=True)
    table.add_column(width=8, no_wrap=True)
    table.add_column(width=3, no_wrap=True)
    table.add_column(ratio=1)
    for action in found:
        keys = " ".join(key_name(key) for key in keys_of(action, own))
        marks = f"{'!' if action.dangerous else ''}{'w' if action.writes and not action.always else ''}"
        words = Text.assemble(action.help, "  ", (action.usage, "dim"))
        if action.role is not Role.VIEWER:
            words.append(f"  {action.role}", "yellow")
        if action.screens:
            words.append(f"  on {', '.join(action.screens)}", "dim")
        table.add_row(Text(keys, "bold cyan"), Text(marks, "yellow"), words)
    return table


class HelpDialog(ModalScreen[None]):
    """All actions with their keys, and what the signs mean."""

    BINDINGS = [Binding("escape,q,question_mark,enter", "leave", "Leave")]

    def __init__(self, scope: str, own: Mapping[str, str]) -> None:
        super().__init__()
        self._scope = scope
        self._own = own

    def compose(self) -> ComposeResult:
        """Make the dialog out of the registry."""
        with Pane(classes="dialog"):
            yield Label("Keys and commands", classes="title")
            yield Static(help_text(self._scope, self._own), id="keys")
            yield Static("Esc leaves", id="hint")

    def on_mount(self) -> None:
        """Let the arrow keys scroll."""
        self.query_one(Pane).focus()

    def action_leave(self) -> None:
        """Close the help."""
        self.dismiss(None)
