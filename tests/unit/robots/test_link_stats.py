"""Counters of a link: loss by sequence numbers, latency, and how much one end may send."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.robots.mavlink.links import Limiter, LinkStats, Sender

HERE, THERE = ("a", 1), ("b", 1)


@given(st.lists(st.booleans(), min_size=1, max_size=900).filter(lambda kept: kept[0] and kept[-1]))
def test_every_lost_frame_is_counted(kept: list[bool]) -> None:
    """However often the numbers wrap: lost are those that did not come, as long as fewer than 128 in a row are lost."""
    sender, run = Sender(), 0
    for number, arrives in enumerate(kept):
        run = 0 if arrives else run + 1
        if run > 127:
            return
        if arrives:
            sender.hear(number % 256, float(number))
    assert (sender.received, sender.lost, sender.late) == (sum(kept), len(kept) - sum(kept), 0)
    assert sender.loss == sender.lost / len(kept)


@given(st.integers(0, 255), st.integers(1, 20))
def test_what_comes_late_was_not_lost(first: int, delay: int) -> None:
    """One frame that comes after `delay` others counts as late, and nothing as lost."""
    order = [*range(first, first + 5), *range(first + 6, first + 6 + delay), first + 5, first + 6 + delay]
    sender = Sender()
    for number in order:
        sender.hear(number % 256, 0.0)
    assert (sender.received, sender.lost, sender.late) == (len(order), 0, 1)


def test_a_sender_that_begins_again() -> None:
    """After a restart its numbers are followed again within three frames, and nothing is lost from then on."""
    sender = Sender()
    for number in (*range(100, 120), *range(50)):
        sender.hear(number, 0.0)
    assert (sender.lost, sender.late, sender.expected) == (0, 2, 50)


@pytest.mark.thorough
def test_senders_are_bounded() -> None:
    """Whatever ids a stranger invents, the table stays small and the latest are in it."""
    stats = LinkStats(0.0)
    for number in range(60_000):
        stats.sender(number % 256, number // 256).hear(0, float(number))
    assert len(stats.senders) <= 256
    assert (59_999 % 256, 59_999 // 256) in stats.senders


def test_latency_counts_each_answer_once() -> None:
    """An answer to a question of ours is a round trip; a repeated one, another end's, a stranger's are none."""
    stats = LinkStats(0.0)
    for stamp in (1, 2, 3):
        stats.asked(HERE, stamp, stamp * 10**6)
    assert stats.answered(HERE, 1, 5 * 10**6)
    assert not stats.answered(HERE, 1, 6 * 10**6)
    assert not stats.answered(THERE, 2, 6 * 10**6)
    assert not stats.answered(HERE, 99, 6 * 10**6)
    assert stats.answered(HERE, 3, 5 * 10**6)
    found = stats.latency[HERE]
    assert (found.count, found.last_ms, found.least_ms) == (2, 2.0, 2.0)
    assert list(stats.latency) == [HERE]


def test_rates() -> None:
    """Frames and bytes a second between two looks; looks in between change nothing."""
    stats = LinkStats(0.0)
    stats.frames_in, stats.bytes_in = 100, 4000
    stats.look(0.1)
    assert stats.meter.rates == (0.0, 0.0, 0.0, 0.0)
    stats.look(2.0)
    assert stats.meter.rates == (50.0, 2000.0, 0.0, 0.0)


@given(st.lists(st.tuples(st.floats(0.0, 0.5), st.integers(1, 50)), min_size=1, max_size=80))
def test_no_end_sends_more_than_it_may(pieces: list[tuple[float, int]]) -> None:
    """In any time an end gets through at most its rate, a burst of it, and one piece that overdraws; others get all."""
    limiter, now, passed = Limiter(20.0), 0.0, 0
    for pause_s, frames in pieces:
        now += pause_s
        if not limiter.wait_s(HERE, now):
            passed += frames
            limiter.spent(HERE, frames, now)
        assert passed <= 20.0 * now + 20 + 50
        assert limiter.wait_s(THERE, now) == 0.0


def test_no_limit() -> None:
    """0 is no limit."""
    limiter = Limiter(0.0)
    limiter.spent(HERE, 10**9, 0.0)
    assert limiter.wait_s(HERE, 0.0) == 0.0


def test_whoever_was_too_fast_is_heard_again() -> None:
    """After at most a second of silence."""
    limiter = Limiter(100.0)
    assert limiter.wait_s(HERE, 0.0) == 0.0
    limiter.spent(HERE, 190, 0.0)
    assert 0.0 < limiter.wait_s(HERE, 0.0) <= 1.0
    assert limiter.wait_s(HERE, 1.1) == 0.0
