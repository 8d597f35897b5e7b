"""Handlers that map: what they drive through, what they know afterwards, and what becomes of broken maps."""

import math
from collections.abc import Callable
from types import ModuleType
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.unit.skills.test_seeing import RED

Make = Callable[..., Any]
Load = Callable[..., ModuleType]
Draw = Callable[..., bytes]

WALL_X = 12.0


def wall(ctx: Any) -> Callable[[dict[str, Any]], dict[str, Any]]:
    """Return a range finder that sees a wall in the east, and nothing else for 8 m."""

    def scan(_: dict[str, Any]) -> dict[str, Any]:
        pose = ctx.info["pose"]
        ranges: list[float | None] = []
        for degrees in range(360):
            east = math.sin(math.radians(degrees))
            gap = (WALL_X - pose["x"]) / east if east > 1e-6 else math.inf
            ranges.append(round(gap, 3) if gap < 8.0 else None)
        return {"from_deg": 0, "step_deg": 1, "most_m": 8.0, "ranges_m": ranges, "pose": pose}

    return scan


@pytest.fixture
def surveyor(make_ctx: Make) -> Callable[..., Any]:
    """Return a function that makes a ctx whose robot has a range finder and a site without walls on its map."""

    def make(**params: Any) -> Any:
        ctx = make_ctx(**params)
        ctx.site = {"places": {"yard": {"x": 8.0, "y": 5.0}, "corner": {"x": 0.0, "y": 0.0}}}
        ctx.answers["scan"] = wall(ctx)
        return ctx

    return make


def cell(ctx: Any, reference: dict[str, Any], x: float, y: float) -> int:
    """Return what a kept map says of a point."""
    data = ctx.get_artifact(reference)[-reference["width"] * reference["height"] :]
    column = math.floor((x - reference["origin"][0]) / reference["resolution_m"])
    row = math.floor((y - reference["origin"][1]) / reference["resolution_m"])
    return data[(reference["height"] - 1 - row) * reference["width"] + column]


def test_map_area_finds_the_wall_and_what_is_before_it(surveyor: Make, handler: Load) -> None:
    """Before the wall it is free, the wall is taken, behind it nobody knows."""
    ctx = surveyor(area="yard")
    ctx.site["obstacles"] = [{"name": "behind", "x": [WALL_X, 40.0], "y": [-40.0, 40.0]}]
    result = handler("map_area").run(ctx)
    found = result["map"]
    assert [cell(ctx, found, x, 5.0) for x in (10.0, WALL_X + 0.05, 12.8)] == [254, 0, 205]
    assert (found["width"], found["height"], found["origin"]) == (40, 40, [3.0, 0.0])
    assert 0.8 < found["known_share"] < 1.0
    assert result["stops"] == len(ctx.sent("scan"))
    assert found["media_type"] != "image/png"  # nobody is to look for red boxes in it


def test_an_attempt_elsewhere_goes_on_with_the_map(surveyor: Make, handler: Load, leave: Callable[..., Any]) -> None:
    """Left after its third stop, it drives to the others only, and the map has what the first attempt saw."""
    whole = handler("map_area").run(surveyor(area="yard"))
    ctx = surveyor(area="yard")
    saved = leave(handler("map_area").run, ctx, 3)
    later = surveyor(area="yard")
    later.files, later.resume = ctx.files, saved
    result = handler("map_area").run(later)
    assert len(later.sent("scan")) == whole["stops"] - 3
    assert later.get_artifact(result["map"]) == later.get_artifact({**whole["map"]})


def test_explore_says_what_it_saw_and_where(surveyor: Make, handler: Load, picture: Draw) -> None:
    """A picture at each stop; only those that show something are kept."""
    ctx = surveyor(area="yard")
    pictures = iter([picture(), picture(RED), *[picture()] * 20])
    ctx.answers["capture"] = lambda _: {"blobs": {"image.png": next(pictures)}}
    result = handler("explore").run(ctx)
    assert [(row["colour"], row["stop"]) for row in result["detections"]] == [("red", 2)]
    assert len(result["images"]) == 1


def test_what_cannot_be_mapped_is_refused(surveyor: Make, handler: Load) -> None:
    """An unknown area, one that is walled off, one that is too large, and a robot without a distance."""
    with pytest.raises(surveyor().Fail, match="no place 'moon'"):
        handler("map_area").run(surveyor(area="moon"))
    ctx = surveyor(area="yard")
    ctx.site["forbidden"] = [{"name": "ring", "x": [-9.0, 30.0], "y": [-9.0, 30.0]}]
    with pytest.raises(ctx.Fail, match="stops"):
        handler("map_area").run(ctx)
    ctx = surveyor(area="everything")
    ctx.site["fence"] = {"name": "fence", "x": [0.0, 900.0], "y": [0.0, 900.0]}
    with pytest.raises(ctx.Fail, match="900 x 900 m"):
        handler("map_area").run(ctx)
    ctx = surveyor(area="yard")
    ctx.answers["scan"] = lambda _: {"ranges_m": ["far", True, -1.0], "most_m": 8.0}
    with pytest.raises(ctx.Fail, match="without a distance"):
        handler("map_area").run(ctx)


def test_merge_maps_keeps_what_either_knows(surveyor: Make, handler: Load) -> None:
    """Two areas side by side are one map; a wall that one robot saw stays; detections are one list."""
    west, east = surveyor(area="corner"), surveyor(area="yard")
    first, second = handler("map_area").run(west), handler("map_area").run(east)
    ctx = surveyor()
    ctx.files = west.files | east.files
    ctx.inputs = {"a": first | {"detections": [{"colour": "red"}]}, "b": second, "c": {"map": "none"}}
    result = handler("merge_maps").run(ctx)
    assert (result["merged"], result["count"]) == (2, 1)
    assert cell(ctx, result["map"], WALL_X + 0.05, 5.0) == 0
    assert cell(ctx, result["map"], 0.0, 0.0) == 254
    assert result["map"]["origin"] == [-5.0, -5.0]
    with pytest.raises(ctx.Fail, match="no map to merge"):
        handler("merge_maps").run(surveyor())


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60, deadline=None)
@given(
    data=st.binary(max_size=80)
    | st.binary(max_size=40).map(lambda tail: b"P5\n4 3\n255\n" + tail)
    | st.just(b"P5\n4 3\n255\n" + bytes(12))
)
def test_a_broken_map_is_named(surveyor: Make, handler: Load, data: bytes) -> None:
    """Whatever the bytes are, they are a map or a refusal."""
    ctx = surveyor()
    reference = ctx.put_artifact("map.pgm", data, "application/x-portable-graymap")
    ctx.inputs = {"a": {"map": reference}}
    if len(data) == len(b"P5\n4 3\n255\n") + 12 and data.startswith(b"P5\n4 3\n255\n"):
        result = handler("merge_maps").run(ctx)
        assert (result["map"]["width"], result["map"]["height"]) == (4, 3)
        return
    with pytest.raises(ctx.Fail, match=r"map\.pgm"):
        handler("merge_maps").run(ctx)


@pytest.mark.parametrize("robots", [1, 2, 5])
def test_split_area_gives_each_robot_as_much(make_ctx: Make, handler: Load, robots: int) -> None:
    """Zones touch, do not overlap, and are together the area."""
    ctx = make_ctx(area="site", robots=[f"rover_{number}" for number in range(robots)])
    zones = handler("split_area").run(ctx)["zones"]
    assert [each["robot"] for each in zones] == ctx.params["robots"]
    assert sum(each["square_m"] for each in zones) == pytest.approx(1200.0)
    assert len({each["square_m"] for each in zones}) == 1
    assert [each["x"][0] for each in zones[1:]] == [each["x"][1] for each in zones[:-1]]


@pytest.mark.parametrize("robots", [None, [], ["", " "], "rover_1", [f"r{number}" for number in range(65)]])
def test_split_area_needs_robots(make_ctx: Make, handler: Load, robots: Any) -> None:
    """None, and more than can be, are refused."""
    ctx = make_ctx(area="site", robots=robots)
    with pytest.raises(ctx.Fail, match="robots"):
        handler("split_area").run(ctx)
