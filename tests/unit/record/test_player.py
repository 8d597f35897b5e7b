"""Where a replay is: a function of the clock, whatever is done to it."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import ConfigError
from appliance.record.player import FASTEST, SLOWEST, Playhead, check_rate, parse_remap

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


def within(length_s: int = 60) -> Playhead:
    """A playhead in a log that ends, standing still."""
    return Playhead(100 * SECOND, (100 + length_s) * SECOND, rate=1.0, now=0.0, paused=True)


def test_it_stands_still_at_the_end() -> None:
    """Time goes on by the rate while it plays, stands still while it does not, and ends with the log."""
    head = within()
    assert head.position_ns(5.0) == 100 * SECOND
    head.play(10.0)
    assert head.position_ns(13.0) == 103 * SECOND
    head.set_rate(10.0, 13.0)
    assert head.position_ns(15.0) == 123 * SECOND
    head.pause(15.0, paused=True)
    assert head.position_ns(99.0) == 123 * SECOND
    head.play(100.0)
    assert head.position_ns(200.0) == 160 * SECOND
    assert head.paused
    head.play(201.0)
    assert head.position_ns(201.0) == 100 * SECOND
    assert not head.paused


def test_it_seeks_within_the_log() -> None:
    """Seeking goes anywhere between the ends, and goes on playing if it did."""
    head = within()
    head.play(0.0)
    head.seek(130 * SECOND, 1.0)
    assert head.position_s(2.0) == pytest.approx(31.0)
    head.seek(0, 2.0)
    assert head.position_s(2.0) == 0.0
    head.seek(10**18, 3.0)
    assert head.position_s(3.0) == head.length_s == 60.0


def test_no_nanosecond_is_lost() -> None:
    """Times of today are exact: at the beginning the first message is shown, at the end the last."""
    start = 1_795_380_108_959_123_457
    head = Playhead(start, start + 7 * SECOND + 1, rate=1.0, now=0.0, paused=True)
    assert head.position_ns(0.0) == start
    head.seek(start + round(head.length_s * 1e9), 1.0)
    assert head.position_ns(1.0) == start + 7 * SECOND + 1
    head.seek(start, 2.0)
    head.play(3.0)
    assert head.position_ns(4.0) == start + SECOND


def test_it_waits_for_what_is_not_read_yet() -> None:
    """When reading is slower than the rate, the clock waits instead of skipping."""
    head = within(100)
    head.set_rate(100.0, 0.0)
    head.play(0.0)
    head.hold(120 * SECOND, 0.5)
    assert head.position_ns(0.5) == 120 * SECOND
    assert not head.paused
    assert head.position_ns(0.6) == 130 * SECOND


@given(
    moves=st.lists(st.tuples(st.sampled_from(["play", "pause", "seek", "hold"]), st.floats(0, 200)), max_size=30),
)
def test_it_never_leaves_the_log(moves: list[tuple[str, float]]) -> None:
    """Whatever is done, the moment shown is within the log."""
    head, now = within(), 0.0
    for what, amount in moves:
        now += amount / 10
        if what == "play":
            head.play(now)
        elif what == "pause":
            head.pause(now, paused=True)
        elif what == "seek":
            head.seek(round(amount * SECOND), now)
        else:
            head.hold(round(amount * SECOND), now)
        assert 100 * SECOND <= head.position_ns(now) <= 160 * SECOND


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
