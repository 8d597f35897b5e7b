"""When links are made again after questions at wrong doors: nobody's word alone breaks a link that others use."""

from hypothesis import given
from hypothesis import strategies as st

from appliance.plane.link import CALM_S
from appliance.plane.session import WITNESS_S, Mixups

times = st.lists(st.floats(0, 1000, allow_nan=False), max_size=60).map(sorted)


@given(times)
def test_one_session_alone_never_breaks_links_of_others(at: list[float]) -> None:
    """However often a session meets wrong doors, and whatever it leaves unsaid, other links stay."""
    mixups = Mixups()
    assert not any(mixups.relayed("one", now) or mixups.relayed("", now) for now in at)


@given(times, st.lists(st.sampled_from("abc"), min_size=60, max_size=60))
def test_links_are_made_anew_only_when_two_have_met_a_wrong_door_lately(at: list[float], names: list[str]) -> None:
    """Each time there are two different sessions within the last minute, and the last time was long enough ago."""
    mixups, met, last = Mixups(), list[tuple[float, str]](), -CALM_S
    for now, name in zip(at, names, strict=False):
        met.append((now, name))
        if mixups.relayed(name, now):
            assert len({each for when, each in met if now - when <= WITNESS_S}) >= 2
            assert now >= last + CALM_S
            last, met = now, []


def test_a_link_of_its_own_is_made_anew_at_once_and_not_again_at_once() -> None:
    """Each link has its own pause: one that does not get better does not hold up another."""
    mixups = Mixups()
    assert mixups.direct("one", 0.0)
    assert not mixups.direct("one", CALM_S / 2)
    assert mixups.direct("two", CALM_S / 2)
    assert mixups.direct("one", CALM_S)


def test_what_is_remembered_is_bounded() -> None:
    """A flood of names leaves no more than a bound of them."""
    mixups = Mixups()
    for number in range(5000):
        mixups.relayed(f"r{number}", 0.0)
        mixups.direct(f"d{number}", 0.0)
    assert len(mixups._seen) <= 64
    assert len(mixups._broken) <= 64
