"""How resident memory grew while the terminal UI was measured."""

from hypothesis import given
from hypothesis import strategies as st

from workshop.bench.tui.screen import resident


@given(start=st.integers(10, 500), per_min=st.integers(-60, 60), count=st.integers(4, 60))
def test_a_straight_line_has_its_slope(start: int, per_min: int, count: int) -> None:
    """Memory that grows evenly has that slope, in all and in the second half; start, end and most are its ends."""
    samples = [[float(number), start + per_min * number / 60] for number in range(count)]
    found = resident(samples)
    assert found["start"] == samples[0][1]
    assert found["end"] == samples[-1][1]
    assert found["most"] == max(samples[0][1], samples[-1][1])
    for name in ("mb_per_min", "mb_per_min_second_half"):
        slope = found[name]
        assert slope is not None
        assert abs(slope - per_min) < 0.02


def test_too_few_samples_have_no_slope() -> None:
    """Nothing, or one moment, is shown as it is and has no slope."""
    assert resident([])["mb_per_min"] is None
    assert resident([[1.0, 70.0]]) == {
        "start": 70.0, "end": 70.0, "most": 70.0, "mb_per_min": None, "mb_per_min_second_half": None,
    }  # fmt: skip
