"""Weighted sums in 64-bit fixed point: the same bits whatever the order of updates, so rounds can be computed again.

Each value is rounded to a multiple of 2^-24 and multiplied by its client's weight, a whole number; only then are values
added, so addition is exact. The mean is divided once, at the end.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

FRACTION_BITS = 24
"""Values are kept to 2^-24 (6e-8): below float32's own step for values above 0.5."""
_LIMIT = 2.0**62
_BLOCK = 1 << 18

Sums = NDArray[np.int64]


class SumOverflowError(ValueError):
    """An update's values times the weights do not fit 64 bits."""


class FixedSum:
    """The running sum of one tensor, or one piece of a tensor.

    Args:
        shape: shape of the tensor.
        total_weight: what the mean is divided by: the sum of the clients' weights.
        added_weight: sum of the weights of all that will be added, where that is more: the parts of one client's work
            are added each with its whole weight, which is counted once in `total_weight`.
    """

    def __init__(self, shape: tuple[int, ...], *, total_weight: int, added_weight: int | None = None) -> None:
        added = total_weight if added_weight is None else added_weight
        if not 1 <= total_weight <= added:
            raise ValueError(f"a total weight of {total_weight}, {added} of it added: there is nothing to average")
        self._sums: Sums = np.zeros(math.prod(shape), dtype=np.int64)
        self._shape = shape
        self._total = total_weight
        self._left = added
        self._largest = _LIMIT / added / 2**FRACTION_BITS

    @property
    def values(self) -> Sums:
        """The sums so far, in units of 2^-24 x weight."""
        return self._sums.reshape(self._shape)

    def add(self, values: NDArray[Any], weight: int, *, scale: tuple[int, int] = (1, 1)) -> None:
        """Add `values * scale` with that weight.

        Args:
            values: floats of the sum's shape.
            weight: whole number > 0.
            scale: numerator and denominator: steps of a whole epoch over steps done, for normalised partial work.

        Raises:
            ValueError: another shape, weight or scale.
            SumOverflowError: a value too large for 64 bits at these weights, or not finite; the sum is as it was.
        """
        if values.shape != self._shape:
            raise ValueError(f"values of shape {values.shape} in a sum of shape {self._shape}")
        if weight < 1 or scale[0] < 1 or scale[1] < 1:
            raise ValueError(f"weight {weight} and scale {scale[0]}/{scale[1]} must be positive")
        if weight > self._left:
            raise ValueError(f"weight {weight:,} is more than the {self._left:,} that are still to be added")
        flat = values.reshape(-1)
        factor = scale[0] / scale[1]
        largest = max((float(np.abs(flat[at : at + _BLOCK]).max()) for at in range(0, flat.size, _BLOCK)), default=0.0)
        if not largest * factor <= self._largest:
            raise SumOverflowError(
                f"a value of {largest * factor:.4g}; of these weights at most {self._largest:.4g} fits 64 bits"
            )
        self._left -= weight
        for at in range(0, flat.size, _BLOCK):
            exact = np.rint(flat[at : at + _BLOCK].astype(np.float64) * (factor * 2**FRACTION_BITS))
            self._sums[at : at + _BLOCK] += exact.astype(np.int64) * weight

    def mean(self) -> NDArray[np.float32]:
        """Return the sums divided by the total weight."""
        return (self._sums / (float(self._total) * 2**FRACTION_BITS)).astype(np.float32).reshape(self._shape)
