"""Masks of secure aggregation: numbers added to an update so that it says nothing, and that cancel in the sum of all.

An update is masked where it was trained, before anything of it is kept: each value becomes a whole number of 2^-24,
times the client's weight, plus its masks, modulo 2^64 (Bonawitz et al. 2017, "Practical secure aggregation for
privacy-preserving machine learning", section 4). Of the sum, the masks that are left over are subtracted by their
seeds, which clients give away once it is certain what is summed (`appliance.learn.secagg`). Masks are the output of
SHAKE-256, so a seed of 32 bytes stands for a mask as long as the model.
"""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from . import shards
from .shards import Manifest, ModelFileError, Piece
from .sums import FRACTION_BITS

LARGEST = 64.0
"""Value of an update at most: weights are bounded so that sums of these fit (`check_bits`)."""
SUM_BITS = 62
"""Of a sum without its sign: one of 64 is left over, so that a sum that went over is seen."""
SEED_BYTES = 32
BLOCK = 1 << 13
"""Values that are drawn together: of a tensor in several shards each needs its own part of the mask alone."""

Sums = NDArray[np.int64]
Floats = NDArray[np.float32]


class Seed(NamedTuple):
    """A mask: what it is drawn from, and whether it is added or subtracted."""

    seed: bytes
    sign: int


def check_bits(clients: int, samples: int) -> None:
    """Raise ValueError where the sum of so many clients' updates, weighted by so many samples each, may not fit."""
    most = int(LARGEST) * clients * samples << FRACTION_BITS
    if most >= 1 << SUM_BITS:
        raise ValueError(
            f"{clients} clients of {samples:,} samples need {most.bit_length()} bits for a sum, {SUM_BITS} are there"
        )


def total_mask(seeds: Sequence[Seed], name: str, start: int, count: int) -> NDArray[np.uint64]:
    """Return the sum of some masks modulo 2^64, of so many values of a tensor from the given one on."""
    first, last = start // BLOCK, (start + count + BLOCK - 1) // BLOCK
    total = np.zeros((last - first) * BLOCK, dtype=np.uint64)
    for each in seeds:
        for block in range(first, last):
            data = hashlib.shake_256(each.seed + f"{name}/{block}".encode()).digest(8 * BLOCK)
            values = np.frombuffer(data, dtype="<u8").astype(np.uint64)
            at = slice((block - first) * BLOCK, (block - first + 1) * BLOCK)
            total[at] = total[at] + values if each.sign > 0 else total[at] - values
    return total[start - first * BLOCK :][:count]


def masked(values: Mapping[str, Floats], weight: int, seeds: Sequence[Seed]) -> dict[str, Sums]:
    """Return an update as it leaves its client.

    Args:
        values: what training changed, by tensor.
        weight: whole number > 0.
        seeds: all masks of the client.

    Raises:
        ModelFileError: (`nan`, `norm`, `zero`) values that are not finite, too large for sums, or all zero.
    """
    if not any(array.any() for array in values.values()):
        raise ModelFileError("zero", "all values of the update are zero: nothing was trained")
    result: dict[str, Sums] = {}
    for name, array in values.items():
        largest = float(np.abs(array).max(initial=0.0))
        if not np.isfinite(largest):
            raise ModelFileError("nan", f"tensor {name!r} has NaN or infinite values")
        if largest > LARGEST:
            raise ModelFileError("norm", f"tensor {name!r} has a value of {largest:.4g}, at most {LARGEST:g} is summed")
        whole = np.rint(array.astype(np.float64) * 2**FRACTION_BITS).astype(np.int64) * weight
        mask = total_mask(seeds, name, 0, array.size).reshape(array.shape)
        result[name] = (whole.astype(np.uint64) + mask).astype(np.int64)
    return result


class Masked(NamedTuple):
    """A client's masked update. `fetch` returns the bytes of a shard by its number."""

    client: str
    manifest: Manifest
    fetch: Callable[[int], bytes]
    weight: int


def mean(updates: Sequence[Masked], layout: Sequence[Piece], seeds: Sequence[Seed]) -> dict[str, Floats]:
    """Return the weighted mean of masked updates, by tensor.

    One update after the other is added, a shard at a time; what cannot be read makes the whole sum meaningless.

    Args:
        updates: one for each client, at least one.
        layout: pieces of a masked update, in their shards.
        seeds: of the masks that do not cancel among these, with the signs with which they are in the sum.

    Raises:
        UnreadableError: an update is not what was announced; it names the client.
        ValueError: the sum is larger than sums of updates can be: masks and updates are not of one cohort.
    """
    count = 1 + max(piece.shard for piece in layout)
    plain = Manifest(tuple(layout), tuple(shards.Shard("", 0) for _ in range(count)))
    for update in updates:
        try:
            shards.check_same(update.manifest, plain)
        except ModelFileError as error:
            raise UnreadableError(update.client, error) from error
    total = sum(update.weight for update in updates)
    starts: dict[str, int] = {}
    parts: dict[str, list[Floats]] = {}
    for index in range(count):
        here = [piece for piece in layout if piece.shard == index]
        sums = {piece.key: np.zeros(piece.shape, dtype=np.uint64) for piece in here}
        for update in updates:
            try:
                arrays = shards.decode(update.fetch(index), update.manifest, index)
            except ModelFileError as error:
                raise UnreadableError(update.client, error) from error
            for key in sums:
                sums[key] += arrays[key].astype(np.uint64)
        for piece in here:
            start, size = starts.get(piece.name, 0), int(np.prod(piece.shape, dtype=np.int64))
            starts[piece.name] = start + size
            sum_of = (sums.pop(piece.key) - total_mask(seeds, piece.name, start, size).reshape(piece.shape)).astype(
                np.int64
            )
            if size and int(np.abs(sum_of).max()) > int(LARGEST) * total << FRACTION_BITS:
                raise ValueError("the masks do not cancel: updates and seeds are not of one cohort")
            changes = (sum_of / (float(total) * 2**FRACTION_BITS)).astype(np.float32)
            parts.setdefault(piece.name, []).append(changes)
    return {name: found[0] if len(found) == 1 else np.concatenate(found) for name, found in parts.items()}


class UnreadableError(ValueError):
    """A client's masked update cannot be summed.

    Attributes:
        client: whose.
        reason: one of `shards.REASONS`.
    """

    def __init__(self, client: str, error: ModelFileError) -> None:
        super().__init__(str(error))
        self.client = client
        self.reason = error.reason


def read_seeds(value: object) -> tuple[Seed, ...]:
    """Return masks from `[[seed in hex, 1 or -1], …]`; ValueError where that is something else."""
    found: list[Seed] = []
    for each in _rows(value):
        row = _rows(each)
        if len(row) != 2 or row[1] not in (1, -1):
            raise ValueError("a mask is [seed, 1 or -1]")
        seed = bytes.fromhex(str(row[0]))
        if len(seed) != SEED_BYTES:
            raise ValueError(f"the seed of a mask has {SEED_BYTES} bytes, not {len(seed)}")
        found.append(Seed(seed, 1 if row[1] == 1 else -1))
    return tuple(found)


def _rows(value: object) -> list[object]:
    if not isinstance(value, list | tuple):
        raise ValueError("masks are a list of [seed, 1 or -1]")  # noqa: TRY004 - it comes as JSON
    return list(cast("Sequence[object]", value))
