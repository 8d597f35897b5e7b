"""What a session has put lately: numbered, bounded by bytes and age, and told by kind of key once it is gone."""

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import PayloadError
from appliance.plane.backlog import ANSWER_BYTES, NUMBERS, Backlog, BacklogAsk, after, kind_of, moved

NOW = 10**18


def _backlog(*, payload_bytes: int = 10**6, seconds: float = 1e6) -> Backlog:
    return Backlog(payload_bytes=payload_bytes, seconds=seconds)


def _say(backlog: Backlog, count: int, *, size: int = 1, step_ns: int = 1) -> None:
    for number in range(count):
        backlog.say(f"swiftbot/f/gw/g{number % 2}/log", NOW + number * step_ns, b"x" * size, "application/json")


@pytest.mark.parametrize(
    ("key", "kind"),
    [
        ("swiftbot/f/gw/gw-1/log", "gw/*/log"),
        ("swiftbot/f/robot/drone_1/mavlink/rx", "robot/*/mavlink/*"),
        ("swiftbot/f/task/t-1/run/s1", "task/*/run/*"),
        ("swiftbot/f/operator/act/gw-1", "operator/act/*"),
        ("swiftbot/f/notice/ops", "notice/*"),
        ("elsewhere", "elsewhere"),
    ],
)
def test_kinds_of_keys_have_no_names(key: str, kind: str) -> None:
    """A kind names what is put, not of whom: there are few of them, however large the fleet is."""
    assert kind_of(key) == kind


def test_what_is_asked_for_is_told_in_order() -> None:
    """A range of numbers comes as it was put; what is before the time asked for is left out, and not lost."""
    backlog = _backlog()
    _say(backlog, 10)
    backlog.say("swiftbot/f/gw/g/pool/c", NOW + 10, b"", "", deleted=True)
    told = backlog.answer(BacklogAsk(4, 11))
    assert [each.number for each in told.said] == list(range(4, 12))
    assert (told.said[-1].deleted, told.upto, told.lost, told.forgotten) == (True, 11, {}, 0)
    assert [each.number for each in backlog.answer(BacklogAsk(1, 11, NOW + 8)).said] == [9, 10, 11]


def test_what_is_gone_is_told_by_kind_of_key() -> None:
    """Beyond bytes or age puts are let go of, and counted under the kind of their key."""
    small = _backlog(payload_bytes=3 * (250 + 1))
    _say(small, 10)
    told = small.answer(BacklogAsk(1, 10))
    assert ([each.number for each in told.said], told.lost) == ([8, 9, 10], {"gw/*/log": 7})
    old = _backlog(seconds=1.0)
    _say(old, 10, step_ns=5 * 10**8)
    assert [each.number for each in old.answer(BacklogAsk(1, 10)).said] == [8, 9, 10]
    none = _backlog(payload_bytes=0)
    _say(none, 3)
    told = none.answer(BacklogAsk(1, 2))
    assert (told.said, told.lost) == ((), {"gw/*/log": 2})


def test_what_could_not_be_sent_has_a_number() -> None:
    """A put that the full queue refused leaves a hole before the next one, with its kind of key."""
    backlog = _backlog()
    _say(backlog, 1)
    backlog.not_sent("swiftbot/f/robot/r/mavlink/rx")
    assert backlog.say("swiftbot/f/gw/g/log", NOW, b"", "") == 3
    told = backlog.answer(BacklogAsk(2, 2))
    assert (told.said, told.lost) == ((), {"robot/*/mavlink/*": 1})


def test_a_long_answer_comes_in_pieces() -> None:
    """What is more than an answer may hold is asked for again from where the answer ends."""
    backlog = _backlog(payload_bytes=2**24)
    _say(backlog, 40, size=ANSWER_BYTES // 16)
    numbers: list[int] = []
    first = 1
    while True:
        told = backlog.answer(BacklogAsk(first, 40))
        numbers += [each.number for each in told.said]
        if told.upto == 40:
            break
        first = moved(told.upto, 1)
    assert numbers == list(range(1, 41))


@pytest.mark.anyio
async def test_a_question_that_is_none_is_refused() -> None:
    """Bytes that are no question are answered with an error."""
    with pytest.raises(PayloadError):
        await _backlog().answered("k", b"\xff{")
    assert msgspec.msgpack.decode(await _backlog().answered("k", msgspec.msgpack.encode(BacklogAsk(1, 1))))


@given(number=st.integers(1, NUMBERS), by=st.integers(-(10**6), 10**6))
def test_numbers_go_round(number: int, by: int) -> None:
    """Numbers stay within 1 to their largest, and how far one is behind another holds over the turn."""
    there = moved(number, by)
    assert 1 <= there <= NUMBERS
    assert after(there, number) == by
