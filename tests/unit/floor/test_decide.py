"""Who may go, who waits for whom and why, and who gives way."""

from typing import Any

import pytest

from appliance.floor.decide import Body, Floor, Go, Trip, Wait, next_ticket, remedy_of_lost, threat
from appliance.floor.geometry import Size
from appliance.floor.mover import Mover
from appliance.model import Box, Place, Site
from appliance.model.floor import FloorState, Point

SIZE = Size(radius_m=0.4, height_m=1.5, margin_m=0.1)
SITE = Site(
    places={
        "dock 1": Place(x=20.0, y=10.0),
        "dock 2": Place(x=20.0, y=15.0),
        "yard": Place(x=10.0, y=10.0),
        "wide dock": Place(x=5.0, y=15.0, capacity=2),
    },
    fence=Box(name="fence", x=(0.0, 30.0), y=(0.0, 20.0)),
)
FLOOR = Floor(SITE)


def body(robot: str, x: float, y: float, state: FloorState | None = None, **fields: Any) -> Body:
    """Return a robot that stands there."""
    return Body(robot=robot, at=(x, y, fields.pop("z", 0.0)), size=SIZE, state=state, **fields)


def trip(robot: str, x: float, y: float, **fields: Any) -> Trip:
    """Return a command that sends it there."""
    return Trip(robot=robot, task=f"t-{robot}", command=f"{robot}/1", points=((x, y, fields.pop("z", 0.0)),), **fields)


def bodies(*all_of_them: Body) -> dict[str, Body]:
    """Return robots by name."""
    return {each.robot: each for each in all_of_them}


def waits(robot: str, waits_for: str, ticket: int, way: tuple[Point, ...] = (), **fields: Any) -> FloorState:
    """Return what is said of a robot that waits."""
    return FloorState(robot=robot, state="waits", waits_for=waits_for, ticket=ticket, way=way, **fields)


def test_a_free_dock_is_taken() -> None:
    """The way is the straight one, and the place is reserved with it."""
    found = FLOOR.decide(trip("a", 20.0, 10.0), bodies(body("a", 1.0, 10.0)))
    assert isinstance(found, Go)
    assert found.way == ((1.0, 10.0, 0.0), (20.0, 10.0, 0.0))
    assert "place/dock 1" in found.parts


@pytest.mark.parametrize("state", [None, FloorState(robot="b", task="t-b", state="stands")])
def test_a_robot_at_a_dock_is_waited_for(state: FloorState | None) -> None:
    """Whether it has a task or not."""
    found = FLOOR.decide(trip("a", 20.0, 10.0), bodies(body("a", 1.0, 10.0), body("b", 20.3, 10.0, state)))
    assert isinstance(found, Wait)
    assert (found.robot, found.why, found.in_line) == ("b", "waits for b to leave dock 1", True)


def test_robots_of_one_task_stand_side_by_side() -> None:
    """Its plan has ordered them: waiting for one another they would wait for ever."""
    there = body("b", 20.0, 10.0, FloorState(robot="b", task="t-a", state="stands"))
    found = FLOOR.decide(trip("a", 20.0, 10.0), bodies(body("a", 1.0, 10.0), there))
    assert isinstance(found, Go)
    assert 2 * SIZE.radius_m < abs(complex(found.way[-1][0] - 20.0, found.way[-1][1] - 10.0)) < 2.0


def test_capacity() -> None:
    """A place for two takes two side by side, and the third waits."""
    first, second = body("b", 5.0, 15.0), body("c", 5.0, 16.3)
    found = FLOOR.decide(trip("a", 5.0, 15.0), bodies(body("a", 1.0, 1.0), first))
    assert isinstance(found, Go)
    assert found.way[-1][:2] != (5.0, 15.0)
    assert isinstance(FLOOR.decide(trip("a", 5.0, 15.0), bodies(body("a", 1.0, 1.0), first, second)), Wait)


def test_who_waited_first_goes_first() -> None:
    """The dock is free again: the one with the higher ticket waits on, and says after whom."""
    line = waits("b", "", 3, place="dock 1", in_line=True)
    seen = bodies(body("a", 1.0, 10.0), body("b", 1.0, 15.0, line))
    found = FLOOR.decide(trip("a", 20.0, 10.0, ticket=4), seen)
    assert isinstance(found, Wait)
    assert found.why == "waits for dock 1, after b"
    assert isinstance(FLOOR.decide(trip("a", 20.0, 10.0, ticket=2), seen), Go)


def test_the_way_leads_round_a_robot_that_stands() -> None:
    """And keeps clear of it."""
    seen = bodies(body("a", 1.0, 10.0), body("b", 12.0, 10.0))
    found = FLOOR.decide(trip("a", 20.0, 10.0), seen)
    assert isinstance(found, Go)
    assert len(found.way) > 2
    assert threat(found.way, seen["a"], seen.values()) is None


def test_a_robot_on_the_spot_is_waited_for() -> None:
    """A coordinate has no room beside it."""
    found = FLOOR.decide(trip("a", 12.0, 5.0), bodies(body("a", 1.0, 5.0), body("b", 12.0, 5.0)))
    assert isinstance(found, Wait)
    assert found.why == "waits for b to move out of the way"


def test_one_that_nobody_here_moves_has_more_room() -> None:
    """A robot that is driven by hand has the ground that it can reach in two seconds."""
    seen = bodies(body("a", 1.0, 10.0), body("b", 12.0, 7.0, stands=False, speed_mps=1.5))
    found = FLOOR.decide(trip("a", 20.0, 10.0), seen)
    assert isinstance(found, Go)
    assert min(abs(point[1] - 7.0) for point in found.way[1:-1]) > 3.0


def test_a_drone_passes_above() -> None:
    """It is in nobody's way up there, and over a dock it takes no place."""
    seen = bodies(body("a", 1.0, 10.0, z=10.0), body("b", 12.0, 10.0), body("c", 20.0, 10.0))
    found = FLOOR.decide(trip("a", 20.0, 10.0, z=10.0, flies=True), seen)
    assert isinstance(found, Go)
    assert (len(found.way), found.place) == (2, "")


def test_robots_that_stand_on_one_point_can_part() -> None:
    """Two that overlap already may leave one another."""
    seen = bodies(body("a", 5.0, 5.0), body("b", 5.0, 5.0), body("c", 5.3, 5.0))
    assert isinstance(FLOOR.decide(trip("a", 5.0, 15.0), seen), Go)
    assert threat(((5.0, 5.0, 0.0), (5.0, 15.0, 0.0)), seen["a"], seen.values()) is None


def test_nose_to_nose_the_later_one_gives_way() -> None:
    """Of robots that wait for one another only the one with the highest ticket moves aside, out of the others' ways."""
    way_a, way_b = ((9.0, 10.0, 0.0), (20.0, 10.0, 0.0)), ((10.5, 10.0, 0.0), (1.0, 10.0, 0.0))
    seen = bodies(body("a", 9.0, 10.0, waits("a", "b", 1, way_a)), body("b", 10.5, 10.0, waits("b", "a", 2, way_b)))
    one, other = trip("a", 20.0, 10.0, ticket=1), trip("b", 1.0, 10.0, ticket=2)
    assert not FLOOR.gives_way(one, Wait(robot="b", why=""), seen)
    assert FLOOR.gives_way(other, Wait(robot="a", why=""), seen)
    refuge = next(iter(FLOOR.refuges(other, seen)))
    assert abs(refuge.way[-1][1] - 10.0) >= 2 * SIZE.kept_m


def test_a_ring_of_three_is_undone_by_one() -> None:
    """The latest gives way; where it has no spot to go to, the one before it."""
    states = [waits("a", "b", 1), waits("b", "c", 3), waits("c", "a", 2)]
    seen = bodies(*(body(each.robot, 3.0 * number, 3.0, each) for number, each in enumerate(states)))
    trips = {each.robot: trip(each.robot, 20.0, 10.0, ticket=each.ticket) for each in states}
    gives = {
        each.robot: FLOOR.gives_way(trips[each.robot], Wait(robot=each.waits_for, why=""), seen) for each in states
    }
    assert gives == {"a": False, "b": True, "c": False}
    seen["b"] = body("b", 3.0, 3.0, waits("b", "c", 3, stuck=True))
    assert FLOOR.gives_way(trips["c"], Wait(robot="a", why=""), seen)


def test_one_that_waits_gives_way_to_one_that_waits_for_it() -> None:
    """A queue in an aisle does not block those who only want to pass; a robot without a task is not moved."""
    seen = bodies(
        body("a", 9.0, 10.0, waits("a", "b", 1)), body("b", 10.5, 10.0, waits("b", "c", 0)), body("c", 20.0, 10.0)
    )
    assert FLOOR.gives_way(trip("b", 20.0, 10.0), Wait(robot="c", why=""), seen)
    assert not FLOOR.gives_way(trip("a", 20.0, 10.0), Wait(robot="b", why=""), seen)


def test_tickets_grow() -> None:
    """A new one is higher than all that are known."""
    assert next_ticket([body("a", 0, 0), body("b", 0, 0, waits("b", "c", 7))]) == 8


def test_a_refusal_is_put_in_words() -> None:
    """Of the one who has the place, of the one who passes, of one that was lost on its way."""
    go = FLOOR.decide(trip("a", 20.0, 10.0), bodies(body("a", 1.0, 10.0)))
    assert isinstance(go, Go)
    moving = FloorState(robot="b", state="moves", place="dock 1", way=((3.0, 3.0, 0.0), (20.0, 10.0, 0.0)))
    seen = bodies(body("b", 3.0, 3.0, moving), body("c", 9.0, 9.0, fresh=False))
    assert FLOOR.refused(go, "b", "place/dock 1", seen, ended=False).why == "waits for b, which goes to dock 1"
    assert FLOOR.refused(go, "b", "0,1,2", seen, ended=False).why == "waits for b to pass"
    lost = FLOOR.refused(go, "c", "0,1,2", seen, ended=True).why
    assert lost == f"waits for c, which was lost in the way: {remedy_of_lost('c')}"
    lost = FLOOR.refused(go, "d", "0,1,2", seen, ended=True).why
    assert lost == f"waits for d, which was lost on its way here: {remedy_of_lost('d')}"


def test_what_is_passed_is_not_gone_to_again() -> None:
    """A robot that was stopped goes on from where it is; points behind it are left out."""
    long = Trip(robot="a", task="t", command="a/1", points=((5.0, 1.0, 0.0), (10.0, 1.0, 0.0), (10.0, 9.0, 0.0)))
    mover = Mover(FLOOR, long)
    go = mover.ask(bodies(body("a", 1.0, 1.0)), 0.0)
    assert isinstance(go, Go)
    mover.started(go)
    whole = mover.parts(body("a", 1.0, 1.0))
    assert mover.parts(body("a", 7.0, 1.0)) < whole
    mover.stopped((7.0, 1.0, 0.0))
    assert mover.trip.points == ((10.0, 1.0, 0.0), (10.0, 9.0, 0.0))


def test_places_that_robots_do_not_fit_at_are_told() -> None:
    """Two that one robot stands at together, and one beside a wall; the rest are well."""
    site = Site(
        places={"a": Place(x=5.0, y=5.0), "b": Place(x=5.5, y=5.0), "c": Place(x=9.9, y=5.0), "d": Place(x=1.0, y=1.0)},
        obstacles=(Box(name="rack", x=(10.0, 12.0), y=(0.0, 9.0)),),
    )
    assert Floor(site).problems(0.4) == (
        "a and b are 0.5 m apart: one robot stands at both",
        "c is nearer to rack than 0.4 m: a robot there touches it",
    )
    assert Floor(SITE).problems(0.4) == ()
