"""Write what follows from the registry: the tables of `docs/tui.md`, and `docs/commands.md`.

Each table of docs/tui.md stands between `<!-- NAME -->` and `<!-- end -->`; the text around them is written by hand.

Usage: write_actions.py [--check]
"""

import inspect
import re
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

from cyclopts import App
from write_configuration import fields

from appliance.cli import app
from appliance.operations import OPERATIONS
from appliance.tui import themes
from appliance.tui.actions import ACTIONS, SCREENS, names, shown

ROOT = Path(__file__).resolve().parent.parent
TARGET = ROOT / "docs" / "tui.md"
COMMANDS = ROOT / "docs" / "commands.md"
HEAD = """# Commands

Every command of the product, by noun; `--help` lists its options. A subtask is written `TASK/SUBTASK`, such as
`t-1f3a/s2`. Commands that speak to a fleet take `--fleet`, `--dir` and `--connect` (or `SWIFTBOT_FLEET`,
`SWIFTBOT_DIR`, `SWIFTBOT_CONNECT`); those that print data print JSON with `--json`, all fields of it, also those that
have their default. An error is then JSON too, the last line of standard error: `{"error": {"code", "message",
"remedy", "problems", "exit_code"}}`. What commands print is described in `docs/schemas/commands`.

`role` is the least that may do it where there are keys ([security.md](security.md)), `UI` which command and key of the
[terminal UI](tui.md) do the same, `audit` the verb that gateways record.
This page is made by `scripts/write_actions.py`; do not edit it.
"""


def actions() -> str:
    """All actions, as the help of the UI has them."""
    rows = [
        (
            f"`{shown(action)}`" if action.keys else "",
            f"`{action.usage}`",
            ", ".join(action.screens) or "everywhere",
            "".join(
                mark
                for mark, holds in (("asks first, ", action.dangerous), ("writes", action.writes and not action.always),
                                    ("always works", action.always))
                if holds
            ),
            action.help,
        )
        for action in ACTIONS
    ]  # fmt: skip
    return _table(("key", "command", "screens", "", "what it does"), rows)


def screens() -> str:
    """The screens with their keys."""
    rows = [(f"`{number}`", title, shows) for number, (title, shows) in enumerate(SCREENS.values())]
    return _table(("key", "screen", "what it shows"), rows)


def looks() -> str:
    """The themes."""
    return _table(("theme", "what it is for"), [(f"`{look.name}`", look.help) for look in themes.LOOKS])


def settings() -> str:
    """What a person's own file may set."""
    rows = [
        (f"`{key}`", f"`{default}`", text) for key, _, default, text in fields("appliance.tui.settings", "TuiConfig")
    ]
    return _table(("key", "default", "meaning"), rows)


def keys() -> str:
    """What besides actions can be given other keys."""
    actions = {action.name for action in ACTIONS}
    rows = [(f"`{name}`", f"`{','.join(usual)}`") for name, usual in names().items() if name not in actions]
    return _table(("name", "usual keys"), rows)


def _table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    head = tuple(head)
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(each.replace("|", "\\|") for each in line) + " |" for line in lines)


def page(text: str) -> str:
    """Return the page with its tables made again."""
    tables = {
        "actions": actions(), "screens": screens(), "themes": looks(), "settings": settings(), "keys": keys(),
    }  # fmt: skip
    for name, table in tables.items():
        pattern = rf"(<!-- {name} -->\n)(?:\|[^\n]*\n)*(<!-- end -->)"
        text = re.sub(pattern, lambda found, table=table: f"{found[1]}{table}\n{found[2]}", text)
    return text


def commands() -> str:
    """The page of commands: one table for each noun, and one for the commands without."""
    by_noun: dict[str, list[tuple[str, ...]]] = {}
    for path, command in leaves(app):
        if not (command.default_command or main).__module__.startswith("appliance."):
            continue  # of the workshop
        operations = [operation for operation in OPERATIONS if operation.command == " ".join(path)]
        first = operations[0] if operations else None
        arguments = " ".join(_positional(command))
        ui = f"`:{first.name}` {shown(first)}".rstrip() if first is not None and first.name else ""
        row = (
            f"`swiftbot {' '.join((*path, arguments)).rstrip()}`",
            _first_sentence(command),
            str(first.role) if first is not None else "",
            ui,
            f"`{first.audit}`" if first is not None and first.audit else "",
        )
        by_noun.setdefault(path[0] if len(path) > 1 else "", []).append(row)
    head = ("command", "what it does", "role", "UI", "audit")
    parts = [HEAD]
    for noun, rows in sorted(by_noun.items()):
        parts.append(f"## {noun.capitalize() or 'Without a noun'}\n\n{_table(head, rows)}\n")
    return "\n".join(parts)


def leaves(parent: App, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], App]]:
    """Yield the commands of an application that do something, with their words."""
    for name in sorted(parent):
        if name.startswith("-"):
            continue
        command = parent[name]
        if command.default_command is not None and not list(_subcommands(command)):
            yield (*path, name), command
        yield from leaves(command, (*path, name))


def _subcommands(command: App) -> Iterator[str]:
    return (name for name in command if not name.startswith("-"))


def _positional(command: App) -> Iterator[str]:
    for parameter in inspect.signature(command.default_command).parameters.values():  # pyright: ignore[reportArgumentType]
        word = parameter.name.upper()
        if parameter.kind is inspect.Parameter.VAR_POSITIONAL:
            yield f"[{word}…]"
        elif parameter.kind is inspect.Parameter.POSITIONAL_ONLY:
            yield word if parameter.default is inspect.Parameter.empty else f"[{word}]"


def _first_sentence(command: App) -> str:
    text = (inspect.getdoc(command.default_command) or "").split("\n\n")[0].replace("\n", " ")
    return text.removesuffix(".")


def main() -> int:
    """Write the pages, or with --check say whether they are up to date."""
    text = TARGET.read_text()
    if "--check" in sys.argv:
        return 0 if text == page(text) and COMMANDS.read_text() == commands() else 1
    TARGET.write_text(page(text))
    COMMANDS.write_text(commands())
    return 0


if __name__ == "__main__":
    sys.exit(main())
