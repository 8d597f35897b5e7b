"""Manual pages: `swiftbot manual FOLDER` writes `swiftbot.1` and a page for each of its words, out of their help.

Pages are in the macros of man(7). `man swiftbot`, `man swiftbot-task`.
"""

import inspect
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from pathlib import Path

from cyclopts import App, Argument

from appliance import durable
from appliance.cli.common import HERE, TOOLS, Where
from appliance.errors import ConfigError, Exit

_OF_FLEETS = frozenset(("--dir", *(f"--{each.name}" for each in fields(Where))))
"""Options that commands which speak to a fleet share: each page has them once."""


def add_to(app: App) -> None:
    """Add this command."""

    def manual(folder: Path, /) -> int:
        """Write the manual pages of all commands; `man -l FOLDER/swiftbot.1` shows the first.

        Args:
            folder: Where they are written, such as /usr/local/share/man/man1; made where it is missing.
        """
        try:
            durable.make_folder(folder, mode=0o755)
            for name, text in pages(app).items():
                durable.write(folder / f"{name}.1", text.encode(), mode=0o644)
        except OSError as error:
            raise ConfigError(f"{error.filename or folder}: {error.strerror}", remedy="name another folder") from error
        return Exit.DONE

    app.command(manual, group=TOOLS)


def pages(app: App) -> Mapping[str, str]:
    """Return the text of each page by its name: the command line's own, and one for each of its words. Pure."""
    common = App(default_parameter=app.default_parameter)
    common.default(_speak)
    of_fleets = [
        line
        for each in common.assemble_argument_collection()
        if each.names[0] in _OF_FLEETS
        for line in _argument(each, {})
    ]
    words = {name: app[name] for name in sorted(_names(app))}
    listed = [line for name, command in words.items() for line in _item(f"{_title(app)}-{name}(1)", _about(command)[0])]
    found = {_title(app): _page(_title(app), app, [*_section("COMMANDS", listed), *_section("EXIT STATUS", _exits())])}
    for name, command in words.items():
        title = f"{_title(app)}-{name}"
        lines = [line for path, leaf in _leaves(command, (name,)) for line in _command(app, path, leaf)]
        shared = of_fleets if any("options of a fleet" in line for line in lines) else ()
        found[title] = _page(title, command, [*_section("COMMANDS", lines), *_section("OPTIONS OF A FLEET", shared)])
    return found


def _speak(*, where: Where = HERE) -> None:
    """Take the options of a fleet, and nothing else."""


def _page(title: str, command: App, rest: Sequence[str]) -> str:
    first, others = _about(command)
    lines = [
        f'.TH "{_text(title.upper())}" 1 "" "SwiftBot gateway" "SwiftBot gateway"',
        *_section("NAME", [f"{_text(title)} \\- {_text(first)}"]),
        *_section("DESCRIPTION", [line for each in (first, *others) for line in (".PP", _line(each))][1:]),
        *rest,
    ]
    return "\n".join(lines) + "\n"


def _command(app: App, path: tuple[str, ...], command: App) -> Iterator[str]:
    """Yield the lines of one command: how it is written, what it does, its arguments and options."""
    first, others = _about(command)
    arguments = [each for each in command.assemble_argument_collection() if each.show]
    positional = [each.names[0] for each in arguments if not each.names[0].startswith("-")]
    yield f'.SS "{_text(" ".join((_title(app), *path, *positional)))}"'
    for paragraph in (first, *others):
        yield ".PP"
        yield _line(paragraph)
    for each in arguments:
        if each.names[0] not in _OF_FLEETS:
            yield from _argument(each, _told(command))
    if any(each.names[0] in _OF_FLEETS for each in arguments):
        yield ".PP"
        yield _line("It takes the options of a fleet (below).")


def _argument(argument: Argument, told: Mapping[str, str]) -> list[str]:
    names = [name for name in argument.names if not name.startswith(("--no-", "--empty-"))]
    text = argument.parameter.help or told.get(argument.field_info.name, "")
    usual = argument.field_info.default
    if usual not in (inspect.Parameter.empty, None, False, (), ""):
        text = f"{text.removesuffix('.')}. Default: {usual}.".removeprefix(". ")
    return _item(", ".join(names), text)


def _told(command: App) -> Mapping[str, str]:
    """Return what a command's help says of its parameters, by their names."""
    lines = inspect.cleandoc(command.help or "").partition("\nArgs:\n")[2]
    return dict(re.findall(r"^ +\*?(\w+): (.*)$", lines, re.MULTILINE))


def _exits() -> list[str]:
    return [line for each in Exit for line in _item(str(int(each)), each.name.lower().replace("_", " "))]


def _leaves(command: App, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], App]]:
    if command.default_command is not None:
        yield path, command
    for name in sorted(_names(command)):
        yield from _leaves(command[name], (*path, name))


def _names(command: App) -> Iterator[str]:
    return (name for name in command if not name.startswith("-"))


def _title(app: App) -> str:
    return app.name[0]


def _about(command: App) -> tuple[str, list[str]]:
    """Return the first sentence of a command's help, and its other paragraphs up to the arguments."""
    first, *others = inspect.cleandoc(command.help or "").partition("\nArgs:")[0].strip().split("\n\n")
    return first.replace("\n", " ").removesuffix("."), [each.replace("\n", " ") for each in others]


def _section(title: str, lines: Sequence[str]) -> list[str]:
    return [f".SH {title}", *lines] if lines else []


def _item(name: str, text: str) -> list[str]:
    return [".TP", f".B {_text(name)}", _line(text) if text else "\\&"]


def _text(text: str) -> str:
    return text.replace("\\", "\\e").replace("-", "\\-").replace('"', "\\(dq")


def _line(text: str) -> str:
    r"""Return a line of text; `\&` before one that begins as a request does."""
    return "\\&" * text.startswith((".", "'")) + _text(text)
