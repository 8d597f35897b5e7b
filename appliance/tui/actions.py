"""The terminal UI's side of the registry of operations: its own actions, and keys, footer and help of all of them.

What the fleet does is registered in `appliance.operations`; here are the screens, the editing of plans, logs, replay
and the window itself, each an `Operation` with the `call` of a method of the application (`do_NAME`). Key bindings are
made from the registry and from a person's own settings.
"""

from collections.abc import Mapping
from dataclasses import replace

from textual.binding import Binding
from textual.widgets import Input

from appliance.errors import ConfigError
from appliance.operations import OPERATIONS, Argument, Operation
from appliance.tui.part_keys import taken as taken_by_parts

_KEY_NAMES = {
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
    if key in _KEY_NAMES:
        return _KEY_NAMES[key]
    if key.startswith("ctrl+"):
        return f"^{key.removeprefix('ctrl+')}"
    if len(key) > 1 and key[0] == "f" and key[1:].isdecimal():
        return key.upper()
    return key


def shown(operation: Operation) -> str:
    """Return the keys of an operation as people write them."""
    return " ".join(key_name(key) for key in operation.keys)


_STEP = Argument(kind="step", name="step")

REVIEW: tuple[Operation, ...] = (
    Operation(
        name="edit-robot",
        title="Robot",
        help="Have another robot do the subtask",
        keys=("r",),
        screens=("review",),
        takes=(_STEP, Argument(kind="robot", name="robot")),
        call="here edit_robot",
    ),
    Operation(
        name="edit-params",
        title="Params",
        help="Change the parameters of the subtask",
        keys=("e",),
        screens=("review",),
        takes=(_STEP, Argument(kind="text", name="parameters", optional=True, rest=True)),
        call="here edit_params",
    ),
    Operation(
        name="edit-after",
        title="After",
        help="Change what the subtask comes after",
        keys=("o",),
        screens=("review",),
        takes=(_STEP, Argument(kind="text", name="others", optional=True, rest=True)),
        call="here edit_after",
    ),
    Operation(
        name="edit-out",
        title="Drop",
        help="Take the subtask out of the plan",
        keys=("d",),
        screens=("review",),
        takes=(_STEP,),
        call="here edit_out",
    ),
    Operation(
        name="edit-up",
        title="Earlier",
        help="Have the subtask change places with the one before it",
        keys=("left_square_bracket",),
        screens=("review",),
        takes=(_STEP,),
        call="here edit_up",
        footer=False,
    ),
    Operation(
        name="edit-down",
        title="Later",
        help="Have the subtask change places with the one after it",
        keys=("right_square_bracket",),
        screens=("review",),
        takes=(_STEP,),
        call="here edit_down",
        footer=False,
    ),
    Operation(
        name="edit-undo",
        title="Undo",
        help="Go back one edit",
        keys=("u",),
        screens=("review",),
        call="here edit_undo",
    ),
    Operation(
        name="edit-reload",
        title="Reload",
        help="Look at the plan that waits now, without the edits",
        screens=("review",),
        call="here edit_reload",
        footer=False,
    ),
)

LOGS: tuple[Operation, ...] = (
    Operation(
        name="follow",
        title="Follow",
        help="Stay at the newest line, or where it is",
        keys=("f",),
        screens=("log",),
        call="here follow",
    ),
    Operation(
        name="listen",
        title="Keys",
        help="Show what is put on keys, such as `robot/rover_1/**`; without an expression the log again",
        screens=("log",),
        takes=(Argument(kind="text", name="keys", optional=True),),
        call="here listen",
        footer=False,
    ),
    Operation(
        name="keys",
        title="Keys",
        help="Write the keys that are to be shown",
        keys=("e",),
        screens=("log",),
        call="here write_keys",
    ),
    Operation(
        name="wipe",
        title="Wipe",
        help="Forget the lines that are shown",
        keys=("x",),
        screens=("log",),
        call="here wipe",
    ),
)


HISTORY: tuple[Operation, ...] = (
    Operation(
        name="older",
        title="Older",
        help="Load older tasks, also those of which only the outcome is kept",
        keys=("o",),
        screens=("tasks",),
        call="here older",
        footer=False,
    ),
)

REPLAY: tuple[Operation, ...] = (
    Operation(
        name="open",
        title="Open",
        help="Show a recorded log on all screens",
        takes=(Argument(kind="file", name="file"),),
        call="open",
        footer=False,
    ),
    Operation(
        name="live", title="Live", help="Leave the recorded log: show the fleet again", keys=("L",), call="live",
        recorded=True,
    ),
    Operation(
        name="play", title="Play", help="Play or pause", keys=("space",), call="replay play", recorded=True,
    ),
    Operation(
        name="behind", title="−10 s", help="Go ten seconds back", keys=("left", "left_square_bracket"),
        call="replay behind", recorded=True,
    ),
    Operation(
        name="ahead", title="+10 s", help="Go ten seconds on", keys=("right", "right_square_bracket"),
        call="replay ahead", recorded=True,
    ),
    Operation(
        name="slower", title="Slower", help="Play slower", keys=("minus",), call="replay slower", recorded=True,
    ),
    Operation(
        name="faster", title="Faster", help="Play faster", keys=("plus", "equals_sign"), call="replay faster",
        recorded=True,
    ),
    Operation(
        name="seek",
        title="Seek",
        help="Go to a moment: 90, 1:30, 50%, +10, -10",
        keys=("J",),
        takes=(Argument(kind="text", name="time"),),
        call="replay seek",
        recorded=True,
    ),
    Operation(
        name="rate",
        title="Rate",
        help="Play so many log seconds a second",
        takes=(Argument(kind="number", name="rate"),),
        call="replay rate",
        recorded=True,
        footer=False,
    ),
)  # fmt: skip
"""Their keys work on every screen while a recorded log is shown."""


SCREENS: dict[str, tuple[str, str]] = {
    "overview": ("Overview", "Alerts, robots on a map, tasks in work, load of gateways; Enter opens a row"),
    "fleet": ("Fleet", "Gateways: load, memory, pool, tasks, links; Enter shows one whole"),
    "tasks": ("Tasks", "Tasks; Enter opens one with the graph of its plan"),
    "robots": ("Robots", "Robots: mode, battery, position, mission; a map; Enter shows one whole"),
    "pool": ("Pool", "Containers by image, and why they were started and given up"),
    "llm": ("LLM", "Planning by language models: tiers, queue, speed, confidence"),
    "learning": (
        "Learning",
        "Runs of federated learning: rounds, loss, accuracy; Enter shows one with its clients",
    ),
    "log": ("Log", "Notices, runs and log lines as they come, or any keys"),
    "replay": ("Replay", "A recorded log on all screens: play, pause, seek, rate"),
}
"""Screens in the order of their number keys, from 0: title and what they show."""


def _screens() -> tuple[Operation, ...]:
    return tuple(
        Operation(name=name, title=title, help=shows, keys=(str(number),), call=f"screen {name}", footer=False)
        for number, (name, (title, shows)) in enumerate(SCREENS.items())
    )


WINDOW: tuple[Operation, ...] = (
    Operation(name="filter", title="Filter", help="Show rows that match an expression; !… all others", keys=("slash",),
           call="prompt /"),
    Operation(name="command", title="Command", help="Write a command; Tab completes, ↑ brings back earlier ones",
           keys=("colon",), call="prompt :"),
    Operation(name="back", title="Back", help="Leave what was opened; else show all rows again", keys=("escape",),
           call="back", footer=False),
    Operation(name="next", title="Next part", help="Go to the next table or text", keys=("tab",), call="next_part",
           footer=False),
    Operation(name="previous", title="Part before", help="Go to the table or text before", keys=("shift+tab",),
           call="previous_part", footer=False),
    Operation(name="copy", title="Copy", help="Copy what is marked with the mouse; else say how to leave",
           keys=("ctrl+c",), call="copy", footer=False),
    Operation(name="write", title="Unlock", help="Allow what changes the fleet", keys=("W",), call="unlock",
           footer=False),
    Operation(name="read", title="Lock", help="Read only: allow nothing that changes the fleet", keys=("R",),
           call="lock", footer=False),
    Operation(name="theme", title="Theme", help="Change the colours", keys=("T",),
           takes=(Argument(kind="theme", name="theme", optional=True),), call="theme", footer=False),
    Operation(name="picture", title="Picture", help="Write the screen as it is into an SVG file",
           takes=(Argument(kind="file", name="file"),), call="picture", footer=False),
    Operation(name="palette", title="Palette", help="All of these by name", keys=("ctrl+p",), call="command_palette",
           footer=False),
    Operation(name="help", title="Help", help="Keys, commands and signs", keys=("question_mark",), call="help"),
    Operation(name="quit", title="Quit", help="Leave; the fleet goes on", keys=("q", "ctrl+q"), call="quit",
           aliases=("q",)),
)  # fmt: skip

ACTIONS: tuple[Operation, ...] = (
    *_screens(), *(each for each in OPERATIONS if each.name), *REVIEW, *HISTORY, *LOGS, *REPLAY, *WINDOW,
)  # fmt: skip
"""Everything that a person can do here, in the order of help and footer."""
BY_NAME: dict[str, Operation] = {action.name: action for action in ACTIONS}


def of(scope: str) -> tuple[Operation, ...]:
    """Return the actions whose keys work on one screen and not everywhere."""
    return tuple(action for action in ACTIONS if scope in action.screens)


def everywhere() -> tuple[Operation, ...]:
    """Return the actions whose keys work on every screen."""
    return tuple(action for action in ACTIONS if not action.screens)


PROMPTS = ("command", "filter")
"""Actions that open a line to be written; not while something is written (`app.check_action`)."""


def bindings(scope: str = "") -> list[Binding]:
    """Return the bindings of one screen, or of all of them when none is named."""
    found = of(scope) if scope else everywhere()
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
    found = {action.name: action.keys for action in ACTIONS}
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
    _check_reach(own)
    taken: dict[tuple[str, str], str] = {}
    for action in ACTIONS:
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


def _check_reach(own: Mapping[str, str]) -> None:
    """Raise ConfigError where an action has no key left on one of its screens: a part there takes them all."""
    for action in ACTIONS:
        keys = keys_of(action, own)
        for scope in action.screens or (*SCREENS, "gateway", "task", "robot", "run"):
            if keys and set(keys) <= taken_by_parts(scope):
                raise ConfigError(
                    f"tui.keys.{action.name}: {', '.join(keys)} does something else on the screen {scope}",
                    remedy="choose a key that moves nothing there",
                )


def keys_of(action: Operation, own: Mapping[str, str]) -> tuple[str, ...]:
    """Return the keys of an action as a person has them."""
    if action.name in own:
        return _parts(own[action.name])
    return action.keys


def _parts(keys: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in keys.split(","))
