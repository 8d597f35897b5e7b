"""The wire between gateway and runner: a four-byte big-endian length, then one JSON object.

It exists on its own because the zygote, the child and the tests speak it. Bytes anywhere in a value travel as
`{"$b64": "..."}`, so a handler hands pictures over and gets files back without knowing of JSON.
"""

import base64
import binascii
import json
from collections.abc import Callable
from typing import Any, cast

MAX_FRAME = 16 * 2**20
"""Longest frame in bytes; a longer one is refused before it is read."""

BYTES_TAG = "$b64"


class FrameError(Exception):
    """The other side sent something that is no frame."""


class TooLongError(FrameError):
    """A frame is longer than MAX_FRAME; `size` is what it has, in bytes."""

    def __init__(self, size: int) -> None:
        super().__init__(f"frame of {size:,} bytes, {MAX_FRAME:,} allowed")
        self.size = size


def _pack(value: Any) -> Any:
    """Turn bytes into their tagged form; `json` calls this for whatever it does not know."""
    if isinstance(value, (bytes, bytearray)):
        return {BYTES_TAG: base64.b64encode(value).decode("ascii")}
    raise TypeError(f"{type(value).__name__} cannot be sent: use dict, list, str, numbers, bool, None or bytes")


def untagged(value: dict[str, Any]) -> Any:
    """Return the bytes that an object stands for, or itself where it stands for none; ValueError for a broken one."""
    if len(value) == 1 and isinstance(value.get(BYTES_TAG), str):
        return base64.b64decode(value[BYTES_TAG], validate=True)
    return value


def encode(value: dict[str, Any], *, lenient: bool = False) -> bytes:
    """Return the frame of one object.

    Args:
        value: the object.
        lenient: what is no Unicode in its texts (half of a surrogate pair, as in names of files that are not UTF-8)
            becomes a question mark: for what people read.

    Raises:
        TypeError, ValueError: it holds something JSON cannot say (a class, NaN, text that is no Unicode).
        TooLongError: it is longer than MAX_FRAME.
    """
    text = json.dumps(value, default=_pack, allow_nan=False, ensure_ascii=False, separators=(",", ":"))
    body = text.encode(errors="replace" if lenient else "strict")
    if len(body) > MAX_FRAME:
        raise TooLongError(len(body))
    return len(body).to_bytes(4, "big") + body


def parse(body: bytes) -> Any:
    """Return the value of a frame's JSON; ValueError when it is none."""
    return json.loads(body, object_hook=untagged)


def size_of(value: dict[str, Any]) -> int:
    """Return the bytes that an object takes as JSON, however many.

    Raises:
        TypeError, ValueError, RecursionError: JSON cannot say it.
    """
    try:
        return len(encode(value)) - 4
    except TooLongError as error:
        return error.size


def beyond(what: str, size: int, most: int) -> str:
    """Return the sentence for something that is too long, in bytes and MiB or KiB."""
    shown = f"{most / 2**20:g} MiB" if most >= 2**20 else f"{most / 2**10:g} KiB"
    return f"{what} has {size:,} bytes of JSON, at most {most:,} ({shown}) are possible"


class Decoder:
    """Collects bytes and gives whole objects; `parse` may be a quicker one that reads the same."""

    def __init__(self, parse: Callable[[bytes], Any] = parse) -> None:
        self._buffer = bytearray()
        self._parse = parse

    @property
    def pending(self) -> int:
        """Bytes of an unfinished frame."""
        return len(self._buffer)

    def feed(self, data: bytes) -> None:
        """Add what was received."""
        self._buffer += data

    def next(self) -> dict[str, Any] | None:
        """Return the next whole object, or None while there is none.

        Raises:
            FrameError: too long, not JSON, or not an object. Nothing after it can be trusted.
        """
        if len(self._buffer) < 4:
            return None
        length = int.from_bytes(self._buffer[:4], "big")
        if length > MAX_FRAME:
            raise TooLongError(length)
        if len(self._buffer) < 4 + length:
            return None
        body = bytes(self._buffer[4 : 4 + length])
        del self._buffer[: 4 + length]
        try:
            value: Any = self._parse(body)
        except (ValueError, RecursionError, binascii.Error) as error:
            raise FrameError(f"not JSON: {error}") from error
        if not isinstance(value, dict):
            raise FrameError(f"not an object but {type(value).__name__}")
        return cast("dict[str, Any]", value)
