"""What a chaos run does: the same for the same seed, and never more gateways down than allowed."""

from hypothesis import given, settings
from hypothesis import strategies as st

from workshop.bench.chaos.plan import outages, tasks

NAMES = [f"gw-{number}" for number in range(1, 9)]


@settings(deadline=None)
@given(seed=st.integers(0, 10_000), most=st.integers(1, 4), every_s=st.floats(0.2, 10.0))
def test_outages_keep_their_bound(seed: int, most: int, every_s: float) -> None:
    """At no time are more gateways down than allowed, and no gateway goes down twice at once."""
    found = outages(NAMES, seconds=60.0, most=most, every_s=every_s, freezes=0.3, seed=seed)
    assert found == outages(NAMES, seconds=60.0, most=most, every_s=every_s, freezes=0.3, seed=seed)
    for each in found:
        at_once = [other.gateway for other in found if other.at_s <= each.at_s < other.until_s]
        assert len(at_once) <= most
        assert len(set(at_once)) == len(at_once)
        assert each.at_s < each.until_s <= each.at_s + 8.0


@settings(deadline=None)
@given(seed=st.integers(0, 10_000))
def test_tasks_are_plans_with_named_effects(seed: int) -> None:
    """Subtasks come only after earlier ones, and every effect has a name of its own."""
    found = tasks(20, seconds=30.0, robots=("ledger_1", "ledger_2"), prefix="c-", seed=seed)
    assert found == tasks(20, seconds=30.0, robots=("ledger_1", "ledger_2"), prefix="c-", seed=seed)
    entries = [entry for task in found for each in task.entries().values() for entry in each]
    assert len(entries) == len(set(entries))
    for task in found:
        ids = [each.id for each in task.plan.subtasks]
        for number, each in enumerate(task.plan.subtasks):
            assert set(each.after) <= set(ids[:number])
