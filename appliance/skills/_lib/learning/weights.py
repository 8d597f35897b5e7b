"""Weights of updates: whole numbers, so that no float whose last bit depends on the machine is in a sum.

They are samples x `WEIGHT_UNIT`, so that an update `staleness` rounds late can weigh 1/sqrt(1 + staleness) of them.
"""

import math

WEIGHT_UNIT = 1024
"""Weight of one sample."""


def stale_weight(samples: int, staleness: int) -> int:
    """Return the weight of an update: samples x 1024 / sqrt(1 + staleness), rounded down, at least 1 (FedBuff, eq. 1).

    Args:
        samples: samples that its client holds, > 0.
        staleness: rounds closed since its base model was, >= 0.
    """
    if samples < 1 or staleness < 0:
        raise ValueError(f"{samples} samples, {staleness} rounds late: an update has at least 1 and 0")
    return max(1, math.isqrt(samples * samples * WEIGHT_UNIT * WEIGHT_UNIT // (1 + staleness)))
