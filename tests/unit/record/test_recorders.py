"""What is published of a recorder that misses messages: how many, of which keys, at once."""

import pytest

from appliance.model import RecorderNote
from appliance.model.recorder_api import RecorderStatus
from appliance.record.models import BACK_S, FORGET_S, GONE_S, SILENT_S, Recorders, kinds_text, problem_of, together


def _status(**fields: object) -> RecorderStatus:
    return RecorderStatus(id="recorder", fleet="f", state="recording", **fields)  # pyright: ignore[reportArgumentType]


def test_misses_are_news_and_figures_are_not() -> None:
    """A status is published at once when messages are missing, and not for each message recorded."""
    recorders = Recorders()
    assert recorders.hear(_status(messages=1), 0.0)
    assert not recorders.hear(_status(messages=99), 1.0)
    assert recorders.hear(_status(missed={"gw/*/log": 3, "robot/*/mavlink/*": 9}), 2.0)
    (note,) = recorders.notes(2.0)
    assert (note.missed, note.keys) == (12, {"robot/*/mavlink/*": 9, "gw/*/log": 3})
    assert problem_of(note) == "missed 12 messages of keys robot/*/mavlink/* 9, gw/*/log 3"


def test_a_recorder_that_is_not_heard_is_told_as_silent() -> None:
    """Silence is a problem; one that stops in order is forgotten at once, one that never comes back after an hour."""
    recorders = Recorders()
    recorders.hear(_status(), 0.0)
    assert problem_of(recorders.notes(1.0)[0]) == ""
    assert problem_of(recorders.notes(SILENT_S + 1)[0]) == "not heard any more"
    assert recorders.notes(FORGET_S + 1) == ()
    recorders.hear(_status(), 0.0)
    recorders.hear(RecorderStatus(id="recorder", fleet="f", state="stopped"), 1.0)
    assert recorders.notes(1.0) == ()


def test_a_recorder_whose_token_is_gone_is_silent_sooner() -> None:
    """It is silent once its next word is due and the token is not back; a word or the token ends that."""
    recorders = Recorders()
    recorders.hear(_status(), 0.0)
    assert recorders.went("recorder", 0.2) == pytest.approx(GONE_S - 0.2)
    assert recorders.notes(GONE_S)[0].state == "recording"
    assert recorders.notes(GONE_S + 0.01)[0].state == "silent"
    recorders.there("recorder")
    assert recorders.notes(GONE_S + 0.01)[0].state == "recording"
    assert recorders.went("recorder", 3.0) == pytest.approx(BACK_S)
    assert recorders.hear(_status(), 3.4)  # it was never gone: its token alone got lost
    assert recorders.notes(3.4 + SILENT_S)[0].state == "recording"


def test_a_recorder_that_stops_or_was_never_heard_is_not_missed() -> None:
    """The token that goes after the last word of one that stops, or of one that said nothing, is no news."""
    recorders = Recorders()
    assert recorders.went("recorder", 0.0) == 0.0
    recorders.hear(_status(), 0.0)
    recorders.hear(RecorderStatus(id="recorder", fleet="f", state="stopped"), 1.0)
    recorders.went("recorder", 1.1)
    assert recorders.notes(9.0) == ()


def test_a_recorder_that_failed_and_is_gone_tells_why() -> None:
    """What it said last is told beside that it is not heard any more."""
    recorders = Recorders()
    recorders.hear(RecorderStatus(id="recorder", fleet="f", state="failed", problem="the log writer failed"), 0.0)
    recorders.went("recorder", 0.1)
    assert problem_of(recorders.notes(2.0)[0]) == "not heard any more; the log writer failed"


def test_kinds_are_bounded_and_ranked() -> None:
    """Of many kinds the largest are named, in a note and in a line; the rest is counted."""
    missed = {f"k{number:02}": number for number in range(1, 31)}
    recorders = Recorders()
    recorders.hear(_status(missed=missed), 0.0)
    (note,) = recorders.notes(0.0)
    assert note.missed == sum(missed.values()) == sum(note.keys.values())
    assert kinds_text(missed) == "k30 30, k29 29, k28 28 and 27 more"


def test_gateways_tell_of_one_recorder_once() -> None:
    """The one who heard most is believed; a recorder is silent only where nobody hears it."""
    told = [
        RecorderNote(id="a", state="silent", missed=9),
        RecorderNote(id="a", state="recording", missed=4),
        RecorderNote(id="a", state="recording", missed=7),
        RecorderNote(id="b", state="silent"),
    ]
    assert [(note.id, note.state, note.missed) for note in together(told)] == [
        ("a", "recording", 7),
        ("b", "silent", 0),
    ]
