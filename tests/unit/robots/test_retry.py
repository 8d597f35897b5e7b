"""The retry policy: bounded in time and in questions whatever a robot does, and fair to those that keep replies."""

import heapq
import itertools
from collections.abc import Callable
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.robots.retry import (
    CONFIRM_S,
    FIRST_SILENCE_S,
    LONG_POLL_S,
    SILENT_S,
    UNREACHABLE_S,
    Ask,
    CommandRetry,
    Done,
    End,
    Ending,
    Wait,
)

Word = tuple[float, str, str]
"""After how long a question is answered, how (`reply`, `under way`, `gone`), and with what."""
Robot = Callable[[int, float], Word | None]
"""What comes of a question, by its number and time; None: nothing ever."""
TIMEOUT_S = 300.0


class Course:
    """One command, in a time of its own."""

    def __init__(self, robot: Robot, *, timeout_s: float = TIMEOUT_S, live: bool = False, chance: float = 0.0) -> None:
        self.now = 0.0
        self.sent: list[float] = []
        self.end: Ending | None = None
        policy = CommandRetry(0.0, timeout_s, live=live, chance=chance)
        words: list[tuple[float, int, int, str, str]] = []
        order = itertools.count()
        first: str | None = None
        while True:
            step = policy.next(self.now)
            if isinstance(step, Ask):
                number = policy.asked(self.now)
                self.sent.append(self.now)
                assert len(self.sent) < 1000
                if (word := robot(number, self.now)) is not None:
                    after, kind, what = word
                    heapq.heappush(words, (self.now + after, next(order), number, kind, what))
            elif isinstance(step, Wait):
                assert step.until > self.now, "it would wait for nothing, again and again"
                if not words or words[0][0] > step.until:
                    self.now = step.until
                    continue
                self.now, _, number, kind, what = heapq.heappop(words)
                if kind == "reply":
                    policy.answered(number, self.now, same=first is None or first == what)
                    first = what if first is None else first
                else:
                    (policy.gone if kind == "gone" else policy.under_way)(number, self.now)
            else:
                self.end = step.why if isinstance(step, End) else None
                assert isinstance(step, End | Done)
                return


def remembering(lasts_s: float, *, latency_s: float = 0.01, deaf: tuple[float, float] = (0.0, 0.0)) -> Robot:
    """A robot as the contract has it; while it is deaf, questions wait for it."""
    began: list[float] = []

    def answer(_: int, now: float) -> Word:
        heard = max(now + latency_s, deaf[1]) if deaf[0] <= now < deaf[1] else now + latency_s
        began[:] = began or [heard]
        ends = began[0] + lasts_s
        if ends <= heard + LONG_POLL_S:
            return max(heard, ends) + latency_s - now, "reply", "done"
        return heard + LONG_POLL_S + latency_s - now, "under way", ""

    return answer


def forgetful(lasts_s: float, *, counts: bool = False) -> Robot:
    """A robot that does one question after the other, each as if it was new."""
    free = [0.0]

    def answer(number: int, now: float) -> Word:
        free[0] = max(free[0], now) + lasts_s
        return free[0] - now, "reply", f"done {number if counts else ''}"

    return answer


@given(st.floats(0.0, 250.0), st.floats(0.0, 0.5), st.floats(0.0, 200.0), st.floats(0.0, 24.0), st.floats(0.0, 1.0))
def test_a_robot_that_keeps_its_replies_is_never_blamed(
    lasts_s: float, latency_s: float, deaf_at: float, deaf_s: float, chance: float
) -> None:
    """However long the command takes, and though the robot is frozen for up to 24 s: it is waited for."""
    robot = remembering(lasts_s, latency_s=latency_s, deaf=(deaf_at, deaf_at + deaf_s))
    course = Course(robot, timeout_s=lasts_s + 60.0, chance=chance)
    assert course.end is None
    assert len(course.sent) <= 3 + lasts_s / LONG_POLL_S + 3


KINDS = st.sampled_from(["reply", "under way", "gone"])
SCRIPTS = st.lists(
    st.one_of(st.none(), st.tuples(st.floats(0.0, 60.0), KINDS, st.sampled_from(["a", "b"]))), min_size=1, max_size=8
)


@given(SCRIPTS, st.floats(0.1, 600.0), st.booleans(), st.floats(0.0, 1.0))
def test_whatever_a_robot_does_it_ends_and_is_not_asked_too_often(
    script: list[Word | None], timeout_s: float, live: bool, chance: float
) -> None:
    """At most the deadline and what a confirmation takes; at least a tenth of a second between two questions."""
    course = Course(lambda number, _: script[(number - 1) % len(script)], timeout_s=timeout_s, live=live, chance=chance)
    assert course.now <= timeout_s + 3 * CONFIRM_S
    gaps = [after - before for before, after in pairwise(course.sent)]
    assert sum(gap < 0.1 for gap in gaps) <= 1 + course.now / 2.0  # one that was held for two seconds or more
    assert len(course.sent) <= 12 + course.now


@pytest.mark.parametrize("held_s", [0.0, 0.05])
def test_a_robot_that_drops_questions_is_asked_ever_less_often(held_s: float) -> None:
    """Eight seconds and fewer than ten questions, each wait about twice the one before up to two seconds."""
    course = Course(lambda *_: (held_s, "gone", ""))
    assert course.end is Ending.NOBODY
    assert course.now == pytest.approx(UNREACHABLE_S, abs=0.2)
    assert 5 <= len(course.sent) < 10
    gaps = [after - before for before, after in pairwise(course.sent)]
    assert gaps == sorted(gaps)
    assert max(gaps) <= 2.0 + held_s + 1e-9


def test_a_robot_that_takes_questions_and_says_nothing_is_given_up() -> None:
    """After 36 s and two questions; a short command is given up at its deadline, with the same reason."""
    course = Course(lambda *_: None)
    assert (course.end, course.now) == (Ending.SILENT, SILENT_S)
    assert course.sent == [0.0, FIRST_SILENCE_S]
    short = Course(lambda *_: None, timeout_s=10.0)
    assert (short.end, short.now) == (Ending.SILENT, 10.0)
    assert Course(lambda *_: None, timeout_s=2.0).end is Ending.LATE


def test_a_robot_that_only_ever_says_that_it_is_under_way_ends_at_the_deadline() -> None:
    """Said at once it is asked every five seconds at most; said after ten seconds it is asked again at once."""
    quick = Course(lambda *_: (0.01, "under way", ""), timeout_s=120.0)
    assert (quick.end, quick.now) == (Ending.LATE, 120.0)
    assert len(quick.sent) < 32
    slow = Course(lambda *_: (LONG_POLL_S, "under way", ""), timeout_s=120.0)
    assert slow.end is Ending.LATE
    assert len(slow.sent) == 12


@pytest.mark.parametrize("lasts_s", [12.5, 15.0, 20.0, 30.0])
@pytest.mark.parametrize("counts", [False, True])
def test_a_robot_that_does_it_again_when_it_is_asked_again_is_found_out(lasts_s: float, counts: bool) -> None:
    """Whether its answers differ or not, soon after its first one."""
    course = Course(forgetful(lasts_s, counts=counts))
    assert course.end is Ending.FORGETFUL
    assert course.now <= lasts_s + 2 * CONFIRM_S + 0.1


def test_a_robot_that_answers_before_it_is_asked_again_need_not_remember() -> None:
    """Nothing tells that it would not."""
    assert Course(forgetful(11.0)).end is None


def test_answers_that_are_made_anew_each_time_may_differ() -> None:
    """As those to `state`."""
    assert Course(forgetful(15.0, counts=True), live=True).end is None


def test_a_restart_in_between_is_waited_out() -> None:
    """Six seconds of nobody, then under way and done."""

    def answer(_: int, now: float) -> Word:
        return (0.0, "gone", "") if 3.0 <= now < 9.0 else (2.9, "gone", "") if now < 3.0 else (1.0, "reply", "done")

    assert Course(answer).end is None


def test_a_refusal_that_is_not_kept_holds_at_once() -> None:
    """A robot that was busy may take the same command up when it is asked again: that is no second time."""
    policy = CommandRetry(0.0, TIMEOUT_S)
    for now in (0.0, FIRST_SILENCE_S):
        assert isinstance(policy.next(now), Ask)
        policy.asked(now)
    policy.answered(1, 13.0, kept=False)
    assert isinstance(policy.next(13.0), Done)
