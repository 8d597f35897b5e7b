"""Records of the plane: `swiftbot plane …`, and how records are shown."""

import contextlib
import sys
from pathlib import Path
from typing import Annotated, Any

import msgspec
from cyclopts import App, Parameter
from rich.table import Table

from appliance import console
from appliance.cli.common import HERE, TOOLS, Json, Where, complete, show
from appliance.errors import ConfigError, Exit, NotFoundError, PayloadError
from appliance.model.plane_api import Copy, Record, RecordPlace
from appliance.records import Held


def place_table(record: Record, place: RecordPlace, how: str) -> Table:
    """A record's version, and its copies."""
    title = f"{record.key} at {_version(record.version)}, read from {how}; owner {place.owner}"
    table = Table(title=title, title_justify="left", caption=_caption(place), caption_justify="left")
    for name in ("gateway", "version", "bytes", "state"):
        table.add_column(name)
    for each in place.copies:
        table.add_row(each.gateway, _version(each.version), str(each.size_bytes), _state(each))
    return table


def _caption(place: RecordPlace) -> str:
    return "the copies agree" if place.agree else "the copies differ"


def held_table(held: list[Held]) -> Table:
    """Records and where their copies lie."""
    table = Table()
    for name in ("key", "version", "bytes", "owner", "copies at", ""):
        table.add_column(name)
    for each in held:
        newest = each.newest
        copies = ", ".join(copy.gateway for copy in each.copies)
        notes = [*(["removed"] if newest.deleted else []), *([] if each.agree else ["copies differ"])]
        row = (each.key, _version(newest.version), str(newest.size_bytes), each.owner, copies, ", ".join(notes))
        table.add_row(*row)
    return table


def _state(copy: Copy) -> str:
    if copy.problem:
        return copy.problem
    return "removed" if copy.deleted else "" if copy.version else "none"


def _version(version: dict[str, int]) -> str:
    return msgspec.json.encode(version).decode() if version else ""


plane_app = App(name="plane", help="Read, list, write and remove records of the fleet.", group=TOOLS)

Force = Annotated[bool, Parameter(help="Also records that only gateways write, such as task/….")]
Expect = Annotated[
    str, Parameter(help="Expected version, as JSON such as '{\"gw-1\": 3}'; by default the current one.")
]


def add_to(app: App) -> None:
    """Add these commands."""
    app.command(plane_app)


@plane_app.command
async def get(
    key: str,
    /,
    *,
    replica: Annotated[bool, Parameter(help="Read any replica: fastest, may be stale.")] = False,
    raw: Annotated[bool, Parameter(help="Print only the value, as it is.")] = False,
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Show a record: its value and version, its owner, and what each replica holds.

    Args:
        key: Key of the record, such as task/t-1f3a.
    """
    from appliance.records import How, Records

    how: How = "replica" if replica else "owner"

    async with Records(where.endpoint()) as records:
        record, place = await records.read(key, how), await records.place(key)
    if raw:
        sys.stdout.buffer.write(record.value)
        return 0
    text = _text(record.value)
    if as_json:
        value = _value(record.value)
        shown = {"key": key, "read": how, "version": record.version, "value": value, "place": place}
        show(shown | {"agree": place.agree}, as_json=True)
    else:
        console.out.print(place_table(record, place, how))
        console.out.print(text, markup=False, highlight=False, soft_wrap=True)
    return 0


@plane_app.command
async def put(
    key: str,
    value: str = "",
    /,
    *,
    file: Annotated[Path | None, Parameter(help="Take the value from a file.")] = None,
    stdin: Annotated[bool, Parameter(help="Take the value from standard input.")] = False,
    new: Annotated[bool, Parameter(help="Fail if the record exists.")] = False,
    expect: Expect = "",
    force: Force = False,
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Write a record, if it has not changed since it was read; prints the new version.

    Args:
        key: Key of the record.
        value: The new value.
    """
    from appliance.records import Records

    if sum((file is not None, stdin, bool(value))) > 1:
        raise ConfigError("the value is given in several ways", remedy="leave all but one out")
    if new and expect:
        raise ConfigError("--new and --expect exclude each other", remedy="leave one out")
    data = sys.stdin.buffer.read() if stdin else value.encode() if file is None else _read(file)

    async with Records(where.endpoint()) as records:
        expected = _read_version(expect) if expect else None
        if not new and not expect:
            with contextlib.suppress(NotFoundError):
                expected = (await records.read(key)).version
        version = await records.write(key, data, expected=expected, force=force)
    _show_version(key, version, as_json=as_json)
    return 0


@plane_app.command
async def rm(
    key: str,
    /,
    *,
    expect: Expect = "",
    force: Force = False,
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Remove a record, if it has not changed since it was read.

    Args:
        key: Key of the record.
    """
    from appliance.records import Records

    async with Records(where.endpoint()) as records:
        expected = _read_version(expect) if expect else (await records.read(key)).version
        version = await records.remove(key, expected=expected, force=force)
    _show_version(key, version, as_json=as_json)
    return 0


@plane_app.command
async def ls(
    prefix: str = "",
    /,
    *,
    limit: int = 200,
    removed: Annotated[bool, Parameter(help="Also removed records that are remembered.")] = False,
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """List records by key: version, owner, who holds copies, and whether these agree.

    Args:
        prefix: Beginning of the keys.
        limit: How many at most, 1 to 1,000.
    """
    from appliance.model.plane_api import MOST_LISTED
    from appliance.records import Records

    if not 1 <= limit <= MOST_LISTED:
        raise ConfigError(f"--limit {limit}", remedy=f"1 to {MOST_LISTED:,}")

    async with Records(where.endpoint()) as records:
        found, failed = await records.held(prefix, limit)
    listed = [each for each in found if removed or not each.newest.deleted]
    rows = [complete(each) | {"agree": each.agree} for each in listed]
    show(rows, as_json=as_json, table=held_table(listed))
    for name, error in sorted(failed.items()):
        console.err.print(f"{name} did not answer: {error}", markup=False)
    return Exit.UNREACHABLE if failed else Exit.DONE


def _read_version(text: str) -> dict[str, int]:
    try:
        return msgspec.json.decode(text, type=dict[str, int])
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise PayloadError(
            f"--expect {text[:80]!r} is no version: {error}", remedy="as `plane get` prints it"
        ) from None


def _read(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except OSError as error:
        raise NotFoundError(f"{file} cannot be read: {error.strerror}", remedy="name an existing file") from error


def _value(value: bytes) -> Any:
    """A value as JSON where it is that, else as text, else its bytes, which JSON has as base64."""
    try:
        return msgspec.json.decode(value)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        pass
    try:
        return value.decode()
    except UnicodeDecodeError:
        return value


def _text(value: bytes) -> str:
    """A value for people: indented JSON, text without control characters, or the beginning in hexadecimal."""
    try:
        msgspec.json.decode(value)
        return msgspec.json.format(value, indent=2).decode()
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        pass
    text = value.decode(errors="replace")
    if "\ufffd" in text:
        return f"{value[:64].hex(' ')}{' …' if len(value) > 64 else ''}"
    return "".join(each if each.isprintable() or each in "\n\t" else "\ufffd" for each in text)


def _show_version(key: str, version: dict[str, int], *, as_json: bool) -> None:
    if as_json:
        show({"key": key, "version": version}, as_json=True)
    else:
        console.out.print(f"{key} is at {msgspec.json.encode(version).decode()}", markup=False, highlight=False)
