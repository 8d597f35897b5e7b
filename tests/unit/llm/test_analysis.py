"""What an instruction asks for: constraints with units, who can do it, and what it will need of pools."""

import pytest

from appliance.llm.analysis import analyse, constraints, starts
from appliance.model import Plan, RobotInfo, Subtask
from appliance.skills.catalogue import Catalogue


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("localize with a moving window of 400 ms", [("window", 400.0, "ms")]),
        ("track the forklift in a 2 second sliding window", [("window", 2000.0, "ms")]),
        ("be back within half an hour", [("deadline", 1800.0, "s")]),
        ("be at dock 3 by 14:30", [("clock", None, "")]),
        ("patrol for ten minutes every 2 hours", [("period", 7200.0, "s"), ("duration", 600.0, "s")]),
        ("match the scene against 3DMatch and Replica", [("dataset", None, ""), ("dataset", None, "")]),
        ("go there at 2 m/s, no higher", [("speed", 2.0, "mps")]),
        ("climb to 20 m and hold", [("altitude", 20.0, "m")]),
        ("keep 3 metres away from the crowd", [("distance", 3.0, "m")]),
        ("classify the kinetics-400 clips", [("dataset", None, "")]),
        ("go to dock 3", []),
    ],
)
def test_constraints_with_their_units(text: str, found: list[tuple[str, float | None, str]]) -> None:
    """Deadlines, windows, periods, bounds and data sets, in the unit that is shown; each piece of text once."""
    assert [(each.kind, each.value, each.unit) for each in constraints(text)] == found


def test_the_whole_analysis(catalogue: Catalogue, robots: tuple[RobotInfo, ...]) -> None:
    """Parameters carry units, robots stand by capability and experience, containers by when they are needed."""
    plan = Plan(
        domain="media",
        subtasks=(
            Subtask(id="s1", skill="goto", robot="any", params={"place": "dock 1", "speed_mps": 1.5}),
            Subtask(
                id="s2", skill="record_video", robot="any", params={"target": "x", "duration_s": 60}, after=("s1",)
            ),
            Subtask(id="s3", skill="extract_frames", after=("s2",)),
            Subtask(id="s4", skill="encode_clip", after=("s3",)),
        ),
    )
    took = {"goto": 12.0, "record_video": 5.0}
    found = analyse(
        "go to dock 1 and film it for a minute",
        plan,
        catalogue,
        robots,
        expected_s=lambda skill, _robot: took.get(skill),
        peak_mb=lambda skill: 300.0 if skill == "encode_clip" else 0.0,
        reliability=lambda _skill, robot: 0.2 if robot == "drone_1" else 0.9,
        shuns=lambda skill, robot: "it slipped" if (skill, robot) == ("goto", "drone_1") else "",
    )
    units = {each.name: each.unit for each in found.parameters}
    assert units == {"place": "", "speed_mps": "mps", "target": "", "duration_s": "s"}
    (able,) = found.able
    assert able.robots == ("rover_1", "drone_1")
    assert able.shunned == {"drone_1": "it slipped"}
    (encode,) = (each for each in found.allocation if "s4" in each.subtasks)
    assert encode.image == catalogue.skills["encode_clip"].image
    assert encode.seen_mb == 300.0
    assert starts(plan, {"s1": 12.0, "s2": 60.0, "s3": 3.0})["s4"] == 75.0
    assert found.allocation[0].start_s == 0.0
    assert found.expected_s == 78.0


def test_circles_and_unknown_skills_do_not_break_it(catalogue: Catalogue) -> None:
    """An analysis of a plan that no validator has seen leaves out what makes no sense."""
    plan = Plan(
        domain="x",
        subtasks=(
            Subtask(id="a", skill="dance", robot="any", after=("b",)),
            Subtask(id="b", skill="goto", robot="any", after=("a",)),
        ),
    )
    assert starts(plan, {}) == {}
    assert analyse("x", plan, catalogue, None).allocation == ()
