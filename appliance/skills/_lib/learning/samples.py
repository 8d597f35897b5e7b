"""Inputs of fixed values for each kind of model, the same wherever they are made: by them two forms of it are compared.

What a model takes: clips (batch, 1, 16, 40, 40), words (batch, 1, 98, 40), sentences (batch, frames, 40), all float32.
"""

import math

import numpy as np
from numpy.typing import NDArray

SHAPES: dict[str, tuple[tuple[int, ...], ...]] = {
    "clip": ((1, 1, 16, 40, 40), (3, 1, 16, 40, 40)),
    "word": ((1, 1, 98, 40), (3, 1, 98, 40)),
    "sentence": ((1, 60, 40), (2, 96, 40)),
}
"""Of the inputs, by what a model takes (`models.INPUTS`): of different batches, and lengths where they may differ."""


def sample(shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Return an input: multiples of 2^-15 between -1 and 1 that look like noise (Knuth's multiplicative hash)."""
    count = np.arange(math.prod(shape), dtype=np.uint64)
    mixed = (count * np.uint64(2654435761) >> np.uint64(11)) & np.uint64(0xFFFF)
    return (mixed.astype(np.float32) / np.float32(32768.0) - np.float32(1.0)).reshape(shape)
