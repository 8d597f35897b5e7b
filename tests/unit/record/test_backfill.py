"""Holes in what sessions put: noticed by number, filled in order, and told when they stay."""

from collections.abc import Sequence

from hypothesis import given
from hypothesis import strategies as st

from appliance.plane.backlog import NUMBERS, UNKNOWN
from appliance.record.backfill import MOST_HELD, Follower, Hole
from appliance.record.models import LoggedMessage


def _message(number: int, source: str = "a/1") -> LoggedMessage:
    return LoggedMessage("swiftbot/f/gw/g/log", 10**18 + number, b"", "", source=source, number=number)


def _messages(*numbers: int) -> list[LoggedMessage]:
    return [_message(number) for number in numbers]


def _numbers(messages: Sequence[LoggedMessage]) -> list[int]:
    return [each.number for each in messages]


def test_a_hole_is_filled_in_its_place() -> None:
    """What comes behind a hole waits until it is filled; another session's messages do not wait."""
    follower = Follower()
    taken = follower.take([*_messages(1, 2, 5), _message(1, "b/1"), *_messages(6)])
    assert [(each.source, each.number) for each in taken.messages] == [("a/1", 1), ("a/1", 2), ("b/1", 1)]
    assert taken.holes == [Hole("a/1", 3, 4)]
    filled = follower.fill(taken.holes[0], _messages(4, 3), {})
    assert (_numbers(filled.messages), filled.lost) == ([3, 4, 5, 6], [])
    assert _numbers(follower.take(_messages(7)).messages) == [7]


def test_what_stays_missing_is_told_once() -> None:
    """A hole that cannot be filled is lost, by kind of key; the log goes on, and what comes late is in it."""
    follower = Follower()
    (hole,) = follower.take(_messages(1, 4)).holes
    given_up = follower.fill(hole, _messages(2), {"gw/*/log": 1})
    assert _numbers(given_up.messages) == [2, 4]
    assert [each.keys for each in given_up.lost] == [{"gw/*/log": 1}]
    assert _numbers(follower.take(_messages(3, 3, 2, 5)).messages) == [3, 5]
    assert follower.fill(hole, _messages(2), {"gw/*/log": 1}).lost == []


def test_a_session_that_is_not_known_is_asked_for_its_beginning() -> None:
    """The first message of a session may be its thousandth; if nobody can tell of the others, none is called lost."""
    follower = Follower()
    (hole,) = follower.take(_messages(1000)).holes
    assert hole == Hole("a/1", 1, 999, fresh=True)
    given_up = follower.give_up(hole)
    assert (_numbers(given_up.messages), given_up.lost) == ([1000], [])


def test_a_second_hole_behind_the_first_is_asked_for_too() -> None:
    """What waited behind a hole may have one of its own."""
    follower = Follower()
    (hole,) = follower.take(_messages(1, 3, 6)).holes
    filled = follower.fill(hole, _messages(2), {})
    assert (_numbers(filled.messages), filled.holes) == ([2, 3], [Hole("a/1", 4, 5)])
    ended = follower.give_all_up()
    assert (_numbers(ended.messages), ended.lost[0].keys) == ([6], {UNKNOWN: 2})


def test_what_waits_is_bounded() -> None:
    """A hole that nobody fills is given up when too much waits behind it."""
    follower = Follower()
    taken = follower.take(_messages(1, *range(3, MOST_HELD + 4)))
    assert len(taken.messages) == MOST_HELD + 2
    assert [each.keys for each in taken.lost] == [{UNKNOWN: 1}]


def test_messages_without_numbers_pass() -> None:
    """Other Zenoh programs give no numbers: their messages go on as they come."""
    message = LoggedMessage("k", 1, b"")
    assert Follower().take([message, message]).messages == [message, message]


@given(
    st.integers(1, NUMBERS),
    st.lists(st.booleans(), min_size=1, max_size=40),
    st.lists(st.booleans(), min_size=40, max_size=40),
)
def test_every_message_is_logged_in_order_or_lost(start: int, heard: list[bool], kept: list[bool]) -> None:
    """Whatever is not heard, and of that whatever is kept: in order, each once, and the rest is counted."""
    numbers = [(start - 1 + offset) % NUMBERS + 1 for offset in range(len(heard) + 2)]
    follower = Follower()
    out: list[int] = []
    lost = 0
    pending = follower.take([_message(numbers[0])])
    pending.holes = []
    if start != 1:
        begin = follower.give_up(Hole("a/1", max(1, start - 2**30), start - 1, fresh=True))
        pending.messages += begin.messages
    said = dict(zip(numbers[1:], kept, strict=False))
    heard_at = [True, *heard, True]
    for number, there in zip(numbers[1:], heard_at[1:], strict=True):
        if there:
            more = follower.take([_message(number)])
            pending.messages += more.messages
            pending.holes += more.holes
    out += _numbers(pending.messages)
    holes = pending.holes
    while holes:
        hole = holes.pop(0)
        inside = [(hole.first - 1 + offset) % NUMBERS + 1 for offset in range(hole.count)]
        found = [_message(number) for number in inside if said.get(number)]
        missing = len(inside) - len(found)
        filled = follower.fill(hole, found, {"k": missing} if missing else {})
        out += _numbers(filled.messages)
        holes += filled.holes
        lost += sum(sum(each.keys.values()) for each in filled.lost)
    order = {number: index for index, number in enumerate(numbers)}
    places = [order[number] for number in out]
    assert places == sorted(set(places))
    assert len(out) + lost == len(numbers)
