"""Statistics of measured times: quantiles and the curve of their distribution. Pure.

Quantiles are nearest-rank: each is a time that was measured, none is interpolated. A run that was never served has
the time `inf`, so that what fails cannot make a quantile look better.
"""

import math
from collections.abc import Sequence
from typing import Any

CDF_SHARES = (*(each / 20 for each in range(1, 20)), 0.97, 0.98, 0.99, 0.995, 0.999, 1.0)
"""Where the distribution curve has its points: each twentieth, and closer together in the tail."""


def quantile(ordered: Sequence[float], part: float) -> float:
    """Return the nearest-rank quantile of times in ascending order, the ceil(part * n)-th; ValueError for none."""
    if not ordered:
        raise ValueError("no times, no quantile")
    # 1e-9: 0.99 * 100 is 99.00000000000001 in binary and must stay the 99th.
    return ordered[min(len(ordered), max(1, math.ceil(part * len(ordered) - 1e-9))) - 1]


def summary(times_ms: Sequence[float]) -> dict[str, Any]:
    """Return count, p50, p90, p99 and max of times in milliseconds; None for one that only unserved runs reach."""
    ordered = sorted(times_ms)
    if not ordered:
        return {"count": 0}
    found: dict[str, Any] = {"count": len(ordered)}
    for name, part in (("p50", 0.5), ("p90", 0.9), ("p99", 0.99), ("max", 1.0)):
        found[name] = finite(quantile(ordered, part))
    return found


def cdf(times_ms: Sequence[float]) -> list[list[float | None]]:
    """Return points of the empirical distribution function, [milliseconds, share of the runs that were as fast]."""
    ordered = sorted(times_ms)
    return [[finite(quantile(ordered, share)), share] for share in CDF_SHARES] if ordered else []


def finite(time_ms: float) -> float | None:
    """Return a time rounded to microseconds, or None for `inf`, which JSON does not know."""
    return round(time_ms, 3) if math.isfinite(time_ms) else None


def ratio(above: float | None, below: float | None) -> float | None:
    """Return how many times larger `above` is, to one decimal (two below 10); None when one is not known."""
    if above is None or not below:
        return None
    value = above / below
    return round(value, 1 if value >= 10 else 2)
