"""A log as lines of text, for people and for pipes."""

import re
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct

from appliance.errors import ConfigError
from appliance.record.edit import Select
from appliance.record.facts import LoggedMessage
from appliance.record.reader import read

SHOWN_BYTES = 20
"""Of a payload that is no text, as hexadecimal."""


class Line(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One message as a JSON line. `value` is a JSON payload, `text` another text, `hex` anything else."""

    at_ns: int
    key: str
    encoding: str = ""
    deleted: bool = False
    value: Any = None
    text: str | None = None
    hex: str | None = None


def cat(
    paths: Sequence[Path],
    select: Select,
    *,
    grep: str = "",
    limit: int = 0,
    as_json: bool = False,
    write: Callable[[str], object],
) -> list[str]:
    """Write the selected messages, a line each; returns sentences about damage met on the way.

    Raises:
        ConfigError: `grep` is no regular expression.
        NotFoundError, RecordError: as `reader.read`.
    """
    try:
        pattern = re.compile(grep)
    except re.error as error:
        raise ConfigError(f"--grep {grep[:80]!r} is no regular expression: {error}") from error
    match = select.matcher()
    problems: list[str] = []
    left = limit or -1
    for path in paths:
        found: list[str] = []
        for message in read(path, problems=found):
            if not match(message.key) or not select.within(message.at_ns):
                continue
            line = json_line(message) if as_json else text_line(message)
            if grep and not pattern.search(line):
                continue
            write(line + "\n")
            left -= 1
            if left == 0:
                return problems
        problems += [f"{path.name}: {each}" for each in found]
    return problems


def text_line(message: LoggedMessage) -> str:
    """Return time, key and payload; control characters are escaped, so that no log can steer a terminal."""
    at = datetime.fromtimestamp(message.at_ns // 10**9, UTC).strftime("%Y-%m-%dT%H:%M:%S")
    if message.deleted:
        body = "deleted"
    else:
        text = _text(message.payload)
        body = _hex(message.payload) if text is None else text.encode("unicode_escape").decode("ascii")
        if text is not None and text.isprintable():
            body = text
    return f"{at}.{message.at_ns % 10**9 // 1000:06d}Z {message.key} {body}"


def json_line(message: LoggedMessage) -> str:
    """Return the message as one line of JSON, its payload as JSON where it is."""
    line = Line(at_ns=message.at_ns, key=message.key, encoding=message.encoding, deleted=message.deleted)
    if not message.deleted:
        try:
            line = msgspec.structs.replace(line, value=msgspec.json.decode(message.payload))
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            text = _text(message.payload)
            more = {"hex": message.payload.hex()} if text is None else {"text": text}
            line = msgspec.structs.replace(line, **more)
    return msgspec.json.encode(line).decode()


def _text(payload: bytes) -> str | None:
    try:
        return payload.decode()
    except UnicodeDecodeError:
        return None


def _hex(payload: bytes) -> str:
    more = "…" if len(payload) > SHOWN_BYTES else ""
    return f"<{len(payload)} bytes {payload[:SHOWN_BYTES].hex()}{more}>"
