"""Whose turn it is to reopen its session: one gateway at a time, and somebody always gets on."""

from hypothesis import given
from hypothesis import strategies as st

from appliance.plane.reopening import TURN_S, Turns


def test_one_that_is_asked_by_nobody_else_grants_the_turn() -> None:
    """And grants it again to the same one, which may not have heard the answer."""
    turns = Turns("gw-2")
    assert turns.before("gw-1", 0.0) == ""
    assert turns.before("gw-1", 1.0) == ""
    assert turns.before("gw-3", 1.0) == "gw-1"


def test_a_turn_ends_when_it_is_over_or_has_lasted_too_long() -> None:
    """A gateway that ends in the middle of it holds nobody up for good."""
    turns = Turns("gw-2")
    assert turns.before("gw-1", 0.0) == ""
    assert turns.before("gw-3", TURN_S - 0.1) == "gw-1"
    assert turns.before("gw-3", TURN_S) == ""
    turns.ended("gw-3")
    assert turns.before("gw-1", TURN_S) == ""


def test_of_two_that_want_it_the_first_by_name_goes_first() -> None:
    """So that two which ask each other at once do not both wait, nor both go."""
    turns = Turns("gw-2")
    turns.wanted = True
    assert turns.before("gw-3", 0.0) == "gw-2"
    assert turns.before("gw-1", 0.0) == ""
    assert turns.before("gw-2", 0.0) == "gw-1"


def test_one_that_is_at_it_grants_nobody_a_turn() -> None:
    """Also not to one whose name comes before its own."""
    turns = Turns("gw-2")
    turns.wanted = turns.taken = True
    assert turns.before("gw-1", 0.0) == "gw-2"


def test_the_end_of_anothers_turn_is_not_the_end_of_this_one() -> None:
    """A late message of one that had its turn before takes nothing from the one that has it."""
    turns = Turns("gw-2")
    assert turns.before("gw-1", 0.0) == ""
    turns.ended("gw-3")
    assert turns.before("gw-3", 1.0) == "gw-1"


@given(st.lists(st.tuples(st.integers(0, 4), st.integers(0, 4), st.booleans()), max_size=60))
def test_no_two_ever_have_all_grants_at_once(steps: list[tuple[int, int, bool]]) -> None:
    """Five gateways that ask, are refused and end in any order, within the time that a turn lasts."""
    names = [f"gw-{number}" for number in range(5)]
    turns = {name: Turns(name) for name in names}
    granted: dict[str, set[str]] = {name: set() for name in names}
    for asker, asked, ends in steps:
        name, other = names[asker], names[asked]
        if ends:
            for each in turns.values():
                each.ended(name)
            granted[name] = set()
            turns[name].wanted = turns[name].taken = False
            continue
        turns[name].wanted = True
        if not turns[other].before(name, 0.0):
            granted[name].add(other)
        turns[name].taken = len(granted[name]) == len(names)
        assert sum(each.taken for each in turns.values()) <= 1
