"""Two processes that go by one gateway's id: noticed by both, and exactly one of them goes."""

from hypothesis import given
from hypothesis import strategies as st

from appliance.model import GatewayStatus
from appliance.plane.namesake import HEARD, HEARD_S, Namesake

processes = st.tuples(st.integers(1, 3), st.integers(1, 3))


def status(process: tuple[int, int]) -> GatewayStatus:
    """What a process tells of itself."""
    return GatewayStatus(id="g0", fleet="f", started_ns=process[0], pid=process[1])


@given(processes, processes, st.integers(1, 40))
def test_of_two_processes_exactly_one_goes(one: tuple[int, int], other: tuple[int, int], times: int) -> None:
    """Each hears the other and itself: once both count, just one of the two has to go; nobody for its own word."""
    sides = {one: Namesake(), other: Namesake()}
    there = dict.fromkeys(sides, False)
    for number in range(times):
        for speaker in sides:
            for process, namesake in sides.items():
                there[process] |= namesake.heard(status(speaker), status(process), float(number))
    enough = one != other and times >= HEARD and times - 1 >= HEARD_S
    assert all(found is enough for found in there.values())
    assert sum(namesake.goes for namesake in sides.values()) == enough


def test_last_words_of_one_that_has_ended_do_not_count() -> None:
    """However many come at once, and whatever is heard of processes that began one after the other."""
    namesake, own = Namesake(), status((9, 9))
    for _ in range(10):
        assert not namesake.heard(status((1, 1)), own, 5.0)
    for at in range(10, 40):
        for _ in range(2):
            assert not namesake.heard(status((at, at)), own, float(at))
    assert not namesake.goes


def test_of_several_each_is_heard() -> None:
    """Three processes of one id that speak by turns: the one that began first stays."""
    began = [(1, 5), (2, 4), (3, 3)]
    sides = {each: Namesake() for each in began}
    for at in range(10):
        for speaker in began:
            for process, namesake in sides.items():
                namesake.heard(status(speaker), status(process), float(at))
    assert [namesake.goes for namesake in sides.values()] == [False, True, True]


def test_a_process_that_does_not_say_when_it_began_is_nobodys_namesake() -> None:
    """Nor is anybody while this one has told nothing of itself."""
    namesake = Namesake()
    for at in range(10):
        assert not namesake.heard(status((0, 1)), status((9, 9)), float(at))
        assert not namesake.heard(status((1, 1)), status((0, 9)), float(at))
        assert not namesake.heard(status((1, 1)), None, float(at))
