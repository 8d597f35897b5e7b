"""What an action of the terminal UI is: its name, keys and help, what it takes, and what comes of it.

An action either calls something of the UI itself (`call`) or asks something of the fleet (`do`). What it `takes` comes
from what is selected on the screen, or is written on the `:` line. Free of Textual, so that it is tested alone.
"""

from collections.abc import Awaitable, Callable, Mapping

from msgspec import Struct
from rich.console import RenderableType

from appliance.client import FleetClient
from appliance.model import TaskRecord

Given = Mapping[str, str]
Do = Callable[[FleetClient, Given, str], Awaitable[RenderableType | TaskRecord]]
"""Asks it of the fleet with the arguments given, in the name of an operator; returns what came of it: a sentence, the
task as it is now or, for a `long` one, something to be read."""


class Parameter(Struct, frozen=True, kw_only=True):
    """An argument of an action."""

    kind: str
    """What it is: gateway, robot, task, subtask (`task/subtask`), container, image, theme, number, text, file."""
    name: str
    optional: bool = False
    chosen: bool = False
    """Whether an optional one is taken from the selection as well."""
    absent: str = ""
    """What a confirmation calls it when it is not given."""
    rest: bool = False
    """Whether it is all that follows on the line."""

    @property
    def usage(self) -> str:
        """As help writes it."""
        word = f"{self.name.upper()}…" if self.rest else self.name.upper()
        return f"[{word}]" if self.optional else word


WHY = Parameter(kind="text", name="why", optional=True, rest=True)
"""Why an order is given, for the audit and for those who wonder."""


class Action(Struct, frozen=True, kw_only=True):
    """Something a person can do."""

    name: str
    """The command's word after the colon, and what `tui.keys` calls it."""
    title: str
    """What the footer says."""
    help: str
    keys: tuple[str, ...] = ()
    """In Textual's names."""
    screens: tuple[str, ...] = ()
    """Where its keys work; empty: everywhere."""
    takes: tuple[Parameter, ...] = ()
    aliases: tuple[str, ...] = ()
    writes: bool = False
    """Whether it changes anything in the fleet: not while the UI is read-only."""
    always: bool = False
    """Whether it works read-only all the same, and in dialogs and input fields: a stop must always work."""
    dangerous: bool = False
    """Whether it asks first, with `confirm`."""
    confirm: str = ""
    """What will happen, in plain words; `{…}` are its arguments."""
    sees_stops: bool = False
    """Whether its argument `stops` is the ids of the soft stops in force, with `/` between, as it was begun."""
    call: str = ""
    """Textual's action of the application; with `{…}` for arguments."""
    do: Do | None = None
    long: bool = False
    """Whether what comes of it is a text to be read at leisure, instead of a sentence."""
    footer: bool = True

    @property
    def usage(self) -> str:
        """The command line's form of it."""
        return " ".join([f":{self.name}", *(each.usage for each in self.takes)])

    @property
    def shown(self) -> str:
        """Its keys as people write them."""
        return " ".join(key_name(key) for key in self.keys)

    def sentence(self, given: Given) -> str:
        """Return what a confirmation says."""
        absent = {each.name: each.absent or f"any {each.name}" for each in self.takes}
        why = f" Why: {given['why']}" if given.get("why") else ""
        return f"{self.confirm.format_map(absent | dict(given))}{why}"

    def here(self, scope: str) -> bool:
        """Whether its keys work on a screen."""
        return not self.screens or scope in self.screens


_NAMES = {
    "question_mark": "?",
    "slash": "/",
    "colon": ":",
    "escape": "Esc",
    "tab": "Tab",
    "shift+tab": "⇧Tab",
    "enter": "Enter",
    "exclamation_mark": "!",
    "space": "Space",
    "delete": "Del",
    "left_square_bracket": "[",
    "right_square_bracket": "]",
    "plus": "+",
    "minus": "-",
    "equals_sign": "=",
    "left": "←",
    "right": "→",
}


def key_name(key: str) -> str:
    """Return a key as people write it."""
    if key in _NAMES:
        return _NAMES[key]
    if key.startswith("ctrl+"):
        return f"^{key.removeprefix('ctrl+')}"
    if len(key) > 1 and key[0] == "f" and key[1:].isdecimal():
        return key.upper()
    return key
