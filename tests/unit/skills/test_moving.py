"""Handlers that move a robot or use its arm, against a fake robot."""

import math
from collections.abc import Callable
from itertools import pairwise
from types import ModuleType
from typing import Any

import pytest

Make = Callable[..., Any]
Load = Callable[..., ModuleType]


def verbs(ctx: Any) -> list[str]:
    """Commands sent, in order."""
    return [verb for verb, _ in ctx.commands]


def test_goto_plans_sends_and_waits(make_ctx: Make, handler: Load) -> None:
    """Goto finds the place by its alias, goes round the racks, and returns where it is and how far it went."""
    ctx = make_ctx(place="the Loading Dock 3")
    result = handler("goto").run(ctx)
    assert verbs(ctx) == ["state", "goto"]
    assert result["place"] == "dock 3"
    assert result["waypoints"][-1] == {"x": 36.0, "y": 18.0}
    assert len(result["waypoints"]) > 1
    assert result["path_m"] > math.dist((4, 4), (36, 18))
    assert ctx.sent("goto")[0]["speed_mps"] == 6.0
    assert ctx.steps[-1] == (1.0, "at dock 3")


def test_goto_takes_coordinates(make_ctx: Make, handler: Load) -> None:
    """A coordinate is a place too."""
    assert handler("goto").run(make_ctx(place="(8, 6.5)"))["waypoints"][-1] == {"x": 8.0, "y": 6.5}


def test_goto_keeps_to_the_speed_limit(make_ctx: Make, handler: Load) -> None:
    """A speed above the site's limit is held to it, and the log says so; one below is kept."""
    ctx = make_ctx(place="home", speed_mps=50)
    handler("goto").run(ctx)
    assert ctx.sent("goto")[0]["speed_mps"] == 6.0
    assert "more than the site allows" in ctx.logged[0]
    slow = make_ctx(place="home", speed_mps=0.5)
    handler("goto").run(slow)
    assert slow.sent("goto")[0]["speed_mps"] == 0.5


def test_goto_keeps_a_flyer_s_height(make_ctx: Make, handler: Load) -> None:
    """In the air it keeps its height within the site's limit; from the ground the robot chooses; a high goal counts."""
    for height, place, wanted in ((8.0, "dock 2", {8.0}), (80.0, "dock 2", {30.0}), (0.0, "dock 2", {None}),
                                  (8.0, "(36, 18, 12)", {12.0})):  # fmt: skip
        ctx = make_ctx(place=place)
        ctx.info |= {"flies": True, "pose": {"x": 6.0, "y": 25.0, "z": height}}
        handler("goto").run(ctx)
        assert verbs(ctx) == ["state", "goto"]
        assert {point.get("z") for point in ctx.sent("goto")[0]["waypoints"]} == wanted


def test_goto_never_enters_the_forbidden_area(make_ctx: Make, handler: Load) -> None:
    """The straight way from goal 1 to dock 2 leads through the pit; the way taken does not."""
    ctx = make_ctx(place="goal 2")
    ctx.info["pose"] = {"x": 30.0, "y": 5.0}
    points = [(30.0, 5.0), *((at["x"], at["y"]) for at in handler("goto").run(ctx)["waypoints"])]
    for (x, y), (to_x, to_y) in pairwise(points):
        for step in range(101):
            at = (x + (to_x - x) * step / 100, y + (to_y - y) * step / 100)
            assert not (28 < at[0] < 32 and 8 < at[1] < 12)


@pytest.mark.parametrize(
    ("params", "message", "remedy"),
    [
        ({"place": "goal 7"}, "no place 'goal 7'", "dock 3"),
        ({}, "'place' is missing", "as text"),
        ({"place": "  "}, "'place' is missing", "as text"),
        ({"place": 7}, "'place' is missing", "as text"),
        ({"place": "home", "speed_mps": "fast"}, "not a number", "number"),
        ({"place": "home", "speed_mps": -1}, "outside", "number"),
        ({"place": "home", "speed_mps": math.inf}, "not a number", "number"),
        ({"place": "(5000, 1)"}, "outside the site", "span"),
        ({"place": "(18, 9)"}, "inside 'rack a'", "another place"),
        ({"place": "(30, 10)"}, "inside 'maintenance pit'", "another place"),
        ({"place": "(3, 3, 12)"}, "does not fly", "flies"),
        ({"place": "(3, 3, 99)"}, "the site allows 30 m", "lower"),
    ],
)
def test_goto_refuses_what_cannot_be(
    make_ctx: Make, handler: Load, params: dict[str, Any], message: str, remedy: str
) -> None:
    """A place that is unknown, closed or absurd is refused with cause and remedy, and the robot is not moved."""
    ctx = make_ctx(**params)
    with pytest.raises(ctx.Fail) as caught:
        handler("goto").run(ctx)
    assert message in caught.value.message
    assert remedy in caught.value.remedy
    assert not caught.value.retryable
    assert "goto" not in verbs(ctx)


def test_goto_may_be_tried_again_without_a_position(make_ctx: Make, handler: Load) -> None:
    """A robot that has no fix yet is worth another attempt."""
    ctx = make_ctx(place="home")
    del ctx.info["pose"]
    with pytest.raises(ctx.Fail, match="does not know where it is") as caught:
        handler("goto").run(ctx)
    assert caught.value.retryable


def test_a_flyer_crosses_racks_only_where_it_must(make_ctx: Make, handler: Load) -> None:
    """Over a rack there is a way for a robot that flies, and none over a forbidden area."""
    ctx = make_ctx(place="(18, 9)")
    ctx.info |= {"flies": True, "pose": {"x": 6.0, "y": 25.0, "z": 6.0}}
    assert handler("goto").run(ctx)["waypoints"][-1] == {"x": 18.0, "y": 9.0, "z": 6.0}
    ctx = make_ctx(place="(30, 10)")
    ctx.info |= {"flies": True, "pose": {"x": 6.0, "y": 25.0, "z": 6.0}}
    with pytest.raises(ctx.Fail, match="maintenance pit"):
        handler("goto").run(ctx)


def test_follow_path_passes_all_in_order(make_ctx: Make, handler: Load) -> None:
    """Places and coordinates are passed in the order given, in one command."""
    ctx = make_ctx(path="from home via the aisle to goal 1, then (8, 6) and dock 2")
    result = handler("follow_path").run(ctx)
    assert result["path"] == ["home", "aisle", "goal 1", "(8, 6)", "dock 2"]
    assert len(ctx.sent("goto")) == 1
    passed = [(at["x"], at["y"]) for at in result["waypoints"]]
    order = [passed.index(at) for at in ((18.0, 13.0), (28.0, 5.0), (8.0, 6.0), (36.0, 12.0))]
    assert order == sorted(order)


@pytest.mark.parametrize(("path", "message"), [("east corridor route", "no place"), (",;", "no place in")])
def test_follow_path_refuses_an_unknown_route(make_ctx: Make, handler: Load, path: str, message: str) -> None:
    """A route that the map does not have is refused."""
    ctx = make_ctx(path=path)
    with pytest.raises(ctx.Fail, match=message):
        handler("follow_path").run(ctx)


def test_patrol_rounds_an_area_as_often_as_asked(make_ctx: Make, handler: Load) -> None:
    """Two laps round a rack are two ways that end where they began."""
    ctx = make_ctx(area="rack b", laps=2)
    result = handler("patrol").run(ctx)
    assert result["laps"] == 2
    assert len(ctx.sent("goto")) == 2
    assert ctx.info["pose"] == {"x": 11.0, "y": 14.0}
    assert result["path_m"] > 2 * (2 * 12 + 2 * 3)


def test_patrol_needs_more_than_a_point(make_ctx: Make, handler: Load) -> None:
    """A place has no edge to walk: the remedy names the areas that have."""
    ctx = make_ctx(area="dock 1")
    with pytest.raises(ctx.Fail) as caught:
        handler("patrol").run(ctx)
    assert "rack a" in caught.value.remedy


def test_plan_route_moves_nothing(make_ctx: Make, handler: Load) -> None:
    """A route is planned from where the earlier subtask ended, else from home, without a command."""
    ctx = make_ctx(place="dock 3")
    ctx.robot = None
    result = handler("plan_route").run(ctx)
    assert (result["start"], result["target"]) == ("home", "dock 3")
    assert result["path"][0] == {"x": 4.0, "y": 4.0}
    ctx.inputs = {"s1": {"skill": "goto", "pose": {"x": 36.0, "y": 12.0}}}
    assert handler("plan_route").run(ctx)["route_m"] == 6.0
    ctx.inputs = {"s1": {"skill": "goto", "pose": {}}}
    assert handler("plan_route").run(ctx)["path"][0] == {"x": 0.0, "y": 0.0}
    assert ctx.commands == []


def test_orbit_circles_at_its_radius(make_ctx: Make, handler: Load) -> None:
    """Waypoints of the laps lie on the circle; one that an obstacle cuts is refused."""
    ctx = make_ctx(target="inspection point", radius_m=1.5, laps=2)
    result = handler("orbit").run(ctx)
    assert result["laps"] == 2
    for at in ctx.sent("goto")[1]["waypoints"]:
        assert math.dist((at["x"], at["y"]), (9.0, 14.0)) == pytest.approx(1.5, abs=0.01)
    ctx = make_ctx(target="aisle", radius_m=4)
    with pytest.raises(ctx.Fail, match="runs through 'rack"):
        handler("orbit").run(ctx)
    assert not ctx.sent("goto")


def test_takeoff_stays_below_the_limit(make_ctx: Make, handler: Load) -> None:
    """Takeoff climbs to what is asked, to 5 m where nothing is, and refuses what the site does not allow."""
    ctx = make_ctx(altitude_m=12)
    assert handler("takeoff").run(ctx)["altitude_m"] == 12.0
    ctx = make_ctx()
    assert handler("takeoff").run(ctx)["altitude_m"] == 5.0
    assert ctx.sent("takeoff") == [{"altitude_m": 5.0}]
    ctx = make_ctx(altitude_m=31)
    with pytest.raises(ctx.Fail, match="above the site's limit of 30 m"):
        handler("takeoff").run(ctx)


@pytest.mark.parametrize(("skill", "key"), [("land", "landed"), ("return_home", "home")])
def test_plain_orders_are_passed_on(make_ctx: Make, handler: Load, skill: str, key: str) -> None:
    """Land and return_home give the order and report its outcome."""
    ctx = make_ctx()
    assert handler(skill).run(ctx) == {"did": skill, key: True}
    assert ctx.commands == [(skill, {})]


def test_hold_holds_as_long_as_asked(make_ctx: Make, handler: Load) -> None:
    """Hold passes the duration on where there is one."""
    ctx = make_ctx(duration_s=30)
    assert handler("hold").run(ctx)["held_s"] == 30.0
    assert ctx.sent("hold") == [{"duration_s": 30.0}]
    ctx = make_ctx()
    handler("hold").run(ctx)
    assert ctx.sent("hold") == [{}]


def test_pick_and_place_name_the_object(make_ctx: Make, handler: Load) -> None:
    """Pick and place pass object and place on and report them."""
    ctx = make_ctx(object="red box", at="conveyor")
    assert handler("pick").run(ctx)["object"] == "red box"
    assert handler("place").run(ctx)["at"] == "conveyor"
    assert ctx.commands == [("pick", {"object": "red box"}), ("place", {"object": "red box", "at": "conveyor"})]


@pytest.mark.parametrize(("skill", "params"), [("pick", {}), ("place", {"object": "red box"}), ("place", {"at": "x"})])
def test_arm_orders_need_their_words(make_ctx: Make, handler: Load, skill: str, params: dict[str, Any]) -> None:
    """A missing object or place is refused before the arm moves."""
    ctx = make_ctx(**params)
    with pytest.raises(ctx.Fail, match="missing"):
        handler(skill).run(ctx)
    assert ctx.commands == []


def test_a_robot_s_refusal_is_the_handler_s(make_ctx: Make, handler: Load) -> None:
    """What the robot refuses goes through untouched, with its cause and whether to try again."""
    ctx = make_ctx(object="red box")

    def refuse(_: dict[str, Any]) -> dict[str, Any]:
        raise ctx.Fail("no red box within reach", "go nearer", retryable=True)

    ctx.answers["pick"] = refuse
    with pytest.raises(ctx.Fail) as caught:
        handler("pick").run(ctx)
    assert (caught.value.remedy, caught.value.retryable) == ("go nearer", True)
