"""Places: one reading of coordinates for plans, missions and skills; the fence; latitude and longitude."""

from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.llm.checks.places import coordinate, locate, nearest, outside, place_problems
from appliance.model import Place, Subtask
from appliance.skills._lib import places as skills
from appliance.skills.sites import load_site

SITE = load_site("warehouse")


def going(place: str, **params: Any) -> tuple[str, ...]:
    """Return what is wrong with a goto."""
    return tuple(place_problems(Subtask(id="s1", skill="goto", robot="r", params={"place": place, **params}), SITE))


@pytest.mark.parametrize("text", ["(10.0, 10.0, 8.0)", "10, 10, 8", "x=10, y=10, z=8", "(10; 10; 8)"])
def test_three_numbers_are_a_point_with_a_height(text: str) -> None:
    """As a MAVLink mission writes its waypoints."""
    assert coordinate(text) == Place(x=10.0, y=10.0, z=8.0)
    assert locate(text, SITE) == Place(x=10.0, y=10.0, z=8.0)


@given(
    st.floats(-500, 500).map(lambda each: round(each, 2)),
    st.floats(-500, 500).map(lambda each: round(each, 2)),
    st.sampled_from(["{x}, {y}", "({x}, {y})", "x={x}, y={y}", "{x}; {y}", "({x}, {y}, 3)", "{x} {y}", "{x} m, {y} m"]),
)
def test_plans_and_skills_read_the_same_point(x: float, y: float, form: str) -> None:
    """What the check lets pass is where the robot goes."""
    text = form.format(x=x, y=y)
    found = coordinate(text)
    site = {"places": {"a": {"x": 0.0, "y": 0.0}, "b": {"x": 400.0, "y": 400.0}, "c": {"x": -400.0, "y": -400.0}}}
    spot = skills.resolve(SimpleNamespace(site=site, Fail=ValueError), text)  # pyright: ignore[reportArgumentType]
    assert found is not None
    assert (found.x, found.y, found.z) == (spot.x, spot.y, spot.z)


@pytest.mark.parametrize(
    ("place", "why"),
    [
        ("500, 500", "outside the fence"),
        ("(10, 10, -5)", "under the ground"),
        ("(10, 20, 80)", "above this site's limit"),
        ("47.3979, 8.5457", "latitude and longitude"),
        ("30, 10", "forbidden area maintenance pit"),
        ("18, 9", "inside rack a"),
        ("dcok 1", "nearest name: dock 1"),
    ],
)
def test_a_place_where_nobody_may_go_is_refused_with_the_reason(place: str, why: str) -> None:
    """Before anything moves."""
    (problem,) = going(place)
    assert why in problem


def test_metres_that_happen_to_be_near_the_degrees_of_the_site_are_metres() -> None:
    """On a large site (47, 8.5) is a point like any other; with the decimals of degrees it is a mistake."""
    large = replace(SITE, fence=None, obstacles=(), forbidden=())
    for text, problems in (("(47.0, 8.5, 10.0)", 0), ("47.4, 8.5", 0), ("47.39, 8.55", 1), ("8.5457, 47.3979", 1)):
        subtask = Subtask(id="s1", skill="goto", robot="r", params={"place": text})
        assert len(tuple(place_problems(subtask, large))) == problems, text


def test_without_a_fence_only_what_is_far_is_outside() -> None:
    """As the skills have it: 200 m beyond the mapped places."""
    bare = replace(SITE, fence=None)
    assert outside(Place(x=100.0, y=100.0), bare) == ""
    assert "200 m" in outside(Place(x=500.0, y=500.0), bare)
    assert going("26, 6") == ()
    assert nearest("dcok 1", SITE) == "dock 1"
