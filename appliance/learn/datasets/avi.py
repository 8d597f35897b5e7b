"""Writes AVI files with JPEG pictures (MJPEG), which every decoder reads (Microsoft, AVI RIFF File Reference)."""

import struct
from collections.abc import Sequence

_HAS_INDEX = 0x10
_KEYFRAME = 0x10


def write_avi(pictures: Sequence[bytes], *, width: int, height: int, fps: int) -> bytes:
    """Return an AVI file.

    Args:
        pictures: JPEG files, all of that size; at least one.
        width: pixels.
        height: pixels.
        fps: pictures a second.
    """
    longest = max(map(len, pictures))
    main = struct.pack(
        "<14I", 1_000_000 // fps, longest * fps, 0, _HAS_INDEX, len(pictures), 0, 1, longest, width, height, 0, 0, 0, 0
    )
    stream = b"vidsMJPG" + struct.pack(
        "<IHHIIIIIIII4H", 0, 0, 0, 0, 1, fps, 0, len(pictures), longest, 0xFFFFFFFF, 0, 0, 0, width, height
    )
    form = struct.pack("<IiiHH4sIiiII", 40, width, height, 1, 24, b"MJPG", width * height * 3, 0, 0, 0, 0)
    header = _list(b"hdrl", _chunk(b"avih", main), _list(b"strl", _chunk(b"strh", stream), _chunk(b"strf", form)))
    chunks = [_chunk(b"00dc", each) for each in pictures]
    index: list[bytes] = []
    offset = 4
    for picture, chunk in zip(pictures, chunks, strict=True):
        index.append(struct.pack("<4sIII", b"00dc", _KEYFRAME, offset, len(picture)))
        offset += len(chunk)
    body = b"".join((b"AVI ", header, _list(b"movi", *chunks), _chunk(b"idx1", b"".join(index))))
    return b"RIFF" + struct.pack("<I", len(body)) + body


def _chunk(name: bytes, data: bytes) -> bytes:
    return name + struct.pack("<I", len(data)) + data + b"\0" * (len(data) % 2)


def _list(name: bytes, *chunks: bytes) -> bytes:
    return _chunk(b"LIST", name + b"".join(chunks))
