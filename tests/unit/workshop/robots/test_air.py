"""The bad radio link: what it loses, doubles and mixes up, the same each time."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import ConfigError
from workshop.robots.air import Air, Channel

AIRS = st.builds(
    Air,
    drop=st.floats(0, 0.9),
    double=st.floats(0, 0.9),
    mix=st.floats(0, 0.9),
    delay_s=st.floats(0, 2),
    seed=st.integers(0, 1000),
)


def carried(air: Air, count: int = 200) -> list[int]:
    """Send numbers 20 ms apart; return them as they arrive."""
    channel: Channel[int] = Channel(air, direction=0)
    found: list[int] = []
    for number in range(count):
        channel.send(number, number * 0.02)
        found += channel.due(number * 0.02)
    return found + channel.due(1e9)


@given(AIRS)
def test_nothing_is_made_up_and_the_seed_decides(air: Air) -> None:
    """What arrives was sent, at most twice, and a second run is the same."""
    found = carried(air)
    assert set(found) <= set(range(200))
    assert all(found.count(number) <= 2 for number in set(found))
    assert found == carried(air)


def test_each_fault_does_what_it_is_called() -> None:
    """A clean link keeps all in order; each share on its own does its own harm, and more or less as much as asked."""
    assert carried(Air()) == list(range(200))
    assert 100 < len(carried(Air(drop=0.3), 200)) < 180
    assert len(carried(Air(double=0.3), 200)) > 230
    mixed = carried(Air(mix=0.3, delay_s=0.1))
    assert sorted(mixed) == list(range(200))
    assert mixed != sorted(mixed)


@pytest.mark.parametrize("air", [Air(drop=1.0), Air(mix=-0.1), Air(double=float("nan")), Air(delay_s=11)])
def test_what_cannot_be(air: Air) -> None:
    """Shares outside 0 to 1 and long delays are refused."""
    with pytest.raises(ConfigError):
        air.check()
