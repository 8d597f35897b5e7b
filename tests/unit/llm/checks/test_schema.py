"""The validator: what it refuses, with which words, and that nothing makes it fail."""

from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.llm.checks.places import locate
from appliance.llm.checks.schema import MAX_PROBLEMS, MAX_SUBTASKS, validate
from appliance.model import Plan, RobotInfo, Site, Subtask
from appliance.skills.catalogue import Catalogue, load_catalogue

CATALOGUE = load_catalogue()


def plan(*subtasks: Subtask, domain: str = "navigation") -> Plan:
    """Return a plan of these subtasks."""
    return Plan(domain=domain, subtasks=subtasks)


def goto(
    name: str = "s1",
    place: str = "dock 1",
    *,
    robot: str | None = "rover_1",
    after: tuple[str, ...] = (),
    **params: Any,
) -> Subtask:
    """Return a goto."""
    return Subtask(id=name, skill="goto", robot=robot, params={"place": place, **params}, after=after)


def test_good_plan_has_no_problems(catalogue: Catalogue, robots: tuple[RobotInfo, ...], site: Site) -> None:
    """A delivery by a robot that can do it, on places that are there, passes with everything checked."""
    good = plan(
        goto(),
        Subtask(id="s2", skill="pick", robot="rover_1", params={"object": "red box"}, after=("s1",)),
        Subtask(id="s3", skill="takeoff", robot="drone_1", params={"altitude_m": 10}),
        Subtask(id="s4", skill="report", params={"to": "operator"}, after=("s2", "s3")),
    )
    assert validate(good, catalogue, robots=robots, site=site, require_implemented=True) == ()


@pytest.mark.parametrize(
    ("subtask", "said"),
    [
        (goto(robot="rover_9"), "there is no robot rover_9: the fleet has drone_1, rover_1"),
        (goto(robot=None), "no robot is named"),
        (goto(robot="all"), "one subtask for each robot"),
        (goto(robot="../x"), "not allowed"),
        (goto(place="moon"), "there is no place moon on site"),
        (goto(place="pit edge"), "forbidden area pit"),
        (goto(place="21, 21.5"), "forbidden area pit"),
        (goto(place="31, 2"), "inside rack"),
        (goto(speed_mps=7), "above this site's limit of 6 m/s"),
        (goto(speed_mps=-1), "is not more than 0"),
        (goto(speed_mps=True), "must be a number"),
        (goto(speed_mps=float("nan")), "not a number that can be meant"),
        (goto(speed_mps=10**400), "not a number that can be meant"),
        (goto(pace=3), "there is no parameter pace"),
        (goto(place=""), "parameter place is missing"),
        (goto(place="x" * 501), "at most 500"),
        (goto(after=("s7",)), "s7, which is not in the plan"),
        (goto(after=("s1",)), "comes after itself"),
        (goto("S 1"), "is not allowed: use s1"),
        (Subtask(id="s1", skill="dance", robot="rover_1"), "there is no such skill"),
        (Subtask(id="s1", skill="report", robot="rover_1"), "leave the robot out"),
        (Subtask(id="s1", skill="takeoff", robot="rover_1"), "does not fly: ask drone_1"),
        (Subtask(id="s1", skill="takeoff", robot="drone_1", params={"altitude_m": 31}), "limit of 30 m"),
        (Subtask(id="s1", skill="pick", robot="drone_1", params={"object": "box"}), "drone_1 has no arm: ask rover_1"),
        (Subtask(id="s1", skill="patrol", robot="rover_1", params={"area": "a", "laps": 1.5}), "whole number"),
        (Subtask(id="s1", skill="hold", robot="rover_1", params={"duration_s": 90_000}), "longer than a day"),
        (Subtask(id="s1", skill="match_scene", params={"datasets": "a"}), "must be a list"),
        (
            Subtask(
                id="s1", skill="rendezvous", robot="rover_1", params={"robots": ["rover_1", "r9"], "place": "dock 1"}
            ),
            "there is no robot r9",
        ),
        (
            Subtask(id="s1", skill="rendezvous", robot="rover_1", params={"robots": ["drone_1"], "place": "dock 1"}),
            "is not among its robots",
        ),
        (
            Subtask(id="s1", skill="rendezvous", robot="rover_1", params={"robots": ["rover_1"], "place": "dock 1"}),
            "rendezvous is done by at least 2 robots together, and it lists rover_1 alone: list every robot",
        ),
    ],
)
def test_each_problem_is_named(
    subtask: Subtask, said: str, catalogue: Catalogue, robots: tuple[RobotInfo, ...], site: Site
) -> None:
    """Whatever is wrong with a subtask is said in words that name the cause."""
    problems = validate(plan(subtask), catalogue, robots=robots, site=site)
    assert any(said in problem for problem in problems), problems


def test_skill_without_handler_is_refused_when_required(catalogue: Catalogue) -> None:
    """A skill that has no handler is refused at planning time, and only where that was asked for."""
    skills = {**catalogue.skills, "goto": replace(catalogue.skills["goto"], implemented=False)}
    without = replace(catalogue, skills=skills)
    assert validate(plan(goto()), without) == ()
    (problem,) = validate(plan(goto()), without, require_implemented=True)
    assert "skill goto is not implemented on this fleet" in problem


def test_circle_is_named(catalogue: Catalogue) -> None:
    """Subtasks that wait for each other are refused, with their names."""
    problems = validate(plan(goto("s1", after=("s2",)), goto("s2", after=("s1",))), catalogue)
    assert any("s1, s2 wait for each other in a circle" in problem for problem in problems)


def test_repeated_id_and_unknown_domain(catalogue: Catalogue) -> None:
    """Ids must be unique and the domain one of the catalogue's."""
    problems = validate(plan(goto(), goto(), domain="cooking"), catalogue)
    assert any("used twice" in problem for problem in problems)
    assert any("domain cooking is unknown" in problem for problem in problems)


@pytest.mark.parametrize(
    ("count", "ok"), [(0, False), (MAX_SUBTASKS, True), (MAX_SUBTASKS + 1, False), (100_000, False)]
)
def test_size_is_bounded(count: int, ok: bool, catalogue: Catalogue) -> None:
    """A plan holds 1 to 64 subtasks."""
    assert (validate(plan(*(goto(f"s{n}") for n in range(count))), catalogue) == ()) is ok


def test_unnamed_robots_need_enough_that_can(catalogue: Catalogue, robots: tuple[RobotInfo, ...]) -> None:
    """`any1` and `any2` must be different robots that can each do their part."""
    fly = Subtask(id="s1", skill="takeoff", robot="any1")
    drive = goto("s2", robot="any2")
    assert validate(plan(fly, drive), catalogue, robots=robots) == ()
    two_flights = plan(fly, Subtask(id="s2", skill="takeoff", robot="any2"))
    assert any("different robots" in problem for problem in validate(two_flights, catalogue, robots=robots))
    pick_and_fly = plan(
        Subtask(id="s1", skill="takeoff", robot="any"),
        Subtask(id="s2", skill="pick", robot="any", params={"object": "box"}),
    )
    assert any(
        "no robot of the fleet can do all" in problem for problem in validate(pick_and_fly, catalogue, robots=robots)
    )


def test_unknown_roster_is_not_an_empty_one(catalogue: Catalogue) -> None:
    """Without a roster any name may stand; with an empty one none may."""
    assert validate(plan(goto()), catalogue) == ()
    assert any("the fleet has none" in problem for problem in validate(plan(goto()), catalogue, robots=()))


def test_problems_are_bounded(catalogue: Catalogue) -> None:
    """A plan in which everything is wrong gives a bounded list of short sentences."""
    bad = plan(*(Subtask(id="X" * 500, skill="\n" * 500, robot="\x00", after=("q",) * 70) for _ in range(64)))
    problems = validate(bad, catalogue, robots=())
    assert 0 < len(problems) <= MAX_PROBLEMS
    assert all(len(problem) < 300 and problem.isprintable() for problem in problems)


def test_coordinates_are_places(site: Site) -> None:
    """A coordinate in metres is a place like a name or an alias."""
    assert locate("12.5, -7", site) is not None
    assert locate("Goal Two", site) == site.places["goal 2"]
    assert locate("12.5", site) is None


words = st.text(max_size=12) | st.sampled_from(
    ["s1", "s2", "s3", "goto", "any", "any1", "rover_1", "all", "place", "robots"]
)
values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | words,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(words, inner, max_size=3),
    max_leaves=8,
)
subtasks = st.builds(
    Subtask,
    id=words,
    skill=words | st.sampled_from(sorted(CATALOGUE.skills)),
    robot=st.none() | words,
    params=st.dictionaries(words | st.sampled_from(["place", "robots", "speed_mps", "object"]), values, max_size=4),
    after=st.lists(words, max_size=4).map(tuple),
)


@settings(max_examples=200, deadline=None)
@given(st.lists(subtasks, max_size=6).map(tuple), words)
def test_no_plan_makes_it_fail(parts: tuple[Subtask, ...], domain: str) -> None:
    """Any plan at all is judged: problems are printable sentences, and a plan without problems has no circle."""
    robots = (RobotInfo(id="rover_1", kind="zenoh", uses=("base",), verbs=("goto", "state")),)
    problems = validate(Plan(domain=domain, subtasks=parts), CATALOGUE, robots=robots, site=Site())
    assert all(problem.isprintable() for problem in problems)
    if not problems:
        waiting = {each.id: set(each.after) for each in parts}
        while waiting:
            free = {name for name, before in waiting.items() if not before & waiting.keys()}
            assert free
            waiting = {name: before for name, before in waiting.items() if name not in free}


@settings(max_examples=100, deadline=None)
@given(st.integers(2, 40), st.randoms(use_true_random=False))
def test_order_without_circle_passes_and_with_one_does_not(count: int, random: Any) -> None:
    """Any order that only looks back is accepted; closing it into a circle is not."""
    names = [f"s{n}" for n in range(count)]
    parts = [goto(name, after=tuple(random.sample(names[:n], min(n, 2)))) for n, name in enumerate(names)]
    assert validate(plan(*parts), CATALOGUE) == ()
    first = msgspec.structs.replace(parts[0], after=(names[-1],))
    last = msgspec.structs.replace(parts[-1], after=(*parts[-1].after, names[0]))
    assert validate(plan(first, *parts[1:-1], last), CATALOGUE) != ()
