"""Enumerations of which a newer version may know more: states, kinds, ways.

Whoever decides anything must not take a word that it does not know: for it enumerations are closed, and such a message
is refused as malformed. A program that only shows must not hide what it was told: for it they are open, and unknown
words are kept as they are (both terms as Protocol Buffers have them, "Enum behavior").
"""

from collections.abc import Generator
from contextlib import contextmanager
from enum import StrEnum
from typing import Self

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
