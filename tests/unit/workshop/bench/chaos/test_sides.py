"""Orders on both sides of a partition: the same for the same seed, and what became of them, counted rightly."""

from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.model import Decision, TaskRecord, TaskState, Word
from workshop.bench.chaos.partition import KINDS, Agreement, Cut, Given, account, broken, contested, view
from workshop.bench.net.faults import FAULTS, PARTITION, phases

ROBOTS = ("ledger_1", "ledger_2")
SIDES = (("gw-1", "gw-2"), ("gw-3", "gw-4"))


def record(state: TaskState = TaskState.SUCCEEDED, **fields: Any) -> TaskRecord:
    """A task's record in the end."""
    return TaskRecord(id="t", instruction="x", state=state, **fields)


@settings(deadline=None)
@given(seed=st.integers(0, 1000), cut=st.integers(0, 5), rounds=st.integers(1, 3))
def test_every_kind_of_conflict_is_ordered_both_ways_round(seed: int, cut: int, rounds: int) -> None:
    """Each kind as often each way round, no task twice, and the same again for the same seed."""
    found = contested(cut, rounds=rounds, robots=ROBOTS, seed=seed)
    assert found == contested(cut, rounds=rounds, robots=ROBOTS, seed=seed)
    assert len({each.wanted.task for each in found}) == len(found)
    for one, other in KINDS:
        for pair in {(one, other), (other, one)}:
            assert sum(each.orders == pair for each in found) == rounds
    assert not {each.wanted.task for each in found} & {
        each.wanted.task for each in contested(cut + 1, rounds=rounds, robots=ROBOTS, seed=seed)
    }


@pytest.mark.parametrize(("fault_s", "lengths"), [(0.0, [5.0, 60.0]), (7.0, [7.0])])
def test_a_partition_comes_several_times_between_the_same_sides(fault_s: float, lengths: list[float]) -> None:
    """Other faults come once; a length that is asked for is the only one."""
    names = [name for side in SIDES for name in side]
    found = phases(FAULTS, names, fault_s=fault_s, rest_s=1.0, seed=3, cuts_s=(5.0, 60.0))
    cuts = [each for each in found if each.name == PARTITION]
    assert [each.until_s - each.at_s for each in cuts] == lengths
    assert len({each.sides for each in cuts}) == 1
    assert len(found) == len(FAULTS) - 1 + len(lengths)
    assert all(later.at_s == earlier.until_s + 1.0 for earlier, later in pairwise(found))


def test_gateways_agree_when_the_last_difference_that_stayed_is_gone() -> None:
    """One round that differs is a task that moved on; two are a gateway that does not know, and so is an error."""
    succeeded, waits = view(record()), view(record(TaskState.PROPOSED))
    agreement = Agreement(["a", "b"])
    agreement.heard("a", {"gw-1": succeeded, "gw-2": succeeded}, 0.1)
    agreement.heard("b", {"gw-1": waits, "gw-2": succeeded}, 0.1)
    assert agreement.apart == ["b: gw-1 proposed ('', ''); gw-2 succeeded ('', '')"]
    agreement.heard("b", {"gw-1": "unreachable", "gw-2": succeeded}, 0.4)
    agreement.heard("b", {"gw-1": succeeded, "gw-2": succeeded}, 0.9)
    assert (agreement.apart, agreement.at_s) == ([], 0.9)
    agreement.heard("a", {"gw-1": waits, "gw-2": succeeded}, 1.5)
    agreement.heard("a", {"gw-1": succeeded, "gw-2": succeeded}, 1.6)
    assert agreement.at_s == 0.9, "it differed once"
    for at_s in (2.0, 2.1):
        agreement.heard("a", {"gw-1": "unreachable", "gw-2": "unreachable"}, at_s)
    assert agreement.apart, "the same error everywhere is no answer"


def test_an_order_that_was_lost_must_have_been_told_to_its_operator() -> None:
    """What the record shows is not lost; what another was told, or nobody, is lost silently; refusals are neither."""
    orders = [
        Given(task="done", verb="approve", side=0, by="one", act="o-1"),
        Given(task="done", verb="cancel", side=1, by="two", act="o-2"),
        Given(task="stopped", verb="cancel", side=0, by="one", act="o-3"),
        Given(task="stopped", verb="approve", side=1, by="two", act="o-4"),
        Given(task="stopped", verb="approve", side=1, by="two", act="o-5", problem="conflict"),
        Given(task="new", verb="submit", side=0, by="one", act="o-6"),
    ]
    cut = Cut(seconds=5.0, sides=SIDES, given=orders, met_s=0.5, agreed_s=2.0)
    records = {
        "done": record(decision=Decision(approved=True, by="one", act="o-1")),
        "stopped": record(TaskState.CANCELLED, cancelled_by=Word(by="one", act="o-3")),
    }
    found = account([cut], records, {"done/healed/order-o-2": "two", "stopped/healed/order-o-4": "one"})
    assert (found["lost"], found["told"]) == (2, 1)
    assert found["silently"] == ["approve of stopped by two (o-4): it is cancelled"]
    assert len(found["missing"]) == 1
    (row,) = found["cuts"]
    assert row["orders"][1] == {"cancel done": 1, "approve done": 1, "approve conflict": 1}
    assert row["agreed_after_met_s"] == 1.5
    assert len(broken(found, within_s=1.0)) == 3
    assert len(broken(found, within_s=2.0)) == 2
