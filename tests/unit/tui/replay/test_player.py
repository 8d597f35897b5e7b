"""Which moment of a log is shown."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import PayloadError
from appliance.tui.replay.player import RATES, Player, seconds_of, told

S = 10**9


def test_plays_at_its_rate_and_stops_at_the_end() -> None:
    """Time goes on by the rate while it plays, stands still while it does not, and ends with the log."""
    player = Player(100 * S, 160 * S)
    assert player.at_ns(5.0) == 100 * S
    player.play(10.0)
    assert player.at_ns(13.0) == 103 * S
    player.set_rate(10.0, 13.0)
    assert player.at_ns(15.0) == 123 * S
    player.pause(15.0)
    assert player.at_ns(99.0) == 123 * S
    player.play(100.0)
    assert player.at_ns(200.0) == 160 * S
    assert not player.playing
    player.play(201.0)
    assert player.at_ns(201.0) == 100 * S


def test_seeks_within_the_log() -> None:
    """Seeking goes anywhere between the ends, and goes on playing if it did."""
    player = Player(100 * S, 160 * S)
    player.play(0.0)
    player.seek(30.0, 1.0)
    assert player.at_s(2.0) == pytest.approx(31.0)
    player.step(-100.0, 2.0)
    assert player.at_s(2.0) == 0.0
    player.seek(1e9, 3.0)
    assert player.at_s(3.0) == 60.0
    with pytest.raises(PayloadError):
        player.seek(float("nan"), 3.0)


def test_no_nanosecond_is_lost() -> None:
    """Times of today are exact: at the beginning the first message is shown, at the end the last."""
    start = 1_795_380_108_959_123_457
    player = Player(start, start + 7 * S + 1)
    assert player.at_ns(0.0) == start
    player.seek(player.length_s, 1.0)
    assert player.at_ns(1.0) == start + 7 * S + 1
    player.seek(0.0, 2.0)
    assert player.at_ns(2.0) == start
    player.play(3.0)
    assert player.at_ns(4.0) == start + S


def test_waits_for_what_is_not_read_yet() -> None:
    """When reading is slower than the rate, the clock waits instead of skipping."""
    player = Player(0, 100 * S)
    player.set_rate(100.0, 0.0)
    player.play(0.0)
    player.hold(20 * S, 0.5)
    assert player.at_ns(0.5) == 20 * S
    assert player.playing
    assert player.at_ns(0.6) == 30 * S


@pytest.mark.parametrize("rate", [0.0, -1.0, 1e9, float("nan")])
def test_rates_out_of_range_are_refused(rate: float) -> None:
    """A rate that cannot be played is refused with those that can."""
    with pytest.raises(PayloadError, match="rate"):
        Player(0, S).set_rate(rate, 0.0)


def test_steps_through_the_rates() -> None:
    """Faster and slower go through the rates and stay at their ends."""
    player = Player(0, S)
    for _ in range(20):
        player.faster(0.0)
    assert player.rate == RATES[-1]
    for _ in range(20):
        player.slower(0.0)
    assert player.rate == RATES[0]


@given(
    moves=st.lists(st.tuples(st.sampled_from(["play", "pause", "seek", "hold"]), st.floats(0, 200)), max_size=30),
)
def test_never_leaves_the_log(moves: list[tuple[str, float]]) -> None:
    """Whatever is done, the moment shown is within the log."""
    player = Player(7 * S, 67 * S)
    now = 0.0
    for what, amount in moves:
        now += amount / 10
        if what == "play":
            player.play(now)
        elif what == "pause":
            player.pause(now)
        elif what == "seek":
            player.seek(amount, now)
        else:
            player.hold(round(amount * S), now)
        assert 7 * S <= player.at_ns(now) <= 67 * S


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
    """Times are told as a clock with tenths."""
    assert told(0.04) == "00:00.0"
    assert told(83.26) == "01:23.3"
    assert told(3661) == "1:01:01.0"
