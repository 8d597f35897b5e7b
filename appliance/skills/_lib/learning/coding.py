"""Updates in 8 bits: each tensor as int8 with one scale, what rounding lost added to the next update, then deflated.

Rounding to 255 steps loses 2.4 % of an update's energy; "error feedback" (Seide et al. 2014) keeps that remainder at
the client and adds it to its next update, so nothing is lost in the long run. A coded update has two tensors for each
of the model's: `NAME` (I8, the model's shape) and `NAME@scale` (F32, one value for each part of a tensor).

A deflated file is never unpacked beyond the size that its manifest announced.
"""

import zlib
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .shards import SHARD_BYTES, ModelFileError, Piece

SCALE = "@scale"
_STEPS = 127


class Coded(NamedTuple):
    """A coded tensor: `values` int8 of its shape, `scale` float32 of shape (1,), `remainder` float32, for later."""

    values: NDArray[np.int8]
    scale: NDArray[np.float32]
    remainder: NDArray[np.float32]


def encode(delta: NDArray[np.float32], remainder: NDArray[np.float32] | None = None) -> Coded:
    """Return `delta + remainder` in 8 bits. ModelFileError(`nan`) where it has NaN or infinite values."""
    wanted = delta if remainder is None else delta + remainder
    largest = float(np.abs(wanted).max(initial=0.0))
    if not np.isfinite(largest):
        raise ModelFileError("nan", "an update with NaN or infinite values has no coding")
    scale = np.array([largest / _STEPS], dtype=np.float32)
    if float(scale[0]) == 0.0:  # all zero, or smaller than a float32 can tell: it waits in the remainder
        values = np.zeros(wanted.shape, dtype=np.int8)
    else:
        values = np.clip(np.rint(wanted / scale), -_STEPS, _STEPS).astype(np.int8)
    return Coded(values, scale, (wanted - values * scale).astype(np.float32))


def decode(values: NDArray[np.int8], scale: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the floats of a coded tensor."""
    return values.astype(np.float32) * scale


def scale_of(piece: Piece) -> Piece:
    """Return the tensor that holds the scale of a piece."""
    return Piece(piece.name + SCALE, "F32", (1,), piece.shard, piece.cut)


def coded_pieces(pieces: Iterable[Piece]) -> tuple[Piece, ...]:
    """Return what a coded update holds in place of those pieces of the model."""
    return tuple(coded for piece in pieces for coded in (piece._replace(dtype="I8"), scale_of(piece)))


def encode_shard(
    arrays: Mapping[str, NDArray[np.float32]],
    pieces: Iterable[Piece],
    remainders: Mapping[str, NDArray[np.float32]],
) -> tuple[dict[str, NDArray[Any]], dict[str, NDArray[np.float32]]]:
    """Return the coded tensors of a shard by key, and the remainders for the next update.

    Args:
        arrays: deltas by key.
        pieces: the shard's pieces in the model's manifest.
        remainders: what the client's last update left, by key; may be empty.
    """
    tensors: dict[str, NDArray[Any]] = {}
    left: dict[str, NDArray[np.float32]] = {}
    for piece in pieces:
        coded = encode(arrays[piece.key], remainders.get(piece.key))
        tensors[piece.key] = coded.values
        tensors[scale_of(piece).key] = coded.scale
        left[piece.key] = coded.remainder
    return tensors, left


def decode_shard(tensors: Mapping[str, NDArray[Any]], pieces: Iterable[Piece]) -> dict[str, NDArray[np.float32]]:
    """Return the floats of a shard by key from what `encode_shard` made, checked against the model's pieces."""
    return {piece.key: decode(tensors[piece.key], tensors[scale_of(piece).key]) for piece in pieces}


def deflate(data: bytes) -> bytes:
    """Return a file packed: 8-bit updates have some 5 bits of content a value."""
    return zlib.compress(data, 6)


def inflate(packed: bytes, size: int) -> bytes:
    """Return the file of `size` bytes that was packed; ModelFileError(`size`, `format`) where it is another."""
    if not 0 < size <= SHARD_BYTES:
        raise ModelFileError("size", f"a shard of {size:,} bytes; one has at most {SHARD_BYTES:,}")
    unpacker = zlib.decompressobj()
    try:
        data = unpacker.decompress(packed, size + 1)
    except zlib.error as error:
        raise ModelFileError("format", f"not a packed shard: {error}") from None
    if len(data) != size or not unpacker.eof or unpacker.unused_data:
        raise ModelFileError("size", f"the packed shard does not have the {size:,} bytes announced")
    return data
