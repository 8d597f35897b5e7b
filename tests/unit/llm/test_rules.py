"""The rule-based tier: plain orders become the right graph, anything else becomes none."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.errors import PlanError
from appliance.llm.checks.schema import validate
from appliance.llm.rules.lexicon import noun, number, spell
from appliance.llm.rules.parser import take_modifiers
from appliance.llm.rules.tier import read
from appliance.llm.settings import PlanContext
from appliance.model import RobotInfo, Site
from appliance.skills.catalogue import load_catalogue

CATALOGUE = load_catalogue()
SURE = 0.8


def lines(text: str, *roster: str, site: Site | None = None) -> list[str]:
    """Plan and return "id skill robot params after" lines; the plan must be valid and understood."""
    known = tuple(RobotInfo(id=name, kind="zenoh", flies=name.startswith("drone")) for name in roster) or None
    plan, reading = read(PlanContext(instruction=text, robots=known, site=site), CATALOGUE)
    assert reading.confidence >= SURE, reading.lost
    assert validate(plan, CATALOGUE) == ()
    return [
        " ".join(
            [
                each.id,
                each.skill,
                each.robot or "-",
                *(f"{k}={v}" for k, v in each.params.items()),
                *(f"<{a}" for a in each.after),
            ]
        )
        for each in plan.subtasks
    ]


TWO_ROBOTS = (
    "Drone_1 take off to 10 m, go to goal 2, photograph the yard and land, while Rover_1 fetches the blue box "
    "from dock 1 and places it at dock 2"
)
CASES: list[tuple[str, tuple[str, ...], list[str]]] = [
    (
        "Rover_1: go to dock 3, pick the red box, then go to dock 2 and place it at dock 2",
        (),
        [
            "s1 goto rover_1 place=dock 3",
            "s2 pick rover_1 object=red box <s1",
            "s3 goto rover_1 place=dock 2 <s2",
            "s4 place rover_1 object=red box at=dock 2 <s3",
        ],
    ),
    (
        "Robot_1 fetch the red box from dock 3 while Robot_2 films the aisle",
        (),
        ["s1 goto robot_1 place=dock 3", "s2 pick robot_1 object=red box <s1", "s3 record_video robot_2 target=aisle"],
    ),
    (
        "Rover_1: go to the shelf, photograph the shelf, detect red boxes and report to the operator",
        ("drone_1", "rover_1"),
        [
            "s1 goto rover_1 place=shelf",
            "s2 photograph rover_1 target=shelf <s1",
            "s3 detect rover_1 target=red boxes <s2",
            "s4 report - to=operator <s3",
        ],
    ),
    (
        TWO_ROBOTS,
        ("drone_1", "rover_1"),
        [
            "s1 takeoff drone_1 altitude_m=10",
            "s2 goto drone_1 place=goal 2 <s1",
            "s3 photograph drone_1 target=yard <s2",
            "s4 land drone_1 <s3",
            "s5 goto rover_1 place=dock 1",
            "s6 pick rover_1 object=blue box <s5",
            "s7 goto rover_1 place=dock 2 <s6",
            "s8 place rover_1 object=blue box at=dock 2 <s7",
        ],
    ),
    (
        "Robot_1: go to goal 2, then photograph the shelf",
        (),
        ["s1 goto robot_1 place=goal 2", "s2 photograph robot_1 target=shelf <s1"],
    ),
    (
        "Rover_1 should photograph the shelf before it goes to dock 2",
        (),
        ["s1 photograph rover_1 target=shelf", "s2 goto rover_1 place=dock 2 <s1"],
    ),
    (
        "Before landing, Drone_3 should orbit the tower twice.",
        (),
        ["s1 orbit drone_3 target=tower laps=2", "s2 land drone_3 <s1"],
    ),
    (
        "Film the yard for half a minute while driving to dock 2 at 3.6 km/h",
        (),
        ["s1 record_video any target=yard duration_s=30", "s2 goto any place=dock 2 speed_mps=1"],
    ),
    (
        "Go to each of waypoints 1, 2 and 3.",
        (),
        ["s1 goto any place=waypoint 1", "s2 goto any place=waypoint 2 <s1", "s3 goto any place=waypoint 3 <s2"],
    ),
    (
        "All drones: take off, then return home",
        ("drone_1", "drone_2", "rover_1"),
        ["s1 takeoff drone_1", "s2 takeoff drone_2", "s3 return_home drone_1 <s1", "s4 return_home drone_2 <s2"],
    ),
    (
        "Rover_1 goes to dock 1 and drone_1 to goal 2. When both are there, rover_1 picks the blue box.",
        ("drone_1", "rover_1"),
        ["s1 goto rover_1 place=dock 1", "s2 goto drone_1 place=goal 2", "s3 pick rover_1 object=blue box <s1 <s2"],
    ),
    (
        "When the truck arrives, open the gate, wait two minutes and close the gate.",
        (),
        [
            "s1 wait_for any event=the truck arrives",
            "s2 open any object=gate <s1",
            "s3 hold any duration_s=120 <s2",
            "s4 close any object=gate <s3",
        ],
    ),
    (
        "Bring Ana a cup",
        (),
        ["s1 pick any object=cup", "s2 give any object=cup to=ana <s1"],
    ),
    (
        "Move the pallets from bay 1 to bay 2.",
        (),
        [
            "s1 goto any place=bay 1",
            "s2 pick any object=pallets <s1",
            "s3 goto any place=bay 2 <s2",
            "s4 place any object=pallets at=bay 2 <s3",
        ],
    ),
    (
        "Put the blue cup on the tray",
        (),
        ["s1 pick any object=blue cup", "s2 place any object=blue cup at=tray <s1"],
    ),
    (
        "Robot_1 goes to the kitchen. Meanwhile, Robot_2 cleans the hall. Then both return home.",
        ("robot_1", "robot_2"),
        [
            "s1 goto robot_1 place=kitchen",
            "s2 clean robot_2 object=hall",
            "s3 return_home robot_1 <s1 <s2",
            "s4 return_home robot_2 <s1 <s2",
        ],
    ),
    (
        "Record a 20-second video of the press and extract frames at 5 fps.",
        (),
        ["s1 record_video any target=press duration_s=20", "s2 extract_frames - fps=5 <s1"],
    ),
    (
        'Robot_1: go to the gate and notify the guard: "two trucks, one red"',
        (),
        ["s1 goto robot_1 place=gate", "s2 notify - to=guard text=two trucks, one red <s1"],
    ),
    (
        "Please have Robot_2 inspect pump 3 and pump 4, Carrier_1 docks at the same time",
        (),
        ["s1 inspect robot_2 asset=pump 3", "s2 inspect robot_2 asset=pump 4 <s1", "s3 dock carrier_1"],
    ),
    (
        "Two drones: one counts the sheep, the other counts the goats. When both counts are in, send a report to Ann.",
        (),
        ["s1 count any1 target=sheep", "s2 count any2 target=goats", "s3 report - to=ann <s1 <s2"],
    ),
    (
        "Fetch the red box from dock 3 and the blue box from dock 1",
        (),
        [
            "s1 goto any place=dock 3",
            "s2 pick any object=red box <s1",
            "s3 goto any place=dock 1 <s2",
            "s4 pick any object=blue box <s3",
        ],
    ),
    (
        "Rover_1 places the red box on the conveyor after fetching it from dock 3",
        (),
        [
            "s1 goto rover_1 place=dock 3",
            "s2 pick rover_1 object=red box <s1",
            "s3 place rover_1 object=red box at=conveyor <s2",
        ],
    ),
    (
        "The rover goes to dock 1 while the drone films the aisle",
        ("drone_1", "rover_1"),
        ["s1 goto rover_1 place=dock 1", "s2 record_video drone_1 target=aisle"],
    ),
    ("DRONE_1 TAKE OFF TO 10 M AND LAND", ("drone_1",), ["s1 takeoff drone_1 altitude_m=10", "s2 land drone_1 <s1"]),
    (
        "Rover_1 and drone_1 meet at goal 1",
        ("drone_1", "rover_1"),
        ["s1 rendezvous rover_1 robots=['rover_1', 'drone_1'] place=goal 1"],
    ),
    (
        "Arm_2:\n1. open the lid\n2. pick tube 6\n3. place it in rack D",
        (),
        ["s1 open arm_2 object=lid", "s2 pick arm_2 object=tube 6 <s1", "s3 place arm_2 object=tube 6 at=rack d <s2"],
    ),
]


@pytest.mark.parametrize(("text", "roster", "expected"), CASES, ids=[case[0][:48] for case in CASES])
def test_plain_orders(text: str, roster: tuple[str, ...], expected: list[str]) -> None:
    """A plain order becomes exactly the subtasks, robots, parameters and dependencies that the rules ask for."""
    assert lines(text, *roster) == expected


@pytest.mark.parametrize(
    "text",
    [
        "colourless green ideas",
        "asdf",
        "the quick brown fox jumps over the lazy dog",
        "42",
        "?!",
        "never mind",
        "do not go to dock 1",
    ],
)
def test_what_is_no_order_gives_no_subtasks(text: str) -> None:
    """Nothing is invented from text that is no order, nor from an order not to do something."""
    plan, reading = read(PlanContext(instruction=text), CATALOGUE)
    assert plan.subtasks == ()
    assert reading.confidence == 0


@pytest.mark.parametrize(
    "text",
    [
        "Go to dock 1. Don't pick anything up there whatever happens.",
        "if the door is open, go home",
        "Rover_1 go to dock 1 unless somebody is standing in the aisle",
        "inspect, photograph and film the shelf",
    ],
)
def test_half_understood_orders_are_not_sure(text: str) -> None:
    """An order with a part that was not understood stays below the threshold, so that it is not half carried out."""
    assert read(PlanContext(instruction=text), CATALOGUE)[1].confidence < SURE


def test_place_that_the_site_knows_needs_the_way_there(site: Site) -> None:
    """Putting something on furniture needs no way, unless the site knows it as a place."""
    assert "goto" not in " ".join(lines("put the cup on the tray", site=site))
    assert "s2 goto any place=shelf <s1" in lines("put the cup on the shelf", site=site)


def test_unknown_robot_stays_in_the_plan(robots: tuple[RobotInfo, ...]) -> None:
    """A robot that the fleet lacks is kept, for the validator to refuse; it never becomes another robot."""
    plan, _ = read(PlanContext(instruction="Rover_9: go to dock 1", robots=robots), CATALOGUE)
    assert [each.robot for each in plan.subtasks] == ["rover_9"]


@pytest.mark.parametrize("text", ["", "   ", "x" * 5000])
def test_empty_and_oversize_text_is_refused(text: str) -> None:
    """An empty or endless instruction is a PlanError with a remedy."""
    with pytest.raises(PlanError) as caught:
        read(PlanContext(instruction=text), CATALOGUE)
    assert caught.value.remedy


def test_too_many_subtasks_are_refused() -> None:
    """An order for more subtasks than a plan may hold is refused while it is read, not built."""
    robots = tuple(RobotInfo(id=f"r_{n}", kind="zenoh") for n in range(50))
    with pytest.raises(PlanError, match="more than 64 subtasks"):
        read(
            PlanContext(instruction="All robots go to dock 1. Then all robots go to dock 2.", robots=robots), CATALOGUE
        )


PIECES = st.sampled_from(
    [
        "go",
        "to",
        "the",
        "dock",
        "1",
        "and",
        "then",
        ",",
        "while",
        "Rover_1",
        "before",
        "after",
        "once",
        "when",
        "if",
        "all",
        "robots",
        "pick",
        "up",
        "red",
        "box",
        "at",
        "in",
        "on",
        "for",
        "two",
        "minutes",
        "report",
        "operator",
        ":",
        ".",
        ";",
        "-",
        "each",
        "of",
        "A",
        "B",
        "has",
        "been",
        "3",
        "twice",
        "it",
        "them",
        "there",
        '"',
        "'",
        "photograph",
        "Robot",
        "(",
        ")",
        "at",
        "most",
        "\n",
        "1.",
        "who",
        "first",
        ",",
    ]
)


@settings(max_examples=150, deadline=None)
@given(st.lists(PIECES, max_size=80).map(" ".join) | st.text(max_size=300), st.booleans())
def test_any_text_is_read_or_refused(text: str, roster: bool) -> None:
    """Whatever is typed, the parser ends with a plan whose order has no circle, or with a PlanError."""
    robots = (
        (RobotInfo(id="rover_1", kind="zenoh"), RobotInfo(id="drone_1", kind="mavlink", flies=True)) if roster else None
    )
    try:
        plan, reading = read(PlanContext(instruction=text, robots=robots), CATALOGUE)
    except PlanError:
        return
    assert 0 <= reading.confidence <= 1
    seen: set[str] = set()
    for subtask in plan.subtasks:
        assert set(subtask.after) <= seen
        seen.add(subtask.id)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("3", 3),
        ("twenty", 20),
        ("twenty-five", 25),
        ("half a", 0.5),
        ("three quarters of an", 0.75),
        ("a quarter of a", 0.25),
        ("box", None),
    ],
)
def test_numbers(text: str, value: float | None) -> None:
    """Numbers are read as digits, words and fractions."""
    assert number(text) == value


@pytest.mark.parametrize(
    ("text", "key", "value"),
    [
        ("it for three quarters of an hour", "duration_s", 2700),
        ("it for 2.5 min", "duration_s", 150),
        ("to cell f at 7.2 km/h", "speed_mps", 2),
        ("it with a window of a quarter of a second", "window_ms", 250),
        ("the tower at a radius of 10 feet", "radius_m", 3.048),
        ("for the signal, five minutes at most", "timeout_s", 300),
        ("it for two epochs", "epochs", 2),
        ("frames at 12 fps", "fps", 12),
    ],
)
def test_quantities_come_in_the_parameters_unit(text: str, key: str, value: float) -> None:
    """Quantities are converted to the unit that the parameter's name carries."""
    assert take_modifiers(text, altitude=False)[1].values == {key: value}


def test_altitude_in_feet() -> None:
    """An altitude in feet becomes metres, and only where something takes off."""
    assert take_modifiers("off to 100 feet", altitude=True)[1].values == {"altitude_m": 30.48}
    assert take_modifiers("to 100 feet", altitude=False)[1].values == {}


@pytest.mark.parametrize(
    ("wrong", "right"),
    [
        ("tehn", "then"),
        ("whlie", "while"),
        ("notifiy", "notify"),
        ("plese", "please"),
        ("field", "field"),
        ("Max", "Max"),
    ],
)
def test_spelling(wrong: str, right: str) -> None:
    """Swapped and doubled letters in verbs and connectives are mended, other words are left."""
    assert spell(wrong) == right


def test_noun_phrases_lose_articles_and_fillers() -> None:
    """A parameter is lower case, without articles, possessives and politeness."""
    assert noun("the Red box of its owner, please") == "red box of owner"
