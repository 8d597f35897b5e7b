"""Processes that go by one gateway's id: noticed when they go on, and all but one of them go."""

from hypothesis import given
from hypothesis import strategies as st

from appliance.model import GatewayStatus
from appliance.plane.membership import NAMESAKE_S, NAMESAKE_STATUSES, Suspicion, goes, process

processes = st.tuples(st.integers(1, 3), st.integers(1, 3))


def status(of: tuple[int, int]) -> GatewayStatus:
    """What a process tells of itself."""
    return GatewayStatus(id="g0", fleet="f", started_ns=of[0], pid=of[1])


@given(st.lists(processes, min_size=1, max_size=4, unique=True), st.integers(1, 40))
def test_each_hears_of_the_others_and_all_but_one_go(them: list[tuple[int, int]], times: int) -> None:
    """Each hears all, itself too: one that has namesakes suspects so after a while; just one of them stays."""
    sides = {each: Suspicion() for each in them}
    suspects = dict.fromkeys(them, False)
    for number in range(times):
        for speaker in them:
            for each, suspicion in sides.items():
                suspects[each] |= suspicion.heard(status(speaker), status(each), float(number))
    enough = len(them) > 1 and times >= NAMESAKE_STATUSES and times - 1 >= NAMESAKE_S
    assert all(found is enough for found in suspects.values())
    stays = [each for each in them if not goes(each, [process(status(other)) for other in them if other != each])]
    assert stays == [min(them)]


def test_last_words_of_one_that_has_ended_do_not_count() -> None:
    """However many come at once, and whatever is heard of processes that began one after the other."""
    suspicion, own = Suspicion(), status((9, 9))
    for _ in range(10):
        assert not suspicion.heard(status((1, 1)), own, 5.0)
    for at in range(10, 40):
        for _ in range(2):
            assert not suspicion.heard(status((at, at)), own, float(at))


def test_a_process_that_does_not_say_when_it_began_is_nobodys_namesake() -> None:
    """Nor is anybody while this one has told nothing of itself; and where nobody else is, nobody goes."""
    suspicion = Suspicion()
    for at in range(10):
        assert not suspicion.heard(status((0, 1)), status((9, 9)), float(at))
        assert not suspicion.heard(status((1, 1)), status((0, 9)), float(at))
        assert not suspicion.heard(status((1, 1)), None, float(at))
    assert not goes((9, 9), [])
