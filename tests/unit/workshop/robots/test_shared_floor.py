"""The floor in virtual time, with the product's decider: no two robots too near, nobody waits for ever."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.errors import ConfigError
from appliance.model import Box, Place, Site
from appliance.skills.sites import load_site
from workshop.bench.floor import Options, kept, measure
from workshop.robots.shared_floor import FloorSimulation, Mode, run


def test_the_warehouse_of_four() -> None:
    """Nobody comes too near to another; without reservations they do, and one at a time is slower."""
    site = load_site("warehouse")

    def simulate(mode: Mode) -> tuple[int, int, int]:
        found = run(site, robots=4, mode=mode, seconds=120.0, down_s=10.0)
        return found.collisions, found.deadlocks, found.visits

    reserved, alone, none = simulate("reserved"), simulate("alone"), simulate("none")
    assert reserved[:2] == (0, 0)
    assert none[0] > 0
    assert alone[2] < reserved[2] < none[2]


AISLE = Site(
    places={
        "west": Place(x=2.0, y=5.0),
        "east": Place(x=28.0, y=5.0),
        "dock 1": Place(x=2.0, y=8.0),
        "dock 2": Place(x=28.0, y=8.0),
    },
    fence=Box(name="fence", x=(0.0, 30.0), y=(0.0, 10.0)),
    # Between the two sides there is room for one at a time.
    obstacles=(Box(name="south", x=(8.0, 22.0), y=(0.0, 4.2)), Box(name="north", x=(8.0, 22.0), y=(5.8, 10.0))),
)


def test_an_aisle_for_one() -> None:
    """Robots that meet at an aisle pass it one after the other, from both sides, and all get on."""
    simulation = FloorSimulation(AISLE, robots=4)
    found = simulation.run(300.0)
    assert (found.collisions, found.deadlocks) == (0, 0)
    assert all(robot.number >= 4 for robot in simulation.robots)


@st.composite
def sites(draw: st.DrawFn) -> Site:
    """Sites with places on a grid and obstacles between them."""
    spots = draw(st.lists(st.tuples(st.integers(0, 4), st.integers(0, 3)), min_size=4, max_size=8, unique=True))
    kinds = draw(st.lists(st.sampled_from(["dock", "yard"]), min_size=8, max_size=8))
    places = {
        f"{kind} {number}": Place(x=3.0 + 6.0 * x, y=3.0 + 6.0 * y)
        for number, ((x, y), kind) in enumerate(zip(spots, kinds, strict=False))
    }
    blocks = draw(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 3)), max_size=5, unique=True))
    obstacles = tuple(
        Box(name=f"rack {x} {y}", x=(4.8 + 6.0 * x, 7.2 + 6.0 * x), y=(1.5 + 6.0 * y, 4.5 + 6.0 * y)) for x, y in blocks
    )
    return Site(places=places, obstacles=obstacles, fence=Box(name="fence", x=(0.0, 30.0), y=(0.0, 24.0)))


@settings(max_examples=8, deadline=None)
@given(sites(), st.integers(0, 1000))
def test_no_two_too_near_on_any_site(site: Site, seed: int) -> None:
    """Whatever the map and the places that they go to."""
    found = FloorSimulation(site, robots=3, seed=seed, down_s=10.0).run(60.0)
    assert (found.collisions, found.deadlocks) == (0, 0)


@pytest.mark.long
@pytest.mark.timeout(900)
@settings(max_examples=20, deadline=None)
@given(sites(), st.integers(0, 1000))
def test_no_two_of_six_too_near_on_any_site(site: Site, seed: int) -> None:
    """The same with more robots, for longer."""
    found = FloorSimulation(site, robots=6, seed=seed, down_s=10.0).run(240.0)
    assert (found.collisions, found.deadlocks) == (0, 0)


def test_what_cannot_be_simulated() -> None:
    """It is refused with what can."""
    for options in (Options(robots=()), Options(robots=(999,)), Options(seconds=0.0), Options(down_s=60.0)):
        with pytest.raises(ConfigError, match="s"):
            options.check()


def test_figures() -> None:
    """One row for each number of robots and mode, the ratios, and whether the promise was kept."""
    found = measure(Options(robots=(2,), seconds=20.0))
    assert [row["mode"] for row in found["runs"]] == ["reserved", "alone", "none"]
    assert found["kept"]
    assert not kept([{"mode": "reserved", "collisions": 1, "deadlocks": 0}])
