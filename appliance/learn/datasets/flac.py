"""Writes FLAC files without compression ("verbatim" subframes): what every decoder reads, as RFC 9639 says."""

import hashlib
import struct

import numpy as np
from numpy.typing import NDArray

BLOCK = 4096
"""Samples of a frame."""


def write_flac(samples: NDArray[np.int16], *, rate: int) -> bytes:
    """Return a FLAC file of one channel and 16 bits.

    Args:
        samples: the recording; at least one sample.
        rate: samples a second, below 2^20.
    """
    blocks = [samples[at : at + BLOCK] for at in range(0, len(samples), BLOCK)]
    frames = [_frame(block, number) for number, block in enumerate(blocks)]
    sizes = [len(frame) for frame in frames]
    facts = (rate << 44) | (15 << 36) | len(samples)
    digest = hashlib.md5(samples.astype("<i2").tobytes(), usedforsecurity=False).digest()
    info = struct.pack(">HH", BLOCK, BLOCK) + min(sizes).to_bytes(3, "big") + max(sizes).to_bytes(3, "big")
    info += facts.to_bytes(8, "big") + digest
    return b"fLaC" + bytes([0x80]) + len(info).to_bytes(3, "big") + info + b"".join(frames)


def _frame(block: NDArray[np.int16], number: int) -> bytes:
    """Return a frame: sizes and rate as the file's header says, or the size of a short block written out."""
    size_code = 0b1100 if len(block) == BLOCK else 0b0111
    header = bytes([0xFF, 0xF8, size_code << 4, 0b0000_100_0]) + _coded(number)
    if len(block) != BLOCK:
        header += struct.pack(">H", len(block) - 1)
    header += bytes([_crc8(header)])
    frame = header + bytes([0b0_000001_0]) + block.astype(">i2").tobytes()
    return frame + struct.pack(">H", _crc16(frame))


def _coded(number: int) -> bytes:
    """Return a frame's number in the form of UTF-8; 65,536 frames are 4 h at 16 kHz."""
    return chr(number).encode("utf-8", "surrogatepass")


def _table(polynomial: int, bits: int) -> list[int]:
    top, mask = 1 << (bits - 1), (1 << bits) - 1
    table: list[int] = []
    for byte in range(256):
        value = byte << (bits - 8)
        for _ in range(8):
            value = ((value << 1) ^ polynomial if value & top else value << 1) & mask
        table.append(value)
    return table


_CRC8, _CRC16 = _table(0x07, 8), _table(0x8005, 16)


def _crc8(data: bytes) -> int:
    value = 0
    for byte in data:
        value = _CRC8[value ^ byte]
    return value


def _crc16(data: bytes) -> int:
    value = 0
    for byte in data:
        value = (value << 8 & 0xFFFF) ^ _CRC16[value >> 8 ^ byte]
    return value
