"""Handlers that compare: inspections with the one before, results with each other or a baseline, scenes with sets."""

from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from tests.unit.skills.test_seeing import BLUE, GREEN, RED, with_picture

Make = Callable[..., Any]
Load = Callable[..., ModuleType]
Draw = Callable[..., bytes]


def kinds(result: dict[str, Any]) -> list[str]:
    """Return the kinds of the findings."""
    return [each["kind"] for each in result["findings"]]


def test_inspect_says_what_changed_since_last_time(make_ctx: Make, handler: Load, picture: Draw) -> None:
    """The first time there is nothing to compare with; an unchanged asset has no finding; a leak has two."""
    ctx = make_ctx(asset="pump")
    first = handler("inspect").run(ctx)
    assert (kinds(first), first["compared"], first["judged"]) == ([], False, True)
    again = handler("inspect").run(ctx)
    assert (kinds(again), again["compared"]) == ([], True)
    ctx.picture = picture(("#1e3cdc", (100, 120, 90, 80)))
    leak = handler("inspect").run(ctx)
    assert kinds(leak) == ["colour", "changed"]
    left, top, width, height = leak["findings"][1]["boxes"][0]
    assert left < 0.35 < left + width
    assert top < 0.6 < top + height


def test_a_dark_picture_judges_nothing_and_is_no_baseline(make_ctx: Make, handler: Load, picture: Draw) -> None:
    """The inspection after it is compared with the last that could be judged."""
    ctx = make_ctx(asset="pump")
    handler("inspect").run(ctx)
    good, ctx.picture = ctx.picture, picture(("#000000", (0, 0, 320, 240)))
    dark = handler("inspect").run(ctx)
    assert (kinds(dark), dark["judged"]) == (["dark", "blurred"], False)
    ctx.picture = good
    assert kinds(handler("inspect").run(ctx)) == []


def test_a_damaged_baseline_is_replaced_and_said(make_ctx: Make, handler: Load, picture: Draw) -> None:
    """A disk's damage does not end every later inspection: the log has it, and the next one is the baseline."""
    ctx = make_ctx(asset="pump", baseline="monday")
    ctx.inputs["n"] = {"number": 4}
    with_picture(ctx, picture(RED))
    for skill in ("inspect", "compare"):
        handler(skill).run(ctx)
    for file in ctx.volume("baselines").iterdir():
        file.write_bytes(b"\x00damaged")
    assert not handler("inspect").run(ctx)["compared"]
    assert kinds(handler("compare").run(ctx)) == ["baseline", "baseline"]
    assert len(ctx.logged) == 3
    assert handler("inspect").run(ctx)["compared"]


def test_compare_holds_results_against_each_other(make_ctx: Make, handler: Load, picture: Draw) -> None:
    """Pictures and numbers, each with the one before; what is alike is no finding."""
    ctx = make_ctx()
    with_picture(ctx, picture(RED), subtask="a")
    with_picture(ctx, picture(RED, (BLUE[0], (150, 100, 90, 90))), subtask="b")
    ctx.inputs["c"] = {"number": 3.0}
    ctx.inputs["d"] = {"number": 5.5}
    result = handler("compare").run(ctx)
    assert (kinds(result), result["compared"]) == (["changed", "number"], 2)
    assert result["findings"][1]["difference"] == 2.5


def test_compare_keeps_a_baseline_by_name(make_ctx: Make, handler: Load, picture: Draw) -> None:
    """The first of a name is kept, later ones are held against it; another name knows nothing of it."""
    ctx = make_ctx(baseline="monday")
    with_picture(ctx, picture(GREEN))
    ctx.inputs["n"] = {"number": 4}
    assert kinds(handler("compare").run(ctx)) == ["baseline", "baseline"]
    again = handler("compare").run(ctx)
    assert (kinds(again), again["findings"][0]["difference"], again["compared"]) == (["number"], 0.0, 2)
    other = make_ctx(baseline="tuesday")
    other.inputs["n"] = {"number": 4}
    assert kinds(handler("compare").run(other)) == ["baseline"]


def test_compare_needs_two(make_ctx: Make, handler: Load, picture: Draw) -> None:
    """Nothing, or one thing without a baseline, is refused with what to do."""
    ctx = make_ctx()
    with pytest.raises(ctx.Fail, match="nothing to compare"):
        handler("compare").run(ctx)
    with_picture(ctx, picture(RED))
    with pytest.raises(ctx.Fail, match="one thing only"):
        handler("compare").run(ctx)


@pytest.fixture
def scenes(tmp_path: Path, picture: Draw) -> Path:
    """Two data sets of pictures with poses."""
    root = tmp_path / "folders" / "scenes"
    for name, things in (("hall", (RED, BLUE)), ("yard", (GREEN,))):
        (root / name).mkdir(parents=True)
        rows = ["file,x,y,heading_deg"]
        for number, thing in enumerate(things):
            (root / name / f"{number}.png").write_bytes(picture((thing[0], (40 + 120 * number, 100, 100, 90))))
            rows.append(f"{number}.png,{number + 1}.5,2,90")
        (root / name / "poses.csv").write_text("\n".join(rows))
    return root


def test_match_scene_finds_the_picture_and_its_pose(make_ctx: Make, handler: Load, picture: Draw, scenes: Path) -> None:
    """Also when the robot looks a little to the side; a scene that nobody has taken fails."""
    assert scenes.is_dir()
    ctx = make_ctx(datasets=["Hall", "yard"])
    with_picture(ctx, picture((BLUE[0], (166, 100, 100, 90))))
    result = handler("match_scene").run(ctx)
    assert (result["dataset"], result["file"], result["compared"]) == ("hall", "1.png", 3)
    assert result["pose"] == {"x": 2.5, "y": 2.0, "heading_deg": 90.0}
    with_picture(
        ctx, picture(*[("#ffffff", (column, row, 8, 8)) for column in range(0, 320, 16) for row in range(0, 240, 16)])
    )
    with pytest.raises(ctx.Fail, match="none of 3 pictures"):
        handler("match_scene").run(ctx)


@pytest.mark.parametrize(
    ("line", "why"),
    [
        ("9.png,1,2,3", "there is no 9.png"),
        ("../0.png,1,2,3", "not a picture"),
        ("0.png,east,2,3", "line 4"),
        ("0.png,nan,2,3", "line 4"),
    ],
)
def test_a_broken_list_of_poses_is_named(
    make_ctx: Make, handler: Load, picture: Draw, scenes: Path, line: str, why: str
) -> None:
    """File and line; no file outside of the data set is opened."""
    with (scenes / "hall" / "poses.csv").open("a") as lines:
        lines.write(f"\n{line}\n")
    ctx = make_ctx(datasets=["hall"])
    with_picture(ctx, picture(RED))
    with pytest.raises(ctx.Fail, match=why):
        handler("match_scene").run(ctx)


def test_an_unknown_data_set_names_those_that_are_here(make_ctx: Make, handler: Load, scenes: Path) -> None:
    """And how one is made."""
    assert scenes.is_dir()
    ctx = make_ctx(datasets=["hall", "moon"])
    with pytest.raises(ctx.Fail) as refused:
        handler("match_scene").run(ctx)
    assert "hall, yard" in refused.value.remedy
