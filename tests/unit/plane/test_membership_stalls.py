"""Noticing that this process stood still."""

import asyncio

import pytest

from appliance.plane.events import FleetEvent, FleetEvents, Stage, Stall, Stalled
from appliance.plane.membership import StallDetector

pytestmark = pytest.mark.anyio


class Clock:
    """A clock that is set by hand."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        """Tell the time."""
        return self.now


async def test_standing_still_is_noticed_by_whoever_looks_first() -> None:
    """Three quarters of a lease without a beat put a gateway in doubt for a lease, and its listeners hear of it."""
    clock, told = Clock(), asyncio.Event()
    events = FleetEvents()
    pulse = StallDetector(1.0, events=events, clock=clock)
    events.subscribe(Stage.WATCHERS, lambda _: told.set())
    pulse.start()
    try:
        for _ in range(8):
            clock.now += 0.7
            assert not pulse.doubtful
        assert pulse.stalls == 0
        clock.now += 0.75
        assert pulse.doubtful
        assert pulse.stalls == 1
        await told.wait()
        clock.now += 0.6
        assert pulse.doubtful
        clock.now += 0.4
        assert not pulse.doubtful
        assert pulse.stalls == 1
    finally:
        pulse.close()


async def test_each_standstill_is_told_as_what_it_was() -> None:
    """A second, shorter one before the event loop gets its turn does not hide the first."""
    clock, both = Clock(), asyncio.Event()
    told: list[FleetEvent] = []

    def take(event: FleetEvent) -> None:
        told.append(event)
        if len(told) == 2:
            both.set()

    events = FleetEvents()
    pulse = StallDetector(1.0, events=events, clock=clock)
    events.subscribe(Stage.WATCHERS, take)
    pulse.start()
    try:
        for seconds in (5.0, 0.75):
            clock.now += seconds
            assert pulse.doubtful
        await both.wait()
    finally:
        pulse.close()
    assert told == [Stalled(Stall(100.0, 5.0)), Stalled(Stall(105.0, 0.75))]


async def test_time_before_the_start_and_after_the_end_counts_for_nothing() -> None:
    """A gateway that is still opening or already closed did not stand still."""
    clock = Clock()
    pulse = StallDetector(1.0, events=FleetEvents(), clock=clock)
    clock.now += 60
    assert not pulse.doubtful
    pulse.start()
    pulse.close()
    clock.now += 60
    assert pulse.stalls == 0
    pulse.close()


async def test_the_pulse_beats_while_the_loop_is_held_up() -> None:
    """What only keeps the event loop busy for longer than a lease is no standing still."""
    beats: list[float] = []

    def clock() -> float:
        beats.append(0.0)
        return 0.0

    pulse = StallDetector(0.01, events=FleetEvents(), clock=clock)
    pulse.start()
    try:
        while len(beats) < 10:  # the loop gets no turn
            pass
    finally:
        pulse.close()
    assert pulse.stalls == 0
