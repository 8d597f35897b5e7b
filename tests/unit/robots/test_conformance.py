"""Judgements of a robot's program: what passes, and what is said of what does not."""

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.errors import DeadlineError, PayloadError, UnreachableError
from appliance.model import Failure, Pose, RobotInfo, RobotReply, encode
from appliance.robots import conformance, retry
from appliance.robots.conformance import (
    Answer,
    Fault,
    Skipped,
    judge_arrival,
    judge_long,
    judge_refusal,
    judge_repeated,
    judge_speaker,
    judge_state,
    judge_stopped,
)

GOOD = RobotInfo(
    id="r", kind="zenoh", uses=("base",), verbs=("state", "stop", "hold"), pose=Pose(x=1.0, y=2.0), speaker="1-a"
)


def told(*states: RobotInfo | bytes, every_s: float = 0.2) -> list[tuple[float, bytes]]:
    """States as they came."""
    return [
        (10.0 + number * every_s, each if isinstance(each, bytes) else encode(each))
        for number, each in enumerate(states)
    ]


def replied(took_s: float = 0.01, *, code: str = "", message: str = "why", **result: Any) -> Answer:
    """A reply."""
    failure = Failure(code=code, message=message) if code else None
    return Answer(reply=RobotReply(id="1", result=result, failure=failure), took_s=took_s)


def test_a_state_that_is_right_says_how_often_it_comes() -> None:
    """With its last content."""
    info, what = judge_state("r", told(*[GOOD] * 20), 4.0)
    assert info == GOOD
    assert what == "5.0/s, 3 verbs"


@pytest.mark.parametrize(
    ("states", "what"),
    [
        ([], "no state came in 4 s"),
        ([b"{"] * 20, "no RobotInfo"),
        ([replace(GOOD, id="s")] * 20, "says id 's'"),
        ([replace(GOOD, kind="mavlink")] * 20, "kind 'mavlink'"),
        ([replace(GOOD, battery_percent=400.0)] * 20, "impossible values in battery_percent"),
        ([replace(GOOD, verbs=("goto",))] * 20, "lack state and stop"),
        ([replace(GOOD, pose=None)] * 20, "tells no pose"),
        ([GOOD], "0.0 times a second"),
    ],
)
def test_a_state_that_is_not_right_is_named(states: list[RobotInfo | bytes], what: str) -> None:
    """With a remedy."""
    with pytest.raises(Fault, match=what) as caught:
        judge_state("r", told(*states), 4.0)
    assert caught.value.remedy


def test_a_state_that_comes_rarely_is_named() -> None:
    """Every two seconds is too seldom."""
    with pytest.raises(Fault, match=r"0\.5 times a second"):
        judge_state("r", told(GOOD, GOOD, GOOD, every_s=2.0), 4.0)


@given(st.lists(st.one_of(st.binary(max_size=40), st.just(encode(GOOD))), max_size=5))
def test_whatever_a_robot_puts_is_judged(payloads: list[bytes]) -> None:
    """Never anything else than a verdict."""
    with contextlib.suppress(Fault):
        judge_state("r", told(*payloads), 4.0)


def test_one_name_is_one_program() -> None:
    """That says which it is."""
    assert judge_speaker([encode(GOOD)] * 3, 1) == "speaker 1-a"
    with pytest.raises(Fault, match="2 programs go by this name"):
        judge_speaker([encode(GOOD)], 2)
    with pytest.raises(Fault, match="2 programs go by this name"):
        judge_speaker([encode(GOOD), encode(replace(GOOD, speaker="2-b"))], 1)
    with pytest.raises(Fault, match="does not say which instance"):
        judge_speaker([encode(replace(GOOD, speaker=""))], 1)


def test_a_refusal_has_a_code_and_a_reason() -> None:
    """As a failure, or as an error."""
    assert judge_refusal(replied(code="refused"), "it") == "refused: why"
    assert judge_refusal(Answer(error=PayloadError("bad"), took_s=0.01), "it") == "payload: bad"
    for answer, what in (
        (replied(), "answered as done"),
        (replied(code="refused", message=""), "answered with refused"),
        (replied(code="internal"), "answered with internal"),
        (Answer(error=DeadlineError("no answer"), took_s=3.0), "is not answered"),
        (Answer(error=UnreachableError("nobody"), took_s=0.01), "is not answered"),
    ):
        with pytest.raises(Fault, match=what):
            judge_refusal(answer, "it")


def test_a_command_asked_for_three_times_is_done_once() -> None:
    """The three answers are one, the last at once; where it ends too soon to tell, that is said."""
    assert "done once in 3.0 s" in judge_repeated((replied(3.0, n=1), replied(2.7, n=1)), replied(0.01, n=1), 3.0)
    assert "too soon" in judge_repeated((replied(0.1), replied(0.01)), replied(0.01), 3.0)
    for answers, again, what in (
        ((replied(3.0, n=1), replied(5.7, n=1)), replied(0.01, n=1), "it was done twice"),
        ((replied(3.0, n=1), replied(2.7, n=1)), replied(3.0, n=1), "it was done again"),
        ((replied(3.0, n=1), replied(2.7, n=2)), replied(0.01, n=1), "different replies"),
        ((replied(3.0), replied(0.01, code="busy")), replied(0.01), "answered with busy"),
        ((replied(3.0), Answer(error=DeadlineError("x"), took_s=9.0)), replied(0.01), "answered with deadline"),
    ):
        with pytest.raises(Fault, match=what):
            judge_repeated(answers, again, 3.0)


def test_a_long_command_says_that_it_is_under_way() -> None:
    """Before the question is given up."""
    way = Answer(error=DeadlineError("under way"), took_s=10.0)
    assert "after 10.0 s that it is under way" in judge_long(way, replied(4.0), 14.0)
    with pytest.raises(Fault, match="nothing comes back for 12 s"):
        judge_long(Answer(error=DeadlineError("no answer"), took_s=12.0), replied(), 14.0)
    with pytest.raises(Fault, match="then it is answered with busy"):
        judge_long(way, replied(code="busy"), 14.0)
    with pytest.raises(Skipped):
        judge_long(replied(0.1), replied(0.1), 14.0)


def test_a_stop_is_answered_at_once_and_ends_the_command() -> None:
    """As cancelled."""
    assert "told as cancelled" in judge_stopped(replied(0.002), replied(0.6, code="cancelled"))
    faults: list[tuple[Callable[[], str], str]] = [
        (lambda: judge_stopped(replied(code="refused"), replied(code="cancelled")), "stop is not done"),
        (lambda: judge_stopped(replied(3.0), replied(code="cancelled")), "stop is not done"),
        (lambda: judge_stopped(replied(), replied()), "answered with a result"),
    ]
    for judge, what in faults:
        with pytest.raises(Fault, match=what):
            judge()


def test_goto_is_answered_on_arrival() -> None:
    """Not when it is taken."""
    assert "0.10 m from its goal" in judge_arrival(Pose(x=1.1, y=0.0), (1.0, 0.0))
    with pytest.raises(Fault, match=r"1\.0 m before its goal"):
        judge_arrival(Pose(x=0.0, y=0.0), (1.0, 0.0))
    with pytest.raises(Fault, match="no pose"):
        judge_arrival(None, (1.0, 0.0))


def test_the_page_of_the_contract_has_the_figures_of_the_code() -> None:
    """What authors of robots read is what gateways and the check do."""
    page = " ".join((Path(__file__).parents[3] / "docs/robot-contract.md").read_text(encoding="utf-8").split())
    for text in (
        f"still under way after {retry.LONG_POLL_S:g} s",
        f"{retry.FIRST_SILENCE_S:g} s without a word, then the same command is asked again",
        f"{retry.MOST_GONE_S:g} … s (up to a quarter less), given up after {retry.UNREACHABLE_S:g} s",
        f"asked again after {retry.FIRST_SILENCE_S:g} s, given up after {retry.SILENT_S:g} s",
        f"… {retry.MOST_QUICK_S:g} s, until the deadline",
        f"is not, within {retry.CONFIRM_S:g} s",
        f"what is put in {conformance.WATCH_S:g} s",
        f"`state`, {conformance.STATES} times | each within {conformance.AT_ONCE_S:g} s",
        f"`hold` for {conformance.HOLD_S:g} s, asked twice meanwhile",
        f"`hold` for {conformance.LONG_S:g} s | `deadline` within {retry.FIRST_SILENCE_S:g} s",
        f"within {conformance.NEAR_M:g} m of the goal",
        f"`{conformance.NO_VERB}`",
    ):
        assert text in page, text
    assert len(conformance.MALFORMED) == 6
    assert retry.JITTER == 0.25
