"""Decisions of the floor in a log: what is read back is decided again as it was, and a difference is seen."""

import msgspec
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.floor.decide import Body, Floor, Go, Trip, Wait
from appliance.floor.decisions import Refusal, WayCase, begun, decided, map_of, way_again
from appliance.floor.mover import Mover
from appliance.model import Site, encode
from tests.unit.floor.test_stretches import SIZE, floors

SITE = Site()


@settings(max_examples=60, deadline=None)
@given(floors(), st.lists(st.tuples(st.integers(0, 10**6), st.booleans()), max_size=3), st.booleans())
def test_a_case_alone_gives_the_decision_again(
    drawn: tuple[Floor, dict[str, Body], Trip], refused: list[tuple[int, bool]], late: bool
) -> None:
    """Whatever was refused on the way to it, and whether the robot has waited before."""
    floor, seen, trip = drawn
    mover = Mover(floor, trip)
    mover.since = 0.0 if late else None
    case, refusals, now = begun(mover, map_of(floor.site), seen.values(), 9.0), list[Refusal](), 9.0
    step: Go | Wait = mover.ask(seen, now)
    for number, ended in refused:
        others = sorted(set(seen) - {"a"})
        if isinstance(step, Wait) or not others:
            break
        refusal = Refusal(others[number % len(others)], sorted(step.parts)[number % len(step.parts)], ended)
        refusals.append(refusal)
        after = mover.refused(step, refusal.holder, refusal.part, seen, now, ended=ended)
        step = after or mover.ask(seen, now)
    told = msgspec.json.decode(encode(decided(case, step, refusals)), type=WayCase)
    again = way_again(told)
    assert again is not None
    assert again == {name: getattr(told, name) for name in again}


def test_another_decision_is_a_difference() -> None:
    """A way that leads elsewhere, and parts that are not those of the way."""
    seen = {"a": Body(robot="a", at=(1.0, 1.0, 0.0), size=SIZE)}
    mover = Mover(Floor(SITE), Trip(robot="a", task="t", command="t/1", points=((9.0, 1.0, 0.0),)))
    case = begun(mover, map_of(SITE), seen.values(), 0.0)
    told = decided(case, mover.ask(seen, 0.0), ())
    again = way_again(told)
    assert again is not None
    assert again["way"] == told.way
    for changed in (replace(told, way=((1.0, 1.0, 0.0), (9.0, 2.0, 0.0))), replace(told, parts="3 abc")):
        assert any(getattr(changed, name) != value for name, value in again.items())


def test_a_case_without_its_robot_cannot_be_made_again() -> None:
    """A log that was edited: it is counted, and breaks nothing."""
    trip = Trip(robot="a", task="t", command="t/1", points=((9.0, 1.0, 0.0),))
    assert way_again(WayCase(task="t", trip=trip, now=0.0, looked=0.0, site=SITE, bodies=())) is None
