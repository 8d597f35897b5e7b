"""What planners get: names, points and the robots that the words can mean; the review goes by what was typed."""

import pytest
from msgspec.structs import replace

from appliance.llm.preprocessing import told
from appliance.llm.settings import PlanContext
from appliance.model import Place, Plan, Subtask
from appliance.skills.sites import load_site
from workshop.bench.intent.cases import roster


def context(text: str, fleet: str = "six") -> PlanContext:
    """Return an instruction to a fleet on the site of the demo."""
    return PlanContext(instruction=text, robots=roster(fleet), site=load_site("warehouse"))


@pytest.mark.parametrize(
    ("text", "point"),
    [
        ("Fly drone_1 to (26, 6) at 3 m/s", "26, 6"),
        ("rover_1, to x 27, y 14", "27, 14"),
        ("Travel to coordinates (8, 13) please", "8, 13"),
        ("Relocate rover_2 to 34, 20", "34, 20"),
        ("drone_1 go to point 8.0, 26.5", "8, 26.5"),
    ],
)
def test_a_point_is_told_as_a_place_and_comes_back_as_typed(text: str, point: str) -> None:
    """Planners copy names; a plan of theirs has the figures again, and the site knows the place meanwhile."""
    words = told(context(text))
    assert list(words.points.values()) == [point]
    (name,) = words.points
    asked = words.context(context(text))
    assert name in asked.instruction
    assert point not in asked.instruction
    assert asked.site is not None
    assert asked.site.find(name) is not None
    plan = Plan(
        domain="navigation", subtasks=(Subtask(id="s1", skill="goto", robot="drone_1", params={"place": name}),)
    )
    assert words.restored(plan).subtasks[0].params == {"place": point}


@pytest.mark.parametrize(
    "text",
    [
        "visit each of waypoints 4, 9 and 11",
        "rover_1 goes to docks 1, 2",
        'rover_1 says "meet at (4, 5)"',
        "patrol the yard for 3, 4 laps",
        "hold 10, 12 seconds",
    ],
)
def test_figures_that_are_no_point_stay(text: str) -> None:
    """Numbers of places, texts to be spoken, and quantities are passed on as they are."""
    assert told(context(text)).points == {}


@pytest.mark.parametrize(
    ("text", "robots"),
    [
        ("rover_1: go to dock 1", {"rover_1"}),
        ("all drones land", {"drone_1", "drone_2", "drone_3"}),
        ("go to dock 1", {"rover_1", "rover_2", "rover_3", "drone_1", "drone_2", "drone_3"}),
        ("rover_1 goes to dock 1, the others return home", None),
        ("Rovers 1 and 2 go to the aisle", {"rover_1", "rover_2"}),
    ],
)
def test_only_robots_that_the_words_can_mean_are_told(text: str, robots: set[str] | None) -> None:
    """A planner cannot choose a robot of which nobody spoke."""
    found = {each.id for each in told(context(text)).robots or ()}
    assert found == (robots or {each.id for each in roster("six")})


def test_numbers_behind_a_kind_are_told_as_names() -> None:
    """Of "Drones 1, 2 and 3" a planner gets the three names."""
    assert told(context("Drones 1, 2 and 3 take off")).instruction == "drone_1, drone_2 and drone_3 take off"


def test_a_word_for_a_point_names_no_place_of_the_site() -> None:
    """A planner may send a robot to a place of that name: it must not become the point."""
    asked = context("Fly drone_1 to (26, 6)")
    assert asked.site is not None
    (usual,) = told(asked).points
    site = replace(asked.site, places={**asked.site.places, usual: Place(x=1.0, y=2.0)})
    (name,) = told(replace(asked, site=site)).points
    assert site.find(name) is None
