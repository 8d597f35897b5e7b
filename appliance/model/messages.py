"""What messages share: encoding, failures, notices, log lines, needs, and enumerations open to newer words.

Enumerations: a newer version may know more states, kinds and ways. A decision must not take a word that
it does not know: for it enumerations are closed, and such a message is refused as malformed. A program that only
shows must not hide what it was told: for it they are open, and unknown words are kept as they are (both terms as
Protocol Buffers have them, "Enum behavior").
"""

from collections.abc import Generator
from contextlib import contextmanager
from enum import StrEnum
from typing import Any, Self

import msgspec
from msgspec import Struct, field

_LONGEST = 100
"""Characters of an unknown word that are kept."""
_opened: list[None] = []
"""One for each that has them open just now. Of the process, not of a task: messages are decoded on behalf of nobody."""


class OpenEnum(StrEnum):
    """Words of a known set; also others, while `enums_open`."""

    @classmethod
    def _missing_(cls, value: object) -> Self | None:
        if not _opened or not isinstance(value, str):
            return None
        # Equal to no member, and no member itself: what asks for certain words finds none of them.
        unknown = str.__new__(cls, value[:_LONGEST])
        unknown._name_ = "UNKNOWN"
        unknown._value_ = value[:_LONGEST]
        return unknown


@contextmanager
def enums_open() -> Generator[None]:
    """Have this process take words that it does not know; for programs that only show what they hear."""
    _opened.append(None)
    try:
        yield
    finally:
        _opened.pop()


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


class Need(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What a subtask asks of a container: T = (image, cpu, mem, volumes) of Algorithm 1."""

    image: str
    cpu: float = 0.5
    memory_mb: int = 128
    volumes: tuple[str, ...] = ()
