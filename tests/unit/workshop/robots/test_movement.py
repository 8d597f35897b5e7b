"""How the simulated robots move."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from workshop.robots.driving import ARRIVED_M, TOP_MPS, Driving
from workshop.robots.flight import ACCELERATION, CLIMB_MPS, Flight, Point

METRES = st.floats(-50, 50)


@given(x=METRES, y=METRES, z=st.floats(1, 30), speed=st.floats(0.5, 8.0))
def test_the_copter_gets_there_within_its_limits(x: float, y: float, z: float, speed: float) -> None:
    """It arrives, never faster than its speed nor changing speed faster than its acceleration, and stays."""
    flight = Flight(speed=speed)
    flight.armed = True
    flight.target = Point(x, y, z)
    for _ in range(6000):
        before = flight.velocity
        flight.step(0.05)
        assert math.hypot(flight.velocity.x, flight.velocity.y) <= speed + 0.01
        assert flight.velocity.z <= CLIMB_MPS + 0.01
        assert math.dist(before, flight.velocity) <= ACCELERATION * 0.05 + 1e-6
        if flight.near(flight.target, 0.3):
            break
    assert flight.near(flight.target, 0.3)
    flight.step(10.0)
    assert flight.near(flight.target, 0.5)


def test_an_unarmed_copter_stays() -> None:
    """Without armed motors nothing moves, whatever the target."""
    flight = Flight()
    flight.target = Point(1, 1, 5)
    flight.step(5.0)
    assert flight.position == Point(0, 0, 0)


def test_flying_empties_the_battery() -> None:
    """A battery runs down in the air, and never below nothing."""
    flight = Flight(battery_percent=0.5)
    flight.armed = True
    flight.target = Point(0, 0, 10)
    flight.step(60.0)
    assert flight.battery_percent == 0.0


@given(way=st.lists(st.tuples(METRES, METRES), min_size=1, max_size=5), speed=st.floats(0.3, 10.0))
def test_the_rover_drives_its_whole_way(way: list[tuple[float, float]], speed: float) -> None:
    """It ends at the last waypoint, not faster than it can."""
    driving = Driving(0.0, 0.0)
    driving.go(way, speed)
    for _ in range(20_000):
        driving.step(0.1)
        assert driving.speed <= min(speed, TOP_MPS) + 1e-9
        if not driving.moving:
            break
    assert not driving.moving
    assert math.hypot(driving.x - way[-1][0], driving.y - way[-1][1]) <= ARRIVED_M + 1e-9


def test_halt_and_empty_battery() -> None:
    """Halted it stays where it is; without charge it does not move; charging has an end."""
    driving = Driving(0.0, 0.0)
    driving.go([(10.0, 0.0)], None)
    driving.step(3.0)
    here = driving.pose
    driving.halt()
    driving.step(3.0)
    assert (driving.pose.x, driving.moving) == (here.x, False)
    empty = Driving(0.0, 0.0, battery_percent=0.0)
    empty.go([(10.0, 0.0)], None)
    empty.step(5.0)
    assert empty.pose.x == 0.0
    empty.charge(1000.0)
    assert empty.battery_percent == pytest.approx(100.0)
