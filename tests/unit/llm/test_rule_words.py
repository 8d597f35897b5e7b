"""Which texts are a standing rule, what it says, and what no rule says whole."""

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import RefusedError
from appliance.llm.cascade import Decomposer
from appliance.llm.rule_words import rule_words
from appliance.llm.settings import LlmConfig, PlanContext
from appliance.model import Place, RobotInfo, Site
from appliance.model.closures import DAY_MIN, Rule
from appliance.skills.catalogue import Catalogue

SITE = Site(
    places={
        "dock 1": Place(x=0, y=0),
        "dock 2": Place(x=1, y=1, aliases=("second dock",)),
        "aisle": Place(x=3, y=3),
        "gate": Place(x=4, y=4),
        "lost and found": Place(x=5, y=5),
    }
)
ROBOTS = (
    RobotInfo(id="drone_1", kind="mavlink", flies=True),
    RobotInfo(id="rover_1", kind="zenoh"),
    RobotInfo(id="Rover_2", kind="zenoh"),
)
ZONE = "Europe/Zurich"


def said(text: str) -> str:
    """Return the rule of a text in words, the reason why there is none in brackets, or nothing."""
    found = rule_words(text, ROBOTS, SITE, zone=ZONE)
    if found is None:
        return ""
    assert (found.rule is None) == bool(found.problem)
    return found.rule.text if found.rule is not None else f"({found.problem})"


@pytest.mark.parametrize(
    ("text", "rule"),
    [
        ("never go to dock 2", "all robots: never go to dock 2"),
        ("From now on, never go to dock 2.", "all robots: never go to dock 2"),
        ("Please remember: as a standing rule, do not enter the aisle any more", "all robots: never go to aisle"),
        ("rover 1 must not go to the second dock", "rover_1: never go to dock 2"),
        ("rover_1 and rover_2 never visit the gate", "Rover_2, rover_1: never go to gate"),
        ("neither rover_1 nor rover_2 goes to the gate", "Rover_2, rover_1: never go to gate"),
        ("robots must never go to dock 1 and 2", "all robots: never go to dock 1 or dock 2"),
        ("never go to lost and found or the gate", "all robots: never go to gate or lost and found"),
        ("no drone flies to dock 1", "flying robots: never go to dock 1"),
        ("nobody flies to dock 1", "flying robots: never go to dock 1"),
        ("None of the ground robots may enter the aisle", "ground robots: never go to aisle"),
        ("rovers never use dock 1", "ground robots: never go to dock 1"),
        ("rover_1 isn't allowed in the aisle", "rover_1: never go to aisle"),
        ("no robots in the aisle", "all robots: never go to aisle"),
        ("keep rover_1 out of the aisle", "rover_1: never go to aisle"),
        ("All drones must stay out of the aisle", "flying robots: never go to aisle"),
        ("rover_1: keep out of dock 2", "rover_1: never go to dock 2"),
        ("dock 2 is off limits", "all robots: never go to dock 2"),
        ("dock 2 is a no-go area for drones", "flying robots: never go to dock 2"),
        ("no entry to the aisle for drones", "flying robots: never go to aisle"),
        ("ban drones from dock 2", "flying robots: never go to dock 2"),
        ("drones are forbidden to enter dock 2", "flying robots: never go to dock 2"),
        ("never let rover_1 go to dock 2", "rover_1: never go to dock 2"),
        ("don't let robots into the aisle", "all robots: never go to aisle"),
        ("never send rover_1 to dock 2", "rover_1: never go to dock 2"),
        ("Rover_1 never carries glass", "rover_1: never take up glass"),
        ("rover_1 must not pick up knives or the red box", "rover_1: never take up knives or red box"),
        ("no robot may lift anything", "all robots: never take up anything"),
        ("nobody enters the aisle after 18:00", f"all robots: never go to aisle from 18:00 to 24:00 {ZONE}"),
        ("no drones in the aisle before 8.30 am", f"flying robots: never go to aisle from 00:00 to 08:30 {ZONE}"),
        (
            "between 10 pm and 6 am no robot enters the aisle",
            f"all robots: never go to aisle from 22:00 to 06:00 {ZONE}",
        ),
        ("never enter the aisle from 22 to 6", f"all robots: never go to aisle from 22:00 to 06:00 {ZONE}"),
        ("never enter the aisle from 22:00 to 06:00 UTC", "all robots: never go to aisle from 22:00 to 06:00 UTC"),
        (
            "no one enters the aisle after 18:00 or before 06:00",
            f"all robots: never go to aisle from 18:00 to 06:00 {ZONE}",
        ),
        (
            "before 6:00 and after noon nobody enters the aisle",
            f"all robots: never go to aisle from 12:00 to 06:00 {ZONE}",
        ),
        ("rover_1 never goes to dock 2 on sundays", f"rover_1: never go to dock 2 on sun {ZONE}"),
        (
            "no entry to the aisle after 18:00 on weekdays for drones",
            f"flying robots: never go to aisle from 18:00 to 24:00 on mon, tue, wed, thu, fri {ZONE}",
        ),
        ("never enter the gate from friday to monday", f"all robots: never go to gate on mon, fri, sat, sun {ZONE}"),
        (
            "no drone flies between 22:00 and 06:00",
            f"flying robots: never start any subtask from 22:00 to 06:00 {ZONE}",
        ),
        ("rover_1 never works on weekends", f"rover_1: never start any subtask on sat, sun {ZONE}"),
    ],
)
def test_a_prohibition_is_read_as_a_rule(text: str, rule: str) -> None:
    """Who, what, where and when, with the names that the fleet and the site have."""
    assert said(text) == rule


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("no drone flies over dock 1", "over"),
        ("never drive through the aisle", "through"),
        ("nobody goes near dock 2", "near"),
        ("stay away from dock 2", ""),
        ("never go to dock 2 unless I say so", "unless"),
        ("nobody except rover_1 goes to dock 2", "except"),
        ("no robot other than rover_1 enters the aisle", "other than"),
        ("the other robots never go to dock 1", "other robots"),
        ("never go to dock 2 without a light", "without"),
        ("never go to dock 2 while people work there", "while"),
        ("never go to dock 2 until 18:00", "until"),
        ("never go to dock 2 today", "today"),
        ("rover_1 never goes to dock 2 for two hours", "for"),
        ("no drones in the aisle at night", "night"),
        ("after 6 no robot goes to dock 2", "am and pm"),
        ("no robot enters the aisle from 9 to 5", "am and pm"),
        ("no robot enters the aisle after 8:00 or before 18:00", "is always"),
        ("never go to dock 2 after 18:00 or dock 1", "rule of its own"),
        ("never go to dock 2 on weekends and after 18:00", "rule of its own"),
        ("never go to dock 2 from 18:00 to 18:00", "begin when they end"),
        ("never go to dock 2 from 18:00 to 20:00 Mars/Olympus", "time zone"),
        ("never go to dock 2 but photograph the shelf", "but"),
        ("do not go to dock 2, go to dock 1", "go to dock 1"),
        ("rover_1: go to dock 1 and do not enter the aisle", "no robot"),
        ("Never go to dock 2. Never go to dock 1.", "one rule at a time"),
        ("never go to dock 9", 'no place "dock 9"'),
        ("never go to the docks", "no place"),
        ("rover_9 never goes to dock 1", 'no robot "rover_9"'),
        ("no arm_1 enters the aisle", 'no robot "arm_1"'),
        ("rover_1 never carries anything heavier than 5 kg", "than"),
        ("rover_1 never carries heavy boxes", "heavy"),
        ("rover_1 never carries things made of glass", "alone"),
        ("never carry glass into the aisle", "alone"),
        ("never touch the glass", "where robots never go"),
        ("no robot takes off after 20:00", "where robots never go"),
        ("rover_1 never works", "which hours"),
        ("nobody must never enter the aisle", ""),
        ("only rover_1 goes to dock 2", ""),
        ("rover_1: go to dock 2", ""),
        ("stop", ""),
        ("", ""),
    ],
)
def test_what_no_rule_says_whole_is_none(text: str, why: str) -> None:
    """Conditions, exceptions, ways, ambiguous hours, unknown names, further orders: with the reason, never in part."""
    found = said(text)
    assert found == "" or found.startswith("(")
    assert why in found


@pytest.mark.parametrize(
    "text",
    [
        "do not carry the box and return home",
        "do not pick up the box, inspect the gate",
        "never carry glass and photograph dock 2",
        "never carry the box, land",
        "don't carry the box, stop",
        "never carry glass, halt",
        "never carry glass and stop rover_1",
        "never carry glass or enter dock 2",
        "rover_1 never carries glass and rover_2 never carries wood",
        "never carry glass again",
        "never carry all boxes",
        "never carry 2 boxes",
        "never carry these boxes",
        "do not pick up box 1 and 2",
        "never carry it",
        "never go to dock 2 before 8:00 and after 18:00 on sundays",
        "never go to dock 2 after 18:00 or before 6:00 on weekdays",
        "never go to dock 2 after midnight",
        "never go to dock 2 before midnight",
    ],
)
def test_what_may_be_another_order_or_other_hours_is_no_rule(text: str) -> None:
    """A second order or prohibition, a stop, words that are no part of a name, hours that begin on other days."""
    found = rule_words(text, ROBOTS, SITE, zone=ZONE)
    assert found is None or found.rule is None


def test_rovers_are_no_group_where_others_stand_on_the_ground() -> None:
    """A rule for all ground robots would forbid more, one for those that are there now less."""
    arm = RobotInfo(id="arm_1", kind="zenoh")
    found = rule_words("no rover goes to dock 1", (*ROBOTS, arm), SITE)
    assert found is not None
    assert "not all ground robots are rovers" in found.problem
    odd = rule_words("no drone goes to dock 1", (*ROBOTS, RobotInfo(id="drone", kind="zenoh")), SITE)
    assert odd is not None
    assert "is a robot and a kind of robots" in odd.problem


names = st.lists(st.sampled_from([each.id for each in ROBOTS]), max_size=3, unique=True).map(sorted).map(tuple)
places = st.lists(st.sampled_from(list(SITE.places)), min_size=1, max_size=3, unique=True).map(sorted).map(tuple)


@given(
    robots=names,
    group=st.sampled_from(("all", "flying", "ground")),
    places=places,
    begin=st.integers(0, DAY_MIN - 1),
    length=st.integers(1, DAY_MIN - 1),
    days=st.lists(st.integers(0, 6), max_size=7, unique=True).map(sorted).map(tuple),
    zone=st.sampled_from(("UTC", "Europe/Zurich", "America/Argentina/Buenos_Aires")),
    kind=st.sampled_from(("places", "things", "hours")),
)
def test_a_rule_is_read_back_as_itself(
    robots: tuple[str, ...], group: str, places: tuple[str, ...], begin: int, length: int, days: tuple[int, ...],
    zone: str, kind: str,
) -> None:  # fmt: skip
    """What a person confirms is what is kept: the words of every rule are read as that rule."""
    parts = {"places": {"places": places}, "things": {"things": ("glass", "red box")}, "hours": {}}[kind]
    rule = Rule(
        robots=robots, group="all" if robots else group, begin_min=begin,  # type: ignore[arg-type]
        end_min=(begin + length) % DAY_MIN or DAY_MIN, days=days, zone=zone, **parts,
    )  # fmt: skip
    found = rule_words(rule.text, ROBOTS, SITE)
    assert found is not None
    assert found.rule == rule, found.problem


KNOWN = re.compile(
    r"[\d:.,-]*|or|and|nor|to|at|in|into|dock|gate|aisle|second|lost|found|the|a|an|please|ever|never|always|daily|.*day|"
    r"after|before|from|between|past|mon|tue|wed|thu|fri|sat|sun|on|every|each|over|utc|am|pm|until|till",
    re.IGNORECASE,
)


@given(
    text=st.sampled_from(
        (
            "never go to dock 2",
            "rover_1 never carries glass into",
            "no drone enters the aisle",
            "keep robots out of gate",
        )
    ),
    words=st.lists(st.text("abcdefghijklmnopqrstuvwxyz'", min_size=1, max_size=9), min_size=1, max_size=4),
)
def test_a_word_that_is_not_understood_makes_no_rule(text: str, words: list[str]) -> None:
    """No word is passed over: it may be the one that changes what is meant."""
    if all(KNOWN.fullmatch(each) for each in words):
        return
    found = rule_words(f"{text} {' '.join(words)}", ROBOTS, SITE)
    assert found is None or found.rule is None


@given(st.text(max_size=200))
def test_no_text_breaks_it(text: str) -> None:
    """Whatever is typed, with or without the beginning of a rule, gives a rule, a reason or nothing."""
    for each in (text, f"never go to {text}", f"no robot {text} after 25:99", f"{text} never carries {text}"):
        found = rule_words(each, ROBOTS, SITE)
        assert found is None or (found.rule is None) == bool(found.problem)


def test_a_long_text_is_none() -> None:
    """Thousands of words are no rule, and are seen at once."""
    assert rule_words("never go to " + "dock 1 and " * 10_000, ROBOTS, SITE) is None
    assert said("never go to " + "dock 1 and " * 30) != ""


@pytest.mark.anyio
async def test_a_mere_prohibition_is_offered_as_a_rule(catalogue: Catalogue) -> None:
    """It is never planned, nor added by itself; one with an order in it is planned and reviewed as before."""
    decomposer = Decomposer(LlmConfig(tiers=("rules",)), catalogue)
    context = PlanContext(instruction="From now on never go to dock 2", robots=ROBOTS, site=SITE)
    with pytest.raises(RefusedError, match="standing rule, not a task") as refused:
        await decomposer.plan(context)
    assert refused.value.remedy == "swiftbot rules add 'From now on never go to dock 2'"
