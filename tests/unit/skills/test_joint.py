"""Handlers of joint skills, against fake robots: who goes where, how fast, and what is refused."""

import math
from collections.abc import Callable
from itertools import combinations
from types import ModuleType
from typing import Any

import pytest

Make = Callable[..., Any]
Load = Callable[..., ModuleType]
POSES = {"a": {"x": 4.0, "y": 4.0}, "b": {"x": 6.0, "y": 4.0}, "c": {"x": 4.0, "y": 8.0}}


@pytest.fixture
def make_joint(make_ctx: Make) -> Make:
    """Return a function that makes a ctx of robots that stand at `POSES`."""

    def make(robots: str = "abc", **params: Any) -> Any:
        ctx = make_ctx(robots=[*robots], **params)
        ctx.robot, ctx.robots, ctx.poses = robots[0], tuple(robots), {name: dict(POSES[name]) for name in robots}
        return ctx

    return make


def test_rendezvous_sends_all_at_once_to_spots_apart(make_joint: Make, handler: Load) -> None:
    """One command for all, each to a spot of its own near the place, as fast as to arrive together."""
    ctx = make_joint(place="home")
    home = ctx.site["places"]["home"]
    result = handler("rendezvous").run(ctx)
    assert [verb for verb, _ in ctx.commands] == ["state", "goto"]
    assert set(result["robots"]) == {"a", "b", "c"}
    ends = [tuple(each["pose"][axis] for axis in "xy") for each in result["robots"].values()]
    assert all(math.dist(one, other) >= 1.4 for one, other in combinations(ends, 2))
    assert all(math.dist(end, (home["x"], home["y"])) < 3.5 for end in ends)
    speeds = {robot: args["speed_mps"] for robot, args in ctx.sent("goto")[0].items()}
    lengths = {robot: each["path_m"] for robot, each in result["robots"].items()}
    farthest = max(lengths, key=lambda robot: lengths[robot])
    assert max(speeds.values()) == speeds[farthest]


@pytest.mark.parametrize("formation", ["line", "a circle", "column", "V", "wedge"])
def test_a_formation_keeps_robots_apart(make_joint: Make, handler: Load, formation: str) -> None:
    """Around the middle of where they are; each robot has one spot."""
    ctx = make_joint(formation=formation)
    result = handler("form_up").run(ctx)
    ends = [tuple(each["pose"][axis] for axis in "xy") for each in result["robots"].values()]
    assert all(math.dist(one, other) >= 1.4 for one, other in combinations(ends, 2))
    assert math.dist([sum(axis) / 3 for axis in zip(*ends, strict=True)], (14 / 3, 16 / 3)) < 1.0


def test_a_formation_that_is_not_known_names_those_that_are(make_joint: Make, handler: Load) -> None:
    """And nothing is sent."""
    ctx = make_joint(formation="pyramid")
    with pytest.raises(ctx.Fail, match="pyramid") as caught:
        handler("form_up").run(ctx)
    assert "line" in caught.value.remedy
    assert not ctx.commands


def test_no_room_for_a_formation_is_said_before_anything_moves(make_joint: Make, handler: Load) -> None:
    """The spots that cannot be stood on are named."""
    ctx = make_joint(formation="line")
    ctx.site["obstacles"] = [{"name": "wall", "x": [4.0, 5.2], "y": [0.0, 20.0]}]
    with pytest.raises(ctx.Fail, match="no room for a line"):
        handler("form_up").run(ctx)
    assert not ctx.sent("goto")


@pytest.mark.parametrize("skill", ["rendezvous", "form_up"])
def test_one_robot_alone_is_refused(make_joint: Make, handler: Load, skill: str) -> None:
    """Also where a plan came past the validator."""
    ctx = make_joint("a", place="home", formation="line")
    with pytest.raises(ctx.Fail, match="several robots"):
        handler(skill).run(ctx)
    assert not ctx.commands


def test_a_robot_that_does_not_know_where_it_is_keeps_all_where_they_are(make_joint: Make, handler: Load) -> None:
    """The robot is named, and none is sent anywhere."""
    ctx = make_joint(place="home")
    ctx.poses["b"] = None
    with pytest.raises(ctx.Fail, match="b does not know where it is"):
        handler("rendezvous").run(ctx)
    assert not ctx.sent("goto")
