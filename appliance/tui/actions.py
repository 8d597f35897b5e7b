"""What a person can do in the terminal UI: the one list that feeds keys, footer, help and the command palette."""

from msgspec import Struct
from textual.binding import Binding


class Action(Struct, frozen=True, kw_only=True):
    """Something a person can do. `call` is the app's action in Textual's notation, `keys` comma-separated."""

    call: str
    keys: str
    shown: str
    """The keys as people write them."""
    title: str
    help: str
    footer: bool = True


ACTIONS: tuple[Action, ...] = (
    Action(call="show('fleet')", keys="1", shown="1", title="Fleet", help="Gateways and robots"),
    Action(call="show('tasks')", keys="2", shown="2", title="Tasks", help="Tasks; the selected one with its plan"),
    Action(call="show('pool')", keys="3", shown="3", title="Pool", help="Containers of all gateways"),
    Action(call="show('log')", keys="4", shown="4", title="Log", help="Notices, runs and log lines"),
    Action(call="submit", keys="s,colon", shown="s :", title="Submit", help="Plan an instruction, look at it, run it"),
    Action(call="cancel_task", keys="c", shown="c", title="Cancel", help="Cancel the selected task (asks first)"),
    Action(call="filter", keys="slash", shown="/", title="Filter", help="Show only rows that contain a text"),
    Action(
        call="clear_filter", keys="escape", shown="Esc", title="Clear filter", help="Show all rows again", footer=False
    ),
    Action(
        call="switch_focus",
        keys="tab",
        shown="Tab",
        title="Next part",
        help="Go to the next table or the detail",
        footer=False,
    ),
    Action(call="help", keys="question_mark", shown="?", title="Help", help="This list"),
    Action(call="quit", keys="q", shown="q", title="Quit", help="Leave; the fleet goes on"),
)


def bindings() -> list[Binding]:
    """Return the actions as key bindings."""
    return [
        Binding(action.keys, action.call, action.title, show=action.footer, key_display=action.shown.split()[0])
        for action in ACTIONS
    ]
