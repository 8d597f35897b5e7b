"""What all commands share: groups of the help, the fleet they speak to, how they print, commands out of operations."""

import inspect
import os
import sys
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, cast

import msgspec
from cyclopts import App, Group, Parameter
from cyclopts.validators import Number

from appliance import console
from appliance.after_stop import Left
from appliance.client import Endpoint, FleetClient
from appliance.errors import ConfigError, Exit
from appliance.model import TaskRecord
from appliance.operations import OPERATIONS, Annotation, Operation, annotations, left_lines
from appliance.tasks.views import view

DAEMONS = Group("Daemons", sort_key=3)
FLEET = Group("A fleet on this machine", sort_key=1)
WORK = Group("Work", sort_key=2)
TOOLS = Group("Logs, images, checks", sort_key=4)

Json = Annotated[bool, Parameter(name="--json", help="Print JSON.")]

Skills = Annotated[tuple[Path, ...], Parameter(help="Folder with further skills and images; repeatable.")]

Why = Annotated[str, Parameter(help="Reason, recorded in the audit log.")]

MOST_NAME = 255
"""Bytes of a file's or folder's name (NAME_MAX of Linux)."""
MOST_PATH = 4095
"""Bytes of a path (PATH_MAX of Linux, without the zero at its end)."""
MOST_SHOWN = 60
"""Characters that an error shows of a path that is none."""


def check_path(_: object, value: object) -> None:
    """Check every path that a command is given, before it runs: the validator of all parameters.

    Args:
        value: of a parameter; what is neither a path nor a tuple of paths is not looked at.

    Raises:
        ConfigError: no file can have such a path, whatever is on the disk.
    """
    for path in cast("tuple[object, ...]", value) if isinstance(value, tuple) else (value,):
        if not isinstance(path, Path):
            continue
        text = os.fsencode(path)
        longest = max(map(len, text.split(b"/")))
        if longest > MOST_NAME:
            why = f"a name in it has {longest:,} bytes, and may have {MOST_NAME}"
        elif len(text) > MOST_PATH:
            why = f"it has {len(text):,} bytes, and may have {MOST_PATH:,}"
        elif b"\0" in text:
            why = "it has a zero byte in it"
        else:
            continue
        shown = str(path) if len(str(path)) <= MOST_SHOWN else f"{str(path)[:MOST_SHOWN]}…"
        raise ConfigError(f"{shown!r} is no path: {why}", remedy="name another file or folder")


@Parameter(name="*")
@dataclass(frozen=True)
class Where:
    """Which fleet a command speaks to."""

    fleet: Annotated[str, Parameter(env_var="SWIFTBOT_FLEET", help="Name of the fleet.")] = "local"
    directory: Annotated[
        Path | None, Parameter(name="--dir", env_var="SWIFTBOT_DIR", help="Directory of a local fleet.")
    ] = None
    connect: Annotated[
        tuple[str, ...], Parameter(env_var="SWIFTBOT_CONNECT", help="Endpoint of a gateway, such as tls/10.0.0.1:7447.")
    ] = ()
    keys: Annotated[
        Path | None,
        Parameter(env_var="SWIFTBOT_KEYS", help="File with your keys, as `swiftbot keys issue` writes it."),
    ] = None

    def folder(self) -> Path:
        """Directory of the local fleet of that name."""
        from appliance.connection import default_directory

        return self.directory or default_directory(self.fleet)

    def endpoint(self) -> Endpoint:
        """Where to connect: as given, or what the local fleet's state file says."""
        keys = str(self.keys or "")
        if self.connect:
            return Endpoint(fleet=self.fleet, connect=self.connect, keys=keys)
        from appliance.connection import read_state

        endpoint = read_state(self.folder()).endpoint
        return msgspec.structs.replace(endpoint, keys=keys) if keys else endpoint

    def client(self) -> FleetClient:
        """Return a client of the fleet, which is connected by `async with`."""
        return FleetClient(self.endpoint())


HERE = Where()


def complete(value: Any) -> Any:
    """Return a value with every field of every struct in it, also those that have their default.

    On the wire defaults are left out. A script that asks `jq 'select(.online)'` needs the field of a robot that is
    online, which is the default.
    """
    match value:
        case msgspec.Struct():
            names = zip(value.__struct_encode_fields__, value.__struct_fields__, strict=True)
            tag = {str(config.tag_field): config.tag} if (config := value.__struct_config__).tag is not None else {}
            return tag | {shown: complete(getattr(value, name)) for shown, name in names}
        case Mapping():
            return {key: complete(each) for key, each in cast("Mapping[Any, Any]", value).items()}
        case list() | tuple() | Set():
            return [complete(each) for each in cast("list[Any]", value)]
        case _:
            return value


def fields(value: msgspec.Struct) -> dict[str, Any]:
    """Return the fields of a struct, to make one of more fields from it."""
    return {name: getattr(value, name) for name in value.__struct_fields__}


def json_line(value: Any) -> str:
    """Return a value as JSON in one line, with all fields."""
    return msgspec.json.encode(complete(value)).decode()


def show(value: Any, *, as_json: bool, table: Any = None) -> None:
    """Print a value as JSON with all fields, or its table."""
    if as_json:
        sys.stdout.write(msgspec.json.format(msgspec.json.encode(complete(value)), indent=2).decode() + "\n")
    else:
        console.out.print(table)


def on_terminal() -> bool:
    """Return whether a person can be asked."""
    return sys.stdin.isatty() and sys.stdout.isatty()


def show_task(record: TaskRecord, *, as_json: bool) -> None:
    """Print a task."""
    show(view(record), as_json=as_json, table=console.task_table(record))


def tell_left(found: Sequence[Left]) -> None:
    """Print where robots stand, what they hold and what can be done, a line each; nothing where there are none."""
    for line in left_lines(found):
        console.out.print(line, markup=False, highlight=False, soft_wrap=True)


def add_operations(app: App) -> None:
    """Add a command for each operation that has one, unless it has been written by hand."""
    for operation in OPERATIONS:
        if operation.function is None or not operation.command:
            continue
        *path, word = operation.command.split()
        parent = app
        for name in path:
            parent = parent[name]
        if word not in parent:
            parent.command(_command(operation), name=word, group=None if path else WORK)


def _command(operation: Operation) -> Any:
    """Return a command that carries an operation out and prints its outcome."""
    function = operation.function
    assert function is not None  # noqa: S101 - the caller has looked

    async def command(*arguments: Any, as_json: Json = False, where: Where = HERE, **options: Any) -> int:
        async with where.client() as client:
            outcome = await function(client, *arguments, **options)
        for note in outcome.notes:
            console.err.print(note)
        if isinstance(outcome.value, TaskRecord):
            show_task(outcome.value, as_json=as_json)
        else:
            show(outcome.value, as_json=as_json, table=outcome.text)
        return Exit.DONE if outcome.ok else Exit.FAILED

    shared = list(inspect.signature(command).parameters.values())[1:3]
    parameters = [
        _parameter(found) for found in annotations(function).values() if not (found.kind and found.kind.hidden)
    ]
    command.__doc__ = inspect.getdoc(function)
    command.__dict__["__signature__"] = inspect.Signature([*parameters, *shared], return_annotation=int)
    return command


def _parameter(found: Annotation) -> inspect.Parameter:
    bounds = (Number(gte=found.bounds.ge, lte=found.bounds.le),) if found.bounds is not None else ()
    option = found.parameter.kind is inspect.Parameter.KEYWORD_ONLY
    return found.parameter.replace(
        kind=inspect.Parameter.KEYWORD_ONLY if option else inspect.Parameter.POSITIONAL_ONLY,
        annotation=Annotated[found.type, Parameter(help=found.help, validator=bounds)],
    )
