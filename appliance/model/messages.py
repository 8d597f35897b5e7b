"""Failures, notices and log lines, the error that an RPC answers, and the encoding of all structs."""

from typing import Any

import msgspec
from msgspec import Struct, field

VersionVector = dict[str, int]
"""Gateway id -> number of writes by that gateway seen in this version (Dynamo's version vectors)."""


class Failure(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Why something did not work, as told to people; `retryable` when another attempt may succeed."""

    code: str
    message: str
    remedy: str = ""
    retryable: bool = False


class ErrorReply(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What an RPC answers when it cannot do what was asked; see `errors.from_code`."""

    code: str
    message: str
    remedy: str = ""
    problems: tuple[str, ...] = ()
    retry_after_s: float = 0.0
    """When what was refused for want of room is worth asking again, by the measured rate; 0: not known."""


class Notice(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A message to a person, by `notify` or by the appliance itself."""

    id: str
    to: str
    text: str
    task: str = ""
    gateway: str = ""
    at_ns: int = 0


class LogLine(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One structured log line of a gateway or of a run."""

    at_ns: int
    level: str
    source: str
    event: str
    fields: dict[str, Any] = field(default_factory=dict[str, Any])
    number: int = 0
    """Counts a process's lines from 1."""


def encode(value: Any) -> bytes:
    """Encode a struct as JSON."""
    return msgspec.json.encode(value)
