"""What words mean as names, robots and quantities."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.llm import values


@pytest.mark.parametrize(
    ("said", "meant"),
    [
        ("the Red Pallet", "red pallet"),
        ("dock four", "dock 4"),
        ("Door A", "door a"),
        ("A", "a"),
        ("twenty-two", "22"),
        ("room two one four", "room 214"),
        ("bay forty two.", "bay 42"),
        ("the crow's nest", "crow's nest"),
        ("second shelf", "second shelf"),
        ("“Take Me”", "take me"),
    ],
)
def test_names(said: str, meant: str) -> None:
    """Lower case, without articles and quotes, number words in figures; the last word is no article."""
    assert values.name(said) == meant


@pytest.mark.parametrize(
    ("said", "meant"),
    [("Robot Two's", "robot_2"), ("the Spot 3", "spot_3"), ("Robot_1", "robot_1"), ("Drone A", "drone_a")],
)
def test_robots(said: str, meant: str) -> None:
    """A robot's name is its id, blanks as underscores."""
    assert values.robot(said) == meant


@pytest.mark.parametrize(
    ("said", "unit", "meant"),
    [
        ("twenty minutes", "s", 1200),
        ("two and a half minutes", "s", 150),
        ("an hour and a half", "s", 5400),
        ("half a minute", "s", 30),
        ("half an hour", "s", 1800),
        ("three quarters of a minute", "s", 45),
        ("a quarter of an hour", "s", 900),
        ("one minute thirty", "s", 90),
        ("1 h 30 min", "s", 5400),
        ("90s", "s", 90),
        ("400 ms", "ms", 400),
        ("half a second", "ms", 500),
        ("0.2 s", "ms", 200),
        ("100 feet", "m", 30.48),
        ("10 yards", "m", 9.144),
        ("half a mile", "m", 804.672),
        ("six inches", "m", 0.152),
        ("the yard", "m", None),
        ("2 yard lights", "m", None),
        ("5 mph", "mps", 2.235),
        ("ten miles per hour", "mps", 4.47),
        ("one five zero metres", "m", 150),
        ("one hundred and twenty metres", "m", 120),
        ("1,200 m", "m", 1200),
        ("3 km/h", "mps", 0.833),
        ("5 m/s", "mps", 5),
        ("five cm/s", "mps", 0.05),
        ("5 cm/s", "mps", 0.05),
        ("two metres per second", "mps", 2),
        ("twice", "", 2),
        ("three times", "", 3),
        ("two dozen", "", 24),
        ("half a dozen", "", 6),
        ("a couple", "", 2),
        ("thirty five", "", 35),
        ("a minute", "s", 60),
        ("the red box", "s", None),
        ("", "s", None),
        ("minutes", "s", None),
    ],
)
def test_quantities(said: str, unit: str, meant: float | None) -> None:
    """Numbers in figures and words with their units are the number in the parameter's unit."""
    assert values.quantity(said, unit) == meant


def test_units_stand_in_the_name() -> None:
    """The part behind the last underscore is the unit."""
    assert [values.unit_of(each) for each in ("duration_s", "window_ms", "speed_mps", "radius_m", "laps")] == [
        *("s", "ms", "mps", "m", "")
    ]


@settings(deadline=None)
@given(st.text(max_size=60), st.sampled_from(["s", "ms", "m", "mps", ""]))
def test_no_text_breaks_them(text: str, unit: str) -> None:
    """Whatever is said is a name, a text and a robot, and a quantity or none."""
    assert isinstance(values.free(text) + values.robot(text), str)
    assert isinstance(values.quantity(text, unit), int | float | None)
