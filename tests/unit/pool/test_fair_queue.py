"""Whose turn it is: priority, deadlines and fairness hold for whatever waits, and nothing starves."""

import math
from collections import Counter

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.pool.fair_queue import AGING_S, Completions, Turn, Turns

NAMES = st.sampled_from(("ann", "bob", "cas", ""))


@st.composite
def lines(draw: st.DrawFn) -> list[Turn]:
    """Some who wait, with whatever priorities, deadlines, submitters and costs."""
    return [
        Turn(
            id=str(number),
            number=number,
            submitter=draw(NAMES),
            priority=draw(st.integers(0, 9)),
            due_at=draw(st.one_of(st.just(math.inf), st.floats(0, 100))),
            since=draw(st.floats(0, 50)),
            cost=draw(st.floats(0.1, 10)),
        )
        for number in range(draw(st.integers(0, 24)))
    ]


@settings(deadline=None)
@given(lines(), st.floats(50, 200))
def test_all_who_wait_are_in_the_order_once(waiting: list[Turn], now: float) -> None:
    """Nobody is lost or doubled, and the order in which they came to the function does not matter."""
    found = Turns().order(waiting, now)
    assert Counter(each.id for each in found) == Counter(each.id for each in waiting)
    assert Turns().order(reversed(waiting), now) == found


@settings(deadline=None)
@given(lines(), st.floats(50, 200))
def test_priority_goes_before_deadline_and_deadline_before_fairness(waiting: list[Turn], now: float) -> None:
    """Levels never rise along the order, and within one level deadlines never fall."""
    found = Turns().order(waiting, now)
    keys = [(-each.level(now), each.due_at) for each in found]
    assert keys == sorted(keys)


@settings(deadline=None)
@given(lines(), st.floats(50, 200))
def test_serving_one_by_one_follows_the_order_told(waiting: list[Turn], now: float) -> None:
    """What `order` says is what happens if nobody else comes: positions told to people are true."""
    turns, left, served = Turns(), list(waiting), list[Turn]()
    told = turns.order(left, now)
    while left:
        turn = turns.order(left, now)[0]
        turns.served(turn)
        left.remove(turn)
        served.append(turn)
    assert served == told


@settings(deadline=None)
@given(st.integers(1, 300), st.integers(0, 50))
def test_a_flood_does_not_starve_another_submitter(flood: int, before: int) -> None:
    """However many one submitter has waiting and was served before, another's first is next or the one after that."""
    turns = Turns()
    for number in range(before):
        turns.served(Turn(id=f"b{number}", number=number, submitter="flood"))
    waiting = [Turn(id=f"f{number}", number=number, submitter="flood") for number in range(flood)]
    late = Turn(id="late", number=flood, submitter="other", since=1.0)
    assert turns.order([*waiting, late], 2.0).index(late) <= 1


@settings(deadline=None)
@given(st.lists(NAMES, min_size=1, max_size=60))
def test_submitters_who_all_wait_are_served_alike(names: list[str]) -> None:
    """At every step, no submitter that still waits is more than one behind another."""
    waiting = [Turn(id=str(number), number=number, submitter=name) for number, name in enumerate(names)]
    had, left = Counter[str](), Counter(names)
    for turn in Turns().order(waiting, 0.0):
        assert all(had[turn.submitter] <= had[other] for other, count in left.items() if count)
        had[turn.submitter] += 1
        left[turn.submitter] -= 1


@settings(deadline=None)
@given(st.integers(0, 9), st.integers(0, 9))
def test_waiting_ends_however_much_of_higher_priority_comes(mine: int, others: int) -> None:
    """With one of another's coming for every one served, for ever, mine is served within the time aging allows."""
    turns, step_s = Turns(aging_s=10.0), 1.0
    me = Turn(id="me", number=0, submitter="me", priority=mine, since=0.0)
    for number in range(1, 400):
        now = number * step_s
        # It has the earliest of deadlines, too: within one level it always goes first.
        rival = Turn(id=str(number), number=number, submitter="rival", priority=others, since=now, due_at=now)
        first = turns.order([me, rival], now)[0]
        turns.served(first)
        if first is me:
            assert now <= 10.0 * (max(0, others - mine) + 1)
            return
    pytest.fail("it starved")


def test_having_asked_for_nothing_earns_nothing() -> None:
    """Who comes after a long time takes turns with the others at once, instead of being served for all that time."""
    turns = Turns()
    for number in range(100):
        turns.served(Turn(id=str(number), number=number, submitter="steady"))
    waiting = [Turn(id=f"{name}{n}", number=n, submitter=name) for n in range(4) for name in ("steady", "new")]
    first = [each.submitter for each in turns.order(waiting, 0.0)[:4]]
    assert Counter(first) == {"steady": 2, "new": 2}


def test_aging_counts_whole_steps() -> None:
    """A priority is raised by one after each `AGING_S`, and by nothing before."""
    turn = Turn(id="a", number=1, priority=3, since=100.0)
    assert [turn.level(100.0 + seconds) for seconds in (0, AGING_S - 0.1, AGING_S, 2.5 * AGING_S)] == [3, 3, 4, 5]


def test_expected_waits_come_from_what_was_measured() -> None:
    """Nothing is estimated before anything was measured; then mean time, position and how many are served at once."""
    completions = Completions()
    assert completions.expected_s(3, 2) is None
    completions.ended(2.0)
    assert completions.expected_s(3, 2) == pytest.approx(3.0)
    completions.ended(-1.0)  # a clock that was set back is no measure
    assert completions.mean_s == pytest.approx(2.0)
