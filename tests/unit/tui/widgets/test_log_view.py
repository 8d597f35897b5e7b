"""Lines of the log: what is kept, what is shown, and that anything makes a line."""

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import PayloadError
from appliance.tui.command_line import Filter
from appliance.tui.formatting import Heard, heard, line_text, plain, said
from appliance.tui.screens.logs import expression_of
from appliance.tui.widgets.log_view import Tail


def put(tail: Tail[Heard], *texts: str) -> None:
    """Put lines."""
    for text in texts:
        payload = msgspec.json.encode({"to": "ops", "text": text})
        tail.put(heard(tail.count + 1, "swiftbot/f/notice/ops", 10**18, payload))


def test_filter_comes_before_the_cut() -> None:
    """A rare line that matches stays however many others come after it; without the filter the newest are shown."""
    tail: Tail[Heard] = Tail(10, plain)
    tail.set_filter(Filter("battery"))
    put(tail, "battery low")
    put(tail, *(f"line {number}" for number in range(500)))
    assert [said(each).text for each in tail.lines] == ["to ops: battery low"]
    tail.set_filter(Filter(""))
    assert len(tail.lines) == 10
    assert said(tail.lines[-1]).text == "to ops: line 499"
    tail.set_filter(Filter("!line"))
    assert list(tail.lines) == []


@given(texts=st.lists(st.sampled_from(["a", "b", "ab", "c"]), max_size=60), most=st.integers(1, 8))
def test_tail_is_bounded_and_in_order(texts: list[str], most: int) -> None:
    """At most so many lines are kept, the newest of those that match, in the order heard."""
    tail: Tail[Heard] = Tail(most, plain)
    tail.set_filter(Filter(": a"))
    put(tail, *texts)
    shown = [said(each).text.removeprefix("to ops: ") for each in tail.lines]
    assert shown == [text for text in texts if text.startswith("a")][-most:]


@given(key=st.text(max_size=80), payload=st.binary(max_size=200), at_ns=st.integers(-(2**63), 2**63 - 1))
def test_anything_makes_one_line(key: str, payload: bytes, at_ns: int) -> None:
    """Whatever is put on whatever key is shown as one printable line."""
    assert line_text(said(heard(1, key, at_ns, payload))).plain.isprintable()
    assert line_text(said(heard(1, key, at_ns, payload, deleted=True))).plain.isprintable()


def test_huge_message_is_a_line() -> None:
    """A message of a megabyte is kept and shown in part, with its size."""
    message = heard(1, "swiftbot/f/gw/gw-1/log", 10**18, b'{"event": "' + b"x" * 2**20 + b'"}')
    assert len(message.payload) <= 4096
    assert message.size > 2**20
    assert len(said(message).text) <= 400


@pytest.mark.parametrize(
    ("typed", "expected"),
    [("gw/*/log", "swiftbot/f/gw/*/log"), ("swiftbot/other/**", "swiftbot/other/**"), ("**", "**")],
)
def test_expressions_are_made_whole(typed: str, expected: str) -> None:
    """An expression means this fleet's keys unless it says otherwise."""
    assert expression_of(typed, "f") == expected


@pytest.mark.parametrize("typed", ["", "a//b", "a/b*/c", "a?b", "a#", "**/**", "x" * 600, "a/$b"])
def test_bad_expressions_are_refused(typed: str) -> None:
    """What Zenoh would refuse is refused with the reason before it gets there."""
    with pytest.raises(PayloadError, match="key expression"):
        expression_of(typed, "f")
