"""Key bindings made from the registry, and what a person's own settings make of them."""

from collections.abc import Mapping
from dataclasses import replace

from textual.binding import Binding
from textual.widgets import Input

from appliance.errors import ConfigError
from appliance.tui import actions
from appliance.tui.action import Action

PROMPTS = ("command", "filter")
"""Actions that open a line to be written; not while something is written (`app.check_action`)."""


def bindings(scope: str = "") -> list[Binding]:
    """Return the bindings of one screen, or of all of them when none is named."""
    found = actions.of(scope) if scope else actions.everywhere()
    return [
        Binding(
            ",".join(action.keys),
            f"app.act('{action.name}')",
            action.title,
            show=False,  # the frame has a footer of its own
            id=action.name,
            # A stop must be reached from dialogs and input fields as well; letters are for writing there.
            # The prompt is opened before the next key is given to anybody: what is typed ahead belongs into it.
            priority=action.name in PROMPTS or (action.always and all(len(key) > 1 for key in action.keys)),
        )
        for action in found
        if action.keys
    ]


DIALOG_KEYS: Mapping[str, str] = {"edit-first": "f2,ctrl+r"}
"""Keys of dialogs that are no actions of the registry, by the name under which they can be changed."""


def line_bindings() -> list[Binding]:
    """Return the editing keys of a line that is written, each with a name such as `line-delete-left-word`.

    They are Textual's own; the name is that of what they do there.
    """
    return [replace(each, id=_line_name(each)) for each in Input.BINDINGS if isinstance(each, Binding)]


def _line_name(binding: Binding) -> str:
    return "line-" + binding.action.replace("(True)", "-select").replace("_", "-")


def names() -> dict[str, tuple[str, ...]]:
    """Return all that can be given other keys: actions, keys of dialogs, editing keys; with their usual keys."""
    found = {action.name: action.keys for action in actions.ACTIONS}
    found |= {name: tuple(keys.split(",")) for name, keys in DIALOG_KEYS.items()}
    for each in line_bindings():
        found[str(each.id)] = (*found.get(str(each.id), ()), *each.key.split(","))
    return found


def keymap(own: Mapping[str, str]) -> dict[str, str]:
    """Return Textual's keymap for a person's own keys by action.

    Raises:
        ConfigError: no such action, no key, or two actions of one screen share a key.
    """
    for name, keys in own.items():
        if name not in names():
            raise ConfigError(f"tui.keys: there is no action {name!r}", remedy="`?` and docs/tui.md list them")
        if not all(part.strip() for part in keys.split(",")):
            raise ConfigError(f"tui.keys.{name}: {keys!r} names no key", remedy='write keys such as "ctrl+x,f9"')
    taken: dict[tuple[str, str], str] = {}
    for action in actions.ACTIONS:
        for key in keys_of(action, own):
            for scope in action.screens or ("",):
                other = taken.setdefault((scope, key), action.name)
                if other != action.name:
                    raise ConfigError(f"tui.keys: {key} is both {other} and {action.name}", remedy="change one of them")
    lines: dict[str, str] = {}
    for name, usual in names().items():
        if name.startswith("line-"):
            for key in _parts(own[name]) if name in own else usual:
                if (other := lines.setdefault(key, name)) != name:
                    raise ConfigError(f"tui.keys: {key} is both {other} and {name}", remedy="change one of them")
    return {name: ",".join(_parts(keys)) for name, keys in own.items()}


def keys_of(action: Action, own: Mapping[str, str]) -> tuple[str, ...]:
    """Return the keys of an action as a person has them."""
    if action.name in own:
        return _parts(own[action.name])
    return action.keys


def _parts(keys: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in keys.split(","))
