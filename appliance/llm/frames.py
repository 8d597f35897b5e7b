"""Length-prefixed JSON on pipes between the gateway and its model process: u32 big-endian, then that many bytes.

Standard library only: both ends must start quickly, and the bound keeps either from being fed without end.
"""

import json
import struct
from typing import Any, BinaryIO

MAX_FRAME = 4 * 2**20
_HEAD = struct.Struct(">I")


def pack(message: dict[str, Any]) -> bytes:
    """Return a message as a frame; ValueError when it is longer than `MAX_FRAME`."""
    body = json.dumps(message, ensure_ascii=False, separators=(",", ":")).encode("utf-8", errors="replace")
    if len(body) > MAX_FRAME:
        raise ValueError(f"frame of {len(body)} bytes: at most {MAX_FRAME}")
    return _HEAD.pack(len(body)) + body


def size_of(head: bytes) -> int:
    """Return how many bytes follow a frame's head; ValueError when that is too many."""
    (size,) = _HEAD.unpack(head)
    if size > MAX_FRAME:
        raise ValueError(f"frame of {size} bytes: at most {MAX_FRAME}")
    return int(size)


def unpack(body: bytes) -> dict[str, Any]:
    """Return a frame's message; ValueError when it is no JSON object."""
    message = json.loads(body)
    if not isinstance(message, dict):
        raise ValueError("a frame must hold an object")  # noqa: TRY004 - one kind of error for bad frames
    return message  # pyright: ignore[reportUnknownVariableType]


def read(stream: BinaryIO) -> dict[str, Any] | None:
    """Read one frame, blocking; None at the end of the stream."""
    head = stream.read(_HEAD.size)
    if len(head) < _HEAD.size:
        return None
    size = size_of(head)
    body = stream.read(size)
    return unpack(body) if len(body) == size else None


def write(stream: BinaryIO, message: dict[str, Any]) -> None:
    """Write one frame and flush."""
    stream.write(pack(message))
    stream.flush()
