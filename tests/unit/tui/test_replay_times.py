"""Times and rates of a log as people give them."""

import pytest

from appliance.errors import PayloadError
from appliance.tui.replay import RATES, faster, rate_of, seconds_of, slower, told


@pytest.mark.parametrize("text", ["0", "-1", "1e9", "nan", "", "fast"])
def test_rates_out_of_range_are_refused(text: str) -> None:
    """A rate that cannot be played is refused with those that can."""
    with pytest.raises(PayloadError, match="rate") as refused:
        rate_of(text)
    assert refused.value.remedy == "give 0.1 to 100"


def test_rates_are_read() -> None:
    """With an x behind or without."""
    assert rate_of("2x") == rate_of(" 2") == 2.0


def test_steps_through_the_rates() -> None:
    """Faster and slower go through the rates and stay at their ends."""
    rate = 1.0
    for _ in range(20):
        rate = faster(rate)
    assert rate == RATES[-1]
    for _ in range(20):
        rate = slower(rate)
    assert rate == RATES[0]
    assert (faster(3.0), slower(3.0)) == (5.0, 2.0)


@pytest.mark.parametrize(
    ("text", "expected"),
    [("90", 90.0), ("1:30", 90.0), ("1:00:01", 3601.0), ("50%", 50.0), ("+10", 30.0), ("-5", 15.0)],
)
def test_times_are_read(text: str, expected: float) -> None:
    """Times are written as seconds, clock, share, or from where it is."""
    assert seconds_of(text, at_s=20.0, length_s=100.0) == pytest.approx(expected)


@pytest.mark.parametrize("text", ["", "x", "1:2:3:4", "--1", "nan", "inf", "1:-3", "\x1b"])
def test_what_is_no_time_is_refused(text: str) -> None:
    """Anything else is refused with examples."""
    with pytest.raises(PayloadError):
        seconds_of(text, at_s=0.0, length_s=1.0)


def test_times_are_told() -> None:
    """Times are shown as a clock with tenths."""
    assert told(0.04) == "00:00.0"
    assert told(83.26) == "01:23.3"
    assert told(3661) == "1:01:01.0"
