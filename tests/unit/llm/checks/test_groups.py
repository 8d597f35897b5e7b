"""Groups of robots: whom lists and numbers mean, and that as many do a thing as the words say."""

import pytest

from appliance.llm.checks.reading import Token, read
from appliance.llm.review import Facts, review
from appliance.llm.settings import PlanContext, SafetyConfig
from appliance.model import Plan, Severity, Subtask, Verdict
from appliance.skills.catalogue import load_catalogue
from workshop.bench.intent.cases import robot

CATALOGUE = load_catalogue()
EIGHT = tuple(robot(f"{kind}_{number}") for kind in ("rover", "drone") for number in (1, 2, 3, 4))
DRONES = ("drone_1", "drone_2", "drone_3", "drone_4")


def mentions(text: str) -> list[Token]:
    """Return the mentions of robots in an instruction to four rovers and four drones."""
    return [each for each in read(text, EIGHT).tokens if each.kind == "robot"]


def decided(text: str, *robots: str, skill: str = "land", choose_robot: str = "ask") -> tuple[Verdict, set[str]]:
    """Return what becomes of a plan in which robots do one thing side by side, and which checks hold it."""
    subtasks = tuple(Subtask(id=f"s{n}", skill=skill, robot=who, params={}) for n, who in enumerate(robots, start=1))
    context = PlanContext(instruction=text, robots=EIGHT)
    safety = SafetyConfig(choose_robot="auto" if choose_robot == "auto" else "ask")
    found = review(Facts(Plan(domain="navigation", subtasks=subtasks), context, CATALOGUE, safety))
    return found.decision, {each.check for each in found.findings if each.severity is Severity.HOLD}


@pytest.mark.parametrize(
    ("text", "robots"),
    [
        ("Drones 1, 2 and 3 land", ("drone_1", "drone_2", "drone_3")),
        ("drones one and two land", ("drone_1", "drone_2")),
        ("drones 1-3 land", ("drone_1", "drone_2", "drone_3")),
        ("drones 2 to 4 land", ("drone_2", "drone_3", "drone_4")),
        ("drones 1 through 3 land", ("drone_1", "drone_2", "drone_3")),
        ("rovers 1, 3 & 4 go to dock 2", ("rover_1", "rover_3", "rover_4")),
    ],
)
def test_a_list_of_numbers_means_those_robots(text: str, robots: tuple[str, ...]) -> None:
    """Figures, number words and ranges behind a kind are its robots of those numbers, and each has its part."""
    (mention,) = mentions(text)
    assert (set(mention.robots), mention.group, mention.listed) == (set(robots), "all", True)


@pytest.mark.parametrize(
    "text",
    [
        "drones 1 to 3 m",
        "fly drones 1 and 2 to 4",
        "drones 3 to 1 land",
        "drones 1 to 9 land",
        "drones 1 to 3 metres up",
    ],
)
def test_what_is_no_list_of_robots_is_none(text: str) -> None:
    """Heights, figures behind a list, falling ranges and robots that the fleet has not are not taken for robots."""
    found = {name for each in mentions(text) if each.listed for name in each.robots}
    assert found <= {"drone_1", "drone_2"}


@pytest.mark.parametrize(
    ("text", "robots"),
    [
        ("both drones land", DRONES),
        ("all two drones land", DRONES[:2]),
        ("all three drones land", DRONES[:3]),
        ("all five drones land", DRONES),
        ("all 6 drones land", DRONES),
    ],
)
def test_a_number_of_all_that_is_not_the_fleets_is_held(text: str, robots: tuple[str, ...]) -> None:
    """Whichever "both drones" of four are, four ran with four: a person says which are meant."""
    verdict, checks = decided(text, *robots)
    assert verdict is Verdict.HOLD
    assert "quantity" in checks


@pytest.mark.parametrize("text", ["all four drones land", "all 4 drones land", "all drones land", "every drone lands"])
def test_all_of_a_kind_run_when_the_number_is_the_fleets(text: str) -> None:
    """Each of them, no other: nothing is to be asked."""
    assert decided(text, *DRONES) == (Verdict.RUN, set())
    assert decided(text, *DRONES[:3])[0] is Verdict.HOLD
    assert decided(text, *DRONES, "rover_1", skill="return_home")[0] is not Verdict.RUN


def test_both_are_those_that_were_named_before() -> None:
    """Of four drones two were spoken of: "both drones" are those two."""
    text = "drone_1 and drone_3 take off, then both drones land"
    *_, last = mentions(text)
    assert set(last.robots) == {"drone_1", "drone_3"}


def test_the_other_ones_are_none_that_is_named_anywhere() -> None:
    """Also by what follows: "the other drones land while drone_1 takes off" does not land drone_1."""
    first, *_ = mentions("the other drones land while drone_1 takes off")
    assert set(first.robots) == {"drone_2", "drone_3", "drone_4"}


@pytest.mark.parametrize("text", ["the other one should go to dock 2", "tell the other one to land"])
def test_the_other_one_is_one(text: str) -> None:
    """Where nobody was named it may be any of them: not all, and a person says which."""
    (mention,) = mentions(text)
    assert (mention.group, mention.count, len(mention.robots)) == ("any", 1, len(EIGHT))
    everybody = [each.id for each in EIGHT]
    assert "quantity" in decided(text, *everybody, skill="return_home")[1]


@pytest.mark.parametrize(
    ("text", "most"),
    [("a drone lands", 1), ("one of the drones lands", 1), ("two drones land", 2), ("another drone lands", 1)],
)
def test_no_more_do_it_than_the_words_say(text: str, most: int) -> None:
    """With any chooser: with `choose_robot` "auto", too, "a drone" is one."""
    for choose in ("ask", "auto"):
        assert "quantity" not in decided(text, *DRONES[:most], choose_robot=choose)[1]
        assert "quantity" in decided(text, *DRONES[: most + 1], choose_robot=choose)[1]


def test_a_number_of_things_is_no_number_of_robots() -> None:
    """Words such as "both boxes" and "all three docks" say nothing of robots."""
    for text in ("rover_1 takes both boxes", "drone_1 visits all three docks"):
        assert all(each.count == 0 for each in mentions(text))


@pytest.mark.parametrize("text", ["all drones from drone_2 to drone_3 land", "the drones to drone_3 land"])
def test_a_part_of_a_group_is_not_all_of_it(text: str) -> None:
    """Robots with which a part begins or ends are named behind the group: that all of it does it is held."""
    verdict, checks = decided(text, *DRONES)
    assert verdict is Verdict.HOLD
    assert "quantity" in checks


@pytest.mark.parametrize(
    ("text", "robots", "choose_robot"),
    [
        ("all idle drones land", DRONES, "auto"),
        ("all the available drones land", DRONES, "auto"),
        ("the nearest drone lands", DRONES[:1], "auto"),
        ("the closest drone lands", DRONES[:1], "ask"),
        ("the idle drone lands", DRONES[:1], "ask"),
    ],
)
def test_robots_chosen_by_their_state_are_held(text: str, robots: tuple[str, ...], choose_robot: str) -> None:
    """Which drones are idle or near is not in the words: a person says whether a busy or a distant one does it."""
    decision, _ = decided(text, *robots, choose_robot=choose_robot)
    assert decision is Verdict.HOLD


def test_one_that_is_free_is_what_placement_takes() -> None:
    """With `choose_robot` = "auto" one of several may be any, and a free one is."""
    assert decided("a free drone lands", "drone_1", choose_robot="auto")[0] is Verdict.RUN
