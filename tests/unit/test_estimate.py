"""What a plan is expected to do by the map: ways round obstacles, times, places passed, and what is not known."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.estimate import NOTE, estimate, in_order, passed, unreachable
from appliance.model import Box, Place, Plan, Pose, RobotInfo, RobotLimits, Site, Subtask

SITE = Site(
    places={"home": Place(x=0.0, y=0.0), "gate": Place(x=10.0, y=0.0), "shelf": Place(x=20.0, y=0.0)},
    speed_limit_mps=2.0,
    fence=Box(name="fence", x=(-5.0, 25.0), y=(-10.0, 10.0)),
)
ROVER = RobotInfo(id="rover_1", kind="zenoh", pose=Pose(x=0.0, y=0.0), home=Pose(x=0.0, y=0.0))
ROBOTS = {"rover_1": ROVER}


def plan(*steps: Subtask) -> Plan:
    """Return a plan."""
    return Plan(domain="navigation", subtasks=steps)


def go(name: str, place: str, *after: str, robot: str = "rover_1", **params: object) -> Subtask:
    """Return a subtask that goes somewhere."""
    return Subtask(id=name, skill="goto", robot=robot, params={"place": place} | params, after=after)


def test_ways_follow_each_other() -> None:
    """Each begins where the one before ended; time is length by speed; what lies on the way is named."""
    found = estimate(plan(go("s1", "shelf"), go("s2", "gate", "s1")), site=SITE, robots=ROBOTS, measured={})
    first, second = found.steps
    assert (first.way[0], first.way[-1], first.length_m, first.takes_s) == ((0.0, 0.0), (20.0, 0.0), 20.0, 10.0)
    assert (first.passes, first.limit) == (("gate",), "site")
    assert (second.start_s, second.length_m, second.passes) == (10.0, 10.0, ())
    assert (found.takes_s, found.problems, found.note) == (15.0, (), NOTE)


def test_an_obstacle_is_gone_round_and_a_closed_place_has_no_way() -> None:
    """The way is that of the skill: longer than the straight line; where there is none, the plan says so."""
    wall = Box(name="wall", x=(4.0, 6.0), y=(-3.0, 3.0))
    found = estimate(plan(go("s1", "gate")), site=replace(SITE, obstacles=(wall,)), robots=ROBOTS, measured={})
    assert 10.0 < found.steps[0].length_m < 20.0
    ring = (Box(name="ring", x=(8.0, 12.0), y=(1.0, 2.0)), Box(name="south", x=(8.0, 12.0), y=(-2.0, -1.0)),
            Box(name="west", x=(8.0, 9.0), y=(-2.0, 2.0)), Box(name="east", x=(11.0, 12.0), y=(-2.0, 2.0)))  # fmt: skip
    closed = replace(SITE, obstacles=ring)
    (problem,) = estimate(plan(go("s1", "gate")), site=closed, robots=ROBOTS, measured={}).problems
    assert "no way" in problem
    assert [each.partition(":")[0] for each in unreachable(closed)] == ["gate"]
    assert unreachable(SITE) == ()


@pytest.mark.parametrize(
    ("step", "problem"),
    [
        (go("s1", "nowhere"), "the site has no place 'nowhere'"),
        (go("s1", "24, 9.5, 200"), "the goal is 200 m up"),
        (go("s1", "30, 0"), "the goal lies outside the fence"),
        (go("s1", "gate", robot="rover_9"), "where rover_9 starts from is not known"),
        (Subtask(id="s1", skill="return_home", robot="rover_9"), "the home of rover_9 is not known"),
    ],
)
def test_what_hinders_a_plan(step: Subtask, problem: str) -> None:
    """An unknown place, a limit, a robot of which nothing is known: each is said of its step."""
    (found,) = estimate(plan(step), site=SITE, robots=ROBOTS, measured={}).problems
    assert problem in found


def test_speed_is_the_lowest_of_site_robot_and_order() -> None:
    """And the estimate says which one it is."""
    slow = {"rover_1": replace(ROVER, limits=RobotLimits(speed_mps=1.0))}
    steps = plan(go("s1", "gate"), go("s2", "home", "s1", speed_mps=0.5))
    first, second = estimate(steps, site=SITE, robots=slow, measured={}).steps
    assert [(each.speed_mps, each.limit) for each in (first, second)] == [(1.0, "robot"), (0.5, "asked")]


def test_times_of_other_skills_are_measured_or_not_known() -> None:
    """Robots work beside each other; a step waits for its predecessors; what was never measured is named."""
    steps = plan(
        go("s1", "gate"),
        Subtask(id="s2", skill="photograph", robot="rover_1", after=("s1",)),
        Subtask(id="s3", skill="report", after=("s2",)),
        Subtask(id="s4", skill="pour", robot="rover_2"),
    )
    found = estimate(steps, site=SITE, robots=ROBOTS, measured={("photograph", "rover_1"): 4.0, ("report", ""): 1.0})
    assert [each.start_s for each in found.steps] == [0.0, 5.0, 9.0, 0.0]
    assert (found.takes_s, found.unknown) == (10.0, ("pour",))


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["goto", "pick", "return_home"]),
            st.sampled_from(["gate", "home", "x", "1, 2", "1e9, 2"]),
            st.lists(st.sampled_from(["s0", "s1", "s2", "s7"]), max_size=3),
            st.sampled_from(["rover_1", "rover_2", None]),
            st.sampled_from([None, -1, 0, math.inf, math.nan, "fast", 0.1]),
        ),
        max_size=4,
    )
)
def test_no_plan_breaks_it(rows: list[tuple[str, str, list[str], str | None, object]]) -> None:
    """Circles, unknown robots and places, and any speed end in an estimate with each subtask once."""
    steps = tuple(
        Subtask(id=f"s{n}", skill=skill, robot=robot, after=tuple(after), params={"place": place, "speed_mps": speed})
        for n, (skill, place, after, robot, speed) in enumerate(rows)
    )
    found = estimate(plan(*steps), site=SITE, robots=ROBOTS, measured={})
    assert sorted(each.subtask for each in found.steps) == sorted(each.id for each in steps)
    assert math.isfinite(found.takes_s)
    assert len(list(in_order(steps))) == len(steps)


def test_places_at_the_ends_are_not_passed() -> None:
    """Neither is one beside the way further off than a metre."""
    site = replace(SITE, places=SITE.places | {"beside": Place(x=5.0, y=1.5), "near": Place(x=5.0, y=0.5)})
    assert passed(((0.0, 0.0), (10.0, 0.0)), site) == ("near",)
