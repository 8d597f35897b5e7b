"""Leases of robots by one gateway's clock: one holds, renewals keep it, and an end is an end."""

from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.model import Lease
from appliance.robots.authority.lease import EXPIRED, MOST, Leases


def lease(name: str, robot: str = "r1", **fields: object) -> Lease:
    """Return a lease of 10 s."""
    return Lease(id=name, robot=robot, by=name, **{"lease_s": 10.0, **fields})  # type: ignore[arg-type]


def test_it_holds_until_it_is_not_renewed() -> None:
    """Each renewal counts from when it was heard; then the lease is over, and a late renewal does not bring it back."""
    it = Leases()
    assert it.hear(lease("a"), 0.0)
    assert it.left_s("r1", 4.0) == 6.0
    assert not it.hear(lease("a", renewal=1), 8.0)
    assert it.expire(17.9) == ()
    assert it.expire(18.0) == (lease("a", renewal=1, ended=EXPIRED),)
    assert it.of("r1") is None
    assert not it.hear(lease("a", renewal=2), 18.1)
    assert it.of("r1") is None


def test_a_lease_that_is_over_keeps_the_robot_until_its_end_is_told() -> None:
    """It moves nothing any more; a renewal that was only late to be heard counts, unless the end is on its way."""
    it = Leases()
    it.hear(lease("a"), 0.0)
    assert it.due(9.9) == ()
    assert not it.over("r1")
    assert it.due(10.0) == (lease("a"),)
    assert it.over("r1")
    assert it.expire(12.9, 3.0) == ()
    assert it.of("r1") == lease("a")
    it.hear(lease("a", renewal=1), 12.9)
    assert not it.over("r1")
    assert it.due(23.0) == (lease("a", renewal=1),)
    assert it.end(lease("a", renewal=1)).ended == EXPIRED
    assert it.due(23.1) == ()
    it.hear(lease("a", renewal=2), 23.1)
    assert it.over("r1")
    assert [each.id for each in it.expire(25.9, 3.0)] == ["a"]
    assert it.of("r1") is None


def test_another_lease_does_not_take_a_robot_that_is_held() -> None:
    """Of two that were given on two sides of a partition the same one stands everywhere."""
    for order in (("a", "b"), ("b", "a")):
        it = Leases()
        for name in order:
            it.hear(lease(name), 0.0)
        held = it.of("r1")
        assert held is not None
        assert held.id == "a"


def test_an_end_frees_the_robot_for_the_next() -> None:
    """The next operator has it; the end of another lease changes nothing."""
    it = Leases()
    it.hear(lease("a"), 0.0)
    assert not it.hear(lease("x", ended="given back"), 1.0)
    assert it.hear(lease("a", ended="given back"), 1.0)
    assert it.hear(lease("b"), 1.5)
    assert [each.id for each in it.all] == ["b"]
    assert it.next_s(2.0) == 9.5


@given(st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 3), st.booleans(), st.floats(0.0, 5.0)), max_size=30))
def test_a_lease_never_comes_back_and_never_outlives_its_time(events: list[tuple[str, int, bool, float]]) -> None:
    """Whatever is heard in whatever order: what has ended stays so, and what holds was heard within its time."""
    it, now = Leases(), 0.0
    ended: set[str] = set()
    for name, renewal, over, pause in events:
        now += pause
        ended |= {each.id for each in it.expire(now)}
        told = lease(name, renewal=renewal, lease_s=3.0)
        it.hear(replace(told, ended="given back") if over else told, now)
        if over:
            ended.add(name)
        held = it.of("r1")
        assert held is None or held.id not in ended
        assert it.left_s("r1", now) <= 3.0 + 1e-6


def test_what_is_remembered_is_bounded() -> None:
    """More robots than there can be are not taken in, and ends are forgotten in turn."""
    it = Leases()
    for number in range(MOST + 20):
        it.hear(lease(f"l{number}", f"r{number}"), 0.0)
    assert len(it.all) == MOST
    assert not it.room("another")
    assert it.room("r1")
    it.expire(100.0)
    assert it.all == ()
