"""The help, made from the registry of actions: keys and commands of the screen it was asked on first."""

from collections.abc import Mapping

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding
from textual.screen import ModalScreen
from textual.widgets import Label, Static

from appliance.tui import signs
from appliance.tui.action import Action, key_name
from appliance.tui.actions import ACTIONS
from appliance.tui.keys import keys_of
from appliance.tui.widgets import Pane


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
        ("Signs\n", "bold"), signs.LEGEND, "\n! asks first · w needs the UI unlocked (:write); it starts read-only"
    )
    return Group(*parts, legend)


def _table(found: list[Action], own: Mapping[str, str]) -> Table:
    table = Table(box=None, pad_edge=False, show_header=False, expand=True)
    table.add_column(width=8, no_wrap=True)
    table.add_column(width=3, no_wrap=True)
    table.add_column(ratio=1)
    for action in found:
        keys = " ".join(key_name(key) for key in keys_of(action, own))
        marks = f"{'!' if action.dangerous else ''}{'w' if action.writes else ''}"
        words = Text.assemble(action.help, "  ", (action.usage, "dim"))
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
