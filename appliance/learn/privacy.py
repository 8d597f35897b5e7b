"""Differential privacy of clients: what the models of a run tell of any one of them, at most.

Each round adds the clipped updates of its clients, each with the same weight, and Gaussian noise of `noise` x `clip`:
with or without what one client has trained the sum differs by `clip` at most. Who took part is no secret. A client that
took part k times has the privacy of one Gaussian mechanism with k times the squared sensitivity (Dong, Roth, Su 2022,
"Gaussian differential privacy", corollaries 2.13 and 3.3), whose ε is exact (Balle, Wang 2018, "Improving the Gaussian
mechanism for differential privacy", theorem 8). Nothing is gained from the choice of clients: it is no secret draw.
"""

import math

MOST = 500.0
"""Largest ε that is worked out: it protects nobody."""


def delta(epsilon: float, mu: float) -> float:
    """Return δ of a Gaussian mechanism at ε; `mu` is sensitivity over standard deviation."""
    return _normal(-epsilon / mu + mu / 2.0) - math.exp(epsilon) * _normal(-epsilon / mu - mu / 2.0)


def epsilon(noise: float, rounds: int, at_delta: float) -> float | None:
    """Return ε for a client that has taken part so often, rounded up to 0.001; None where it is above `MOST`.

    Args:
        noise: standard deviation of the noise in each round's sum, as a multiple of the clip.
        rounds: that the client's updates were summed in.
        at_delta: δ > 0.
    """
    if not rounds:
        return 0.0
    mu = math.sqrt(rounds) / noise
    low, high = 0.0, 1.0
    if delta(low, mu) <= at_delta:
        return 0.0
    while delta(high, mu) > at_delta:
        if high >= MOST:
            return None
        low, high = high, min(MOST, 2.0 * high)
    while high - low > 1e-6:
        middle = (low + high) / 2.0
        low, high = (middle, high) if delta(middle, mu) > at_delta else (low, middle)
    return math.ceil(high * 1e3) / 1e3


def _normal(x: float) -> float:
    """Return the probability that a standard normal variable is at most `x`."""
    return 0.5 * math.erfc(-x / math.sqrt(2.0))
