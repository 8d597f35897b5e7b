"""What a gateway compares next: losses before arrivals, then holders of what it gains, and it comes to an end."""

from hypothesis import given
from hypothesis import strategies as st

from appliance.plane.anti_entropy import Settled, StepKind, Steps
from appliance.plane.ring import Ring

REPLICAS = 3
names = st.sampled_from([f"g{number}" for number in range(9)])
fleets = st.frozensets(names, min_size=0, max_size=8).map(lambda found: found | {"me"})


def ring(members: frozenset[str]) -> Ring:
    """A ring with enough points for every member to have neighbours of all kinds."""
    return Ring(members, virtual_nodes=4)


@given(fleets, fleets)
def test_whoever_held_what_is_gained_by_a_loss_is_asked_before_anybody_who_has_come(
    before: frozenset[str], now: frozenset[str]
) -> None:
    """A step for those that went asks every holder, still there, of a key that becomes this gateway's; nobody new."""
    old, new = ring(before), ring(now)
    step = Steps("me", replicas=REPLICAS).next(Settled(old, 0), new, 0)
    if before - now:
        assert step.kind is StepKind.LOSS
        assert step.ring.members == before & now
        assert set(step.asked) <= before & now
        for number in range(60):
            key = f"key/{number}"
            if new.owner(key) == "me" != old.owner(key):
                assert step.ring.owner(key) == "me"
                assert set(old.successors(key, REPLICAS)) & now - {"me"} <= set(step.asked)
    else:
        assert step.kind is (StepKind.REST if before == now else StepKind.ARRIVAL)


@given(st.lists(st.tuples(fleets, st.integers(0, 2)), min_size=1, max_size=8))
def test_a_ring_that_stands_still_is_settled_after_two_steps(history: list[tuple[frozenset[str], int]]) -> None:
    """Whatever has changed, and whichever steps were done or given up on the way."""
    steps = Steps("me", replicas=REPLICAS)
    settled, stalls = None, 0
    for members, count in history:
        stalls += count == 2
        now = ring(members)
        for _ in range(count):
            step = steps.next(settled, now, stalls)
            assert "me" in step.ring.members
            assert not steps.urgent(step, members, stalls)
            settled = steps.settled(step)
    for _ in range(2):
        settled = steps.settled(steps.next(settled, now, stalls))
    assert settled == Settled(now, stalls)
    assert steps.next(settled, now, stalls).kind is StepKind.REST


@given(fleets, fleets)
def test_a_loss_interrupts_what_can_wait_and_nothing_interrupts_a_takeover_but_one_who_is_asked(
    before: frozenset[str], now: frozenset[str]
) -> None:
    """A round at rest or with one who has come ends when anybody is lost; one for a loss when it asks in vain."""
    steps = Steps("me", replicas=REPLICAS)
    step = steps.next(Settled(ring(before), 0), ring(now), 0)
    assert steps.urgent(step, now, 1)
    for lost in step.ring.members - {"me"}:
        urgent = steps.urgent(step, now - {lost}, 0)
        assert urgent == (step.kind is not StepKind.LOSS or lost in step.asked)
