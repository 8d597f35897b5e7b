"""Quantiles, distribution curves and ratios of measured times."""

import math

import pytest
from hypothesis import given
from hypothesis import settings as few
from hypothesis import strategies as st

from workshop.bench.figures import CDF_SHARES, cdf, quantile, ratio, summary

TIMES = st.lists(st.floats(min_value=0, max_value=1e6), min_size=1, max_size=300)


@few(max_examples=100)
@given(TIMES, st.floats(min_value=0, max_value=1))
def test_a_quantile_was_measured_and_has_its_share_below_it(times: list[float], part: float) -> None:
    """Nearest rank: one of the times, at least `part` of them are no longer, and none shorter would do."""
    ordered = sorted(times)
    found = quantile(ordered, part)
    assert found in ordered
    assert sum(each <= found for each in ordered) >= part * len(ordered) - 1e-6
    assert sum(each < found for each in ordered) < max(part * len(ordered), 1e-6) + 1e-6


@pytest.mark.parametrize(("part", "expected"), [(0.5, 50), (0.9, 90), (0.99, 99), (1.0, 100), (0.0, 1)])
def test_quantiles_of_one_to_a_hundred(part: float, expected: int) -> None:
    """The p-th of a hundred times is the p-th, whatever binary fractions make of p."""
    assert quantile([float(each) for each in range(1, 101)], part) == expected


def test_no_times() -> None:
    """Nothing measured has no quantile, and a summary that says so."""
    with pytest.raises(ValueError, match="no times"):
        quantile([], 0.5)
    assert summary([]) == {"count": 0}
    assert cdf([]) == []


def test_what_was_never_served_counts_as_endless() -> None:
    """Two of a hundred runs without an end make p99 unknown, not better; p50 stands."""
    found = summary([1.0] * 98 + [math.inf] * 2)
    assert (found["p50"], found["p99"], found["max"]) == (1.0, None, None)
    assert cdf([1.0, math.inf])[-1] == [None, 1.0]


@few(max_examples=50)
@given(TIMES)
def test_a_distribution_curve_rises(times: list[float]) -> None:
    """Its points go up in time and share, to the longest time at 1."""
    points = cdf(times)
    assert [share for _, share in points] == list(CDF_SHARES)
    values = [time for time, _ in points if time is not None]
    assert values == sorted(values)
    assert points[-1][0] == round(max(times), 3)


def test_ratios() -> None:
    """A ratio of what is not known is not known; others are short."""
    assert ratio(100.0, 3.0) == 33.3
    assert ratio(4.0, 3.0) == 1.33
    assert ratio(None, 3.0) is None
    assert ratio(3.0, 0.0) is None
