"""ε of a run with differential privacy, against published values and the definition itself."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.learn import privacy


@pytest.mark.parametrize(
    ("deviation", "sensitivity", "epsilon", "delta"),
    [
        (1, 1, 1, 0.12693674), (2, 2, 1, 0.12693674), (1, 3, 1, 0.78760074), (2, 6, 1, 0.78760074),
        (1, 1, 2, 0.02092364), (5, 5, 2, 0.02092364), (1, 1, 0, 0.38292492),
    ],
)  # fmt: skip
def test_delta_of_one_round_is_that_of_the_accountants(
    deviation: float, sensitivity: float, epsilon: float, delta: float
) -> None:
    """The values with which the tests of dp-accounting hold its Gaussian mechanism."""
    assert privacy.delta(epsilon, sensitivity / deviation) == pytest.approx(delta, abs=1e-8)


def test_epsilon_of_little_noise() -> None:
    """A deviation of 0.344 for a δ of 1e-5 has ε 16, as in the same tests, to the digits given there."""
    assert privacy.epsilon(0.344, 1, 1e-5) == pytest.approx(16.0, abs=0.05)


@given(st.floats(0.5, 20.0), st.integers(1, 200), st.sampled_from([1e-3, 1e-5, 1e-8]))
@settings(deadline=None, max_examples=60)
def test_epsilon_is_the_smallest_that_holds_by_the_definition(noise: float, rounds: int, delta: float) -> None:
    """δ is the integral of max(0, p - e^ε q) over the two densities of the sum of all rounds; ε gives that δ."""
    found = privacy.epsilon(noise, rounds, delta)
    if found is None or not 0.01 < found < 100.0:
        return
    mu = math.sqrt(rounds) / noise
    x = np.linspace(-40.0, 40.0 + mu, 400_001)

    def integral(epsilon: float) -> float:
        p, q = (np.exp(-((x - at) ** 2) / 2) / math.sqrt(2 * math.pi) for at in (mu, 0.0))
        return float(np.sum(np.maximum(0.0, p - math.exp(epsilon) * q)) * (x[1] - x[0]))

    assert integral(found) <= delta * 1.001
    assert integral(found - 0.002) >= delta * 0.999


def test_more_rounds_and_less_noise_tell_more() -> None:
    """Nothing before the first round; what is beyond all measure is not told."""
    assert privacy.epsilon(1.0, 0, 1e-5) == 0.0
    told = [
        privacy.epsilon(noise, rounds, 1e-5) or 0.0 for noise, rounds in ((4.0, 1), (4.0, 10), (2.0, 10), (1.0, 90))
    ]
    assert 0.0 < told[0] < told[1] < told[2] < told[3]
    assert privacy.epsilon(0.01, 1000, 1e-5) is None
