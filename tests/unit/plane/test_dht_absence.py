"""Whether a record that is not here is nowhere: who must have been heard before an owner says so."""

from hypothesis import given
from hypothesis import strategies as st

from appliance.plane.dht import GONE_S, Absence
from appliance.plane.ring import Ring

NAMES = tuple(f"g{number}" for number in range(8))
KEYS = tuple(f"task/{number}" for number in range(300))


def ring(*names: str) -> Ring:
    """A ring of these gateways."""
    return Ring(names, virtual_nodes=4)


def calm(*names: str) -> Absence:
    """What a gateway knows that has settled with these."""
    made = Absence(replicas=3)
    made.settled(ring(*names))
    made.calm(ring(*names), 0.0)
    return made


def test_a_silent_member_may_have_any_record() -> None:
    """Until it answers, or is lost: what only one of r holders had is not what copies are for."""
    absence = calm(*NAMES)
    absence.asked(("g1", "g2"), frozenset({"g2"}))
    assert absence.doubt("k", 1.0) == ("g2",)
    absence.asked(("g1",), frozenset())
    assert absence.doubt("k", 1.0) == ("g2",)
    absence.calm(ring(*NAMES), 1.0)
    absence.heard(("g2",))
    assert absence.doubt("k", 1.0) == ()
    absence.asked(("g1", "g2"), frozenset({"g2"}))
    absence.lost("g2", 1.0)
    assert absence.doubt("k", 1.0) == ()


@given(st.sets(st.sampled_from(NAMES[1:])))
def test_a_key_is_in_doubt_exactly_while_all_its_holders_are_gone(gone: set[str]) -> None:
    """Of more than copies are for, those keys that only they held; until they count no more or are back."""
    absence = calm(*NAMES)
    for name in gone:
        absence.lost(name, 10.0)
    left = ring(*(set(NAMES) - gone))
    absence.settled(left)
    for key in KEYS:
        holders = ring(*NAMES).successors(key, 3)
        assert absence.doubt(key, 11.0) == (holders if gone.issuperset(holders) else ())
        assert absence.doubt(key, 11.0 + GONE_S) == ()
    absence.settled(ring(*NAMES))
    assert not any(absence.doubt(key, 11.0) for key in KEYS)


def test_a_doubt_outlasts_a_calm_and_those_who_come() -> None:
    """The other side of a cut has its records, however long this one has settled without it."""
    absence = calm(*NAMES)
    for name in NAMES[4:]:
        absence.lost(name, 0.0)
    here = ring(*NAMES[:4])
    absence.settled(here)
    absence.calm(here, 10.0)
    absence.settled(ring(*NAMES[:4], "new"))
    absence.calm(ring(*NAMES[:4], "new"), 20.0)
    doubted = {key for key in KEYS if absence.doubt(key, 21.0)}
    assert doubted == {key for key in KEYS if set(ring(*NAMES).successors(key, 3)) <= set(NAMES[4:])}
    assert doubted
    # And what was written since is in doubt when those are lost too that hold it.
    for name in ("g1", "g2", "new"):
        absence.lost(name, 30.0)
    absence.settled(ring("g0", "g3"))
    now = ring(*NAMES[:4], "new")
    more = {key for key in KEYS if absence.doubt(key, 31.0)} - doubted
    assert {key for key in KEYS if set(now.successors(key, 3)) == {"g1", "g2", "new"}} <= more | doubted
    assert more


def test_those_that_go_one_after_the_other_leave_no_doubt() -> None:
    """A fleet that is made smaller step by step has its copies made again each time."""
    absence = calm(*NAMES)
    for left in range(7, 2, -1):
        absence.lost(NAMES[left], 60.0)
        absence.settled(ring(*NAMES[:left]))
        assert not any(absence.doubt(key, 61.0) for key in KEYS)
        absence.calm(ring(*NAMES[:left]), 70.0)
