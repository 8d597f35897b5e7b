"""Where a replay is: a function of the clock, whatever is done to it."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import ConfigError
from appliance.record.player import check_rate, parse_remap
from appliance.record.playhead import FASTEST, SLOWEST, Playhead

SECOND = 10**9


def test_rate_pause_and_seek() -> None:
    """Ten seconds at double speed, a pause of any length, then a jump: each where it should be."""
    head = Playhead(100 * SECOND, rate=2.0, now=0.0)
    assert head.position_ns(10.0) == 120 * SECOND
    assert head.delay_s(130 * SECOND, 10.0) == 5.0
    head.pause(10.0, paused=True)
    assert head.position_ns(1e6) == 120 * SECOND
    assert head.delay_s(130 * SECOND, 11.0) is None
    head.pause(50.0, paused=False)
    assert head.position_ns(51.0) == 122 * SECOND
    head.seek(100 * SECOND, 51.0)
    assert head.position_ns(52.0) == 102 * SECOND
    head.set_rate(0.0, 52.0)
    assert head.delay_s(10**18, 52.0) == 0.0
    head.reached(500 * SECOND)
    assert head.position_ns(99.0) == 500 * SECOND


steps = st.lists(st.tuples(st.floats(0, 10), st.sampled_from(["pause", "go", "faster", "slower", "wait"])), max_size=40)


@given(steps)
def test_time_never_runs_backwards_by_itself(some: list[tuple[float, str]]) -> None:
    """Without a jump the position only grows, however rate and pause change; the rate stays within its bounds."""
    head, now, last = Playhead(0, rate=1.0, now=0.0), 0.0, 0
    for wait, what in some:
        now += wait
        if what in ("pause", "go"):
            head.pause(now, paused=what == "pause")
        elif what in ("faster", "slower"):
            head.set_rate(head.rate * (4.0 if what == "faster" else 0.25), now)
        position = head.position_ns(now)
        assert position >= last - 1  # a nanosecond of rounding
        assert SLOWEST <= head.rate <= FASTEST
        last = position


@pytest.mark.parametrize("text", ["nonsense", "=b", "a=", "a/*=b", "a=b c"])
def test_what_is_no_rule(text: str) -> None:
    """A rule that names no keys is refused with the way to write one."""
    with pytest.raises(ConfigError, match="is no rule"):
        parse_remap([text])


def test_what_is_no_rate() -> None:
    """Neither negative nor beyond bounds."""
    for rate in (-1.0, 5_000.0, float("nan")):
        with pytest.raises(ConfigError, match="--rate"):
            check_rate(rate)
    assert check_rate(0.0) == 0.0
