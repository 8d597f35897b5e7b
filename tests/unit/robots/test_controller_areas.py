"""Closed areas while a vehicle flies, against the simulated autopilot, however rarely it tells where it is."""

import asyncio
from collections.abc import Container

import pytest

from appliance.model import Box, Site
from appliance.robots.verbs import RobotFailure
from tests.unit.robots.flown import Endless, Flown
from workshop.robots.flight import Point

pytestmark = pytest.mark.anyio


async def test_what_goes_through_a_narrow_area_between_two_looks_is_stopped(flown: Flown) -> None:
    """It was on one side of a wall and is on the other, and no look found it inside."""
    flown.craft.site = Site(forbidden=(Box(name="the line", x=(-50.0, 50.0), y=(10.0, 10.05)),))
    await flown.arm()
    flown.sim.flight.position = flown.sim.flight.target = Point(0.0, 5.0, 5.0)
    assert await flown.craft.confirm(lambda: abs(flown.craft.position().y - 5.0) < 1.0)
    way = Endless()
    going = asyncio.create_task(way.travel(flown.craft))
    assert await flown.craft.confirm(lambda: way.looks > 0)
    flown.sim.flight.position = flown.sim.flight.target = Point(0.0, 15.0, 5.0)
    with pytest.raises(RobotFailure, match="stopped during goto: it went through the line") as caught:
        await going
    assert caught.value.failure.code == "refused"


Told = list[tuple[float, float, float]]
"""Where it says that it was: x, y, and the time of its own clock in seconds."""

_HANGAR = Box(name="the hangar", x=(0.0, 40.0), y=(0.0, 40.0))


async def _goes(flown: Flown, area: Box, told: Told) -> None:
    """Be under way for some looks; all but the first position is heard at once, between two of them."""
    flown.craft.site = Site(forbidden=(area,))
    await flown.arm()
    flown.placed = True
    flown.tell(*told[0])
    way = Endless()
    going = asyncio.create_task(way.travel(flown.craft))
    assert await flown.craft.confirm(lambda: way.looks > 0)
    for each in told[1:]:
        flown.tell(*each)
    way.over = way.looks + 2
    await going


def _past_the_corner(every_s: float, *, first_s: float = 0.0, missing: Container[int] = ()) -> Told:
    """Along (0, 30), (0, 0), (30, 0) at 5 m/s, without the reports of those numbers; at the corner after 6 s."""
    times = [first_s + number * every_s for number in range(round(12.0 / every_s)) if number not in missing]
    return [(max(5.0 * time - 30.0, 0.0), max(30.0 - 5.0 * time, 0.0), 1000.0 + time) for time in times]


@pytest.mark.parametrize(
    "told",
    [
        pytest.param(_past_the_corner(0.2), id="5 Hz"),
        pytest.param(_past_the_corner(0.2, missing=(29, 30, 31)), id="three of 5 Hz lost"),
        pytest.param(_past_the_corner(1.0), id="1 Hz"),
        pytest.param(_past_the_corner(1.0, first_s=0.5), id="1 Hz, none at the corner"),
        pytest.param([(-3.0, 5.0, 1000.0), (5.0, -3.0, 1003.0)], id="an outage of 3 s"),
        pytest.param([(-3.0, 20.0, 1000.0), (43.0, 20.0, 1030.0)], id="the other side after an outage"),
        pytest.param([(-3.0, 20.0, 1000.0), (43.0, 20.0, 1.0)], id="a clock that began again"),
    ],
)
async def test_a_gap_in_the_positions_is_no_flight_through_an_area(flown: Flown, told: Told) -> None:
    """It went round the corner as it was allowed to, and told so seldom: it goes on."""
    await _goes(flown, _HANGAR, told)
    assert not [each for each in flown.sent if each.get_type() == "SET_POSITION_TARGET_LOCAL_NED"]


@pytest.mark.parametrize(
    "told",
    [
        pytest.param([(-5.0, 10.0, 1000.0), (5.0, 10.0, 1003.0)], id="after an outage"),
        pytest.param([(-2.0, 2.0, 1000.0), (2.0, 2.0, 1001.0), (2.0, -2.0, 1002.0)], id="for a moment"),
    ],
)
async def test_what_was_inside_an_area_is_stopped(flown: Flown, told: Told) -> None:
    """However long nothing was heard before, and where it had left again before anybody looked."""
    with pytest.raises(RobotFailure, match="stopped during goto: it is in the hangar") as caught:
        await _goes(flown, _HANGAR, told)
    assert caught.value.failure.code == "refused"


async def test_a_thin_wall_is_not_crossed_unseen_though_nobody_looked_in_time(flown: Flown) -> None:
    """Told at 5 Hz and heard all at once: the times of the reports count, not that of looking."""
    told = [(number - 5.5, 20.0, 1000.0 + number * 0.2) for number in range(12)]
    with pytest.raises(RobotFailure, match="stopped during goto: it went through the line"):
        await _goes(flown, Box(name="the line", x=(0.0, 0.02), y=(0.0, 40.0)), told)
