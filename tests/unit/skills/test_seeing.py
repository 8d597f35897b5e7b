"""Handlers that look: pictures are drawn by the tests and found by colour."""

import io
from collections.abc import Callable
from types import ModuleType
from typing import Any

import pytest
from PIL import Image

Make = Callable[..., Any]
Load = Callable[..., ModuleType]
Draw = Callable[..., bytes]

RED = ("#dc1e1e", (40, 150, 30, 30))
RED_2 = ("#c81414", (90, 150, 30, 30))
BLUE = ("#1e3cdc", (150, 150, 40, 30))
GREEN = ("#1ea03c", (10, 190, 30, 40))
YELLOW = ("#f0c814", (200, 160, 50, 20))
ORANGE = ("#ff8c00", (260, 180, 20, 40))


def with_picture(ctx: Any, data: bytes, *, subtask: str = "s1") -> None:
    """Hand a picture on as photograph does."""
    reference = ctx.put_artifact("shelf-1.png", data, "image/png")
    ctx.inputs[subtask] = {"skill": "photograph", "image": reference, "images": [reference], "target": "shelf"}


def test_photograph_keeps_each_picture(make_ctx: Make, handler: Load) -> None:
    """Three pictures are three commands, three files and three steps of progress."""
    ctx = make_ctx(target="the Red Box", count=3)
    result = handler("photograph").run(ctx)
    assert result["image"] == result["images"][0]
    assert [each["name"] for each in result["images"]] == [f"the-red-box-{number}.png" for number in (1, 2, 3)]
    assert ctx.files[result["image"]["artifact"]] == ctx.picture
    assert ctx.sent("capture") == [{"target": "the Red Box"}] * 3
    assert [round(fraction, 2) for fraction, _ in ctx.steps] == [0.33, 0.67, 1.0]
    assert result["camera"] == {"width": 320}


@pytest.mark.parametrize("count", [0, 11, 1.5, "two", True])
def test_photograph_refuses_an_odd_count(make_ctx: Make, handler: Load, count: Any) -> None:
    """A number of pictures that cannot be is refused before the first is taken."""
    ctx = make_ctx(target="shelf", count=count)
    with pytest.raises(ctx.Fail, match="count is"):
        handler("photograph").run(ctx)
    assert ctx.commands == []


def test_a_camera_that_sends_nothing_may_be_asked_again(make_ctx: Make, handler: Load) -> None:
    """An answer without picture is a failure that another attempt may cure."""
    ctx = make_ctx(target="shelf")
    ctx.answers["capture"] = lambda _: {"blobs": {}}
    with pytest.raises(ctx.Fail, match="no picture") as caught:
        handler("photograph").run(ctx)
    assert caught.value.retryable


def test_detect_finds_the_colour_that_is_named(make_ctx: Make, handler: Load, picture: Draw) -> None:
    """Among many coloured things, `red box` is the red one, with its box to the pixel, and a marked picture."""
    ctx = make_ctx(target="red box")
    with_picture(ctx, picture(RED, BLUE, GREEN, YELLOW, ORANGE))
    result = handler("detect").run(ctx)
    (row,) = result["detections"]
    assert (row["label"], row["colour"], row["box"], row["area"]) == ("red box", "red", [40, 150, 30, 30], 900)
    assert 0.5 < row["confidence"] <= 1.0
    assert row["image"] == ctx.inputs["s1"]["image"]["artifact"]
    assert result["count"] == 1
    marked = Image.open(io.BytesIO(ctx.files[result["annotated"][0]["artifact"]]))
    assert marked.size == (320, 240)
    assert ctx.commands == [], "the picture was handed on: none is taken"


@pytest.mark.parametrize(
    ("target", "colours"),
    [
        ("blue box", ["blue"]),
        ("green crates", ["green"]),
        ("yellow pallet", ["yellow"]),
        ("orange cone", ["orange"]),
        ("red or blue boxes", ["blue", "red"]),
        ("crate", ["green"]),
        ("boxes", ["blue", "red"]),
        ("gold pallet", ["yellow"]),
        ("objects", ["yellow", "blue", "green", "red", "orange"]),
        ("grey shelf", ["grey"]),
        ("purple box", []),
    ],
)
def test_words_choose_colours(make_ctx: Make, handler: Load, picture: Draw, target: str, colours: list[str]) -> None:
    """Colour words decide; without one, the site's objects of that name do; `objects` are all that stand out."""
    ctx = make_ctx(target=target)
    ctx.site["objects"] = ctx.site["objects"][:3]
    with_picture(ctx, picture(RED, BLUE, GREEN, YELLOW, ORANGE))
    result = handler("detect").run(ctx)
    assert sorted(row["colour"] for row in result["detections"]) == sorted(colours)
    assert "note" not in result


def test_detect_says_when_it_can_only_guess(make_ctx: Make, handler: Load, picture: Draw) -> None:
    """A target without colour lists all coloured things, labelled by colour, and says so."""
    ctx = make_ctx(target="damaged cartons")
    with_picture(ctx, picture(RED, BLUE))
    result = handler("detect").run(ctx)
    assert [row["label"] for row in result["detections"]] == ["blue object", "red object"]
    assert "every coloured thing is listed" in result["note"]


def test_a_blue_sky_is_no_thing(make_ctx: Make, handler: Load, picture: Draw) -> None:
    """A strongly blue sky across the top is left out, a blue box below it is found."""
    ctx = make_ctx(target="blue box")
    with_picture(ctx, picture(("#2878ff", (0, 0, 320, 96)), BLUE))
    assert [row["box"] for row in handler("detect").run(ctx)["detections"]] == [[150, 150, 40, 30]]


def test_large_pictures_give_boxes_of_the_picture(make_ctx: Make, handler: Load, picture: Draw) -> None:
    """A picture that is looked at smaller still gives boxes and areas in its own pixels."""
    ctx = make_ctx(target="red box")
    with_picture(ctx, picture(("#dc1e1e", (400, 500, 120, 80)), size=(1280, 960)))
    (row,) = handler("detect").run(ctx)["detections"]
    assert row["box"] == pytest.approx([400, 500, 120, 80], abs=3)
    assert row["area"] == pytest.approx(120 * 80, rel=0.06)


def test_shapes_are_whole_and_apart(make_ctx: Make, handler: Load, picture: Draw) -> None:
    """A ring is one thing, touching corners join, a pixel's gap does not, and specks are left out."""
    ctx = make_ctx(target="red things")
    ring = [("#dc1e1e", box) for box in ((20, 120, 60, 8), (20, 172, 60, 8), (20, 120, 8, 60), (72, 120, 8, 60))]
    corner = [("#dc1e1e", (120, 120, 20, 20)), ("#dc1e1e", (140, 140, 20, 20))]
    apart = [("#dc1e1e", (200, 120, 20, 20)), ("#dc1e1e", (221, 120, 20, 20))]
    with_picture(ctx, picture(*ring, *corner, *apart, ("#dc1e1e", (300, 230, 3, 3))))
    boxes = sorted(row["box"] for row in handler("detect").run(ctx)["detections"])
    assert boxes == [[20, 120, 60, 60], [120, 120, 40, 40], [200, 120, 20, 20], [221, 120, 20, 20]]


def test_detect_takes_a_picture_where_none_is_handed_on(make_ctx: Make, handler: Load, picture: Draw) -> None:
    """Without pictures the robot takes one; with `area` it goes there first."""
    ctx = make_ctx(target="red box")
    ctx.picture = picture(RED)
    result = handler("detect").run(ctx)
    assert (result["count"], [verb for verb, _ in ctx.commands]) == (1, ["capture"])
    assert ctx.files[result["images"][0]["artifact"]] == ctx.picture
    ctx = make_ctx(target="red box", area="dock 3")
    handler("detect").run(ctx)
    assert [verb for verb, _ in ctx.commands] == ["state", "goto", "capture"]


def test_detect_needs_a_picture_or_a_robot(make_ctx: Make, handler: Load) -> None:
    """With neither picture nor robot it says what is missing."""
    ctx = make_ctx(target="red box")
    ctx.robot = None
    with pytest.raises(ctx.Fail, match="no picture") as caught:
        handler("detect").run(ctx)
    assert "photograph" in caught.value.remedy


@pytest.mark.parametrize("data", [b"", b"no picture", b"\x89PNG\r\n\x1a\n" + b"\0" * 64, "cut"])
def test_a_broken_picture_is_named(make_ctx: Make, handler: Load, picture: Draw, data: bytes | str) -> None:
    """Bytes that are no picture, or half of one, are refused with the file's name."""
    ctx = make_ctx(target="red box")
    with_picture(ctx, picture(RED)[:200] if isinstance(data, str) else data)
    with pytest.raises(ctx.Fail, match=r"shelf-1\.png is no picture"):
        handler("detect").run(ctx)


def test_an_enormous_picture_is_refused(make_ctx: Make, handler: Load) -> None:
    """A picture of more pixels than memory allows is refused by its header alone."""
    ctx = make_ctx(target="red box")
    out = io.BytesIO()
    Image.new("1", (9000, 9000)).save(out, "PNG")
    with_picture(ctx, out.getvalue())
    with pytest.raises(ctx.Fail, match="9000 x 9000"):
        handler("detect").run(ctx)


def test_count_goes_by_what_was_detected(make_ctx: Make, handler: Load) -> None:
    """Detections of one place in several pictures count once, those of several places add up, others do not count."""
    rows = [{"colour": "red", "image": "a"}, {"colour": "red", "image": "a"}, {"colour": "blue", "image": "a"}]
    ctx = make_ctx(target="red boxes")
    ctx.inputs = {
        "s1": {"skill": "detect", "detections": [*rows, {"colour": "red", "image": "b"}]},
        "s2": {"skill": "detect", "detections": [{"colour": "red", "image": "c"}]},
        "s3": {"skill": "goto", "place": "home"},
    }
    assert handler("count").run(ctx) == {"number": 3, "target": "red boxes", "counted_in": ["s1", "s2"]}
    assert ctx.commands == []


def test_count_looks_for_itself(make_ctx: Make, handler: Load, picture: Draw) -> None:
    """Without detections it looks at the pictures handed on, or takes one."""
    ctx = make_ctx(target="red boxes")
    with_picture(ctx, picture(RED, RED_2, BLUE))
    assert handler("count").run(ctx)["number"] == 2
    ctx = make_ctx(target="boxes")
    ctx.picture = picture(RED, BLUE)
    assert handler("count").run(ctx)["number"] == 2


@pytest.mark.parametrize("skill", ["count", "find", "track"])
def test_what_colour_cannot_tell_is_refused(make_ctx: Make, handler: Load, skill: str) -> None:
    """Sheep cannot be told from other things by colour: no number and no sighting is made up."""
    ctx = make_ctx(target="sheep")
    with pytest.raises(ctx.Fail) as caught:
        handler(skill).run(ctx)
    assert "colour" in caught.value.remedy
    assert ctx.commands == []


def test_find_looks_from_several_points_until_it_sees(make_ctx: Make, handler: Load, picture: Draw) -> None:
    """The third view shows the box: two moves, three pictures, one kept."""
    ctx = make_ctx(target="red box", area="aisle")
    views = iter([picture(), picture(BLUE), picture(RED)])
    ctx.answers["capture"] = lambda _: {"blobs": {"image.png": next(views)}}
    result = handler("find").run(ctx)
    assert (result["found"], result["views"], result["count"]) == (True, 3, 1)
    assert len(ctx.sent("goto")) == 3, "to the area, and to two views"
    assert ctx.files[result["image"]["artifact"]] == picture(RED)


def test_find_gives_up_with_a_reason(make_ctx: Make, handler: Load) -> None:
    """What is seen from no point is a failure that says how often was looked; closed points are left out."""
    ctx = make_ctx(target="red box")
    ctx.info["pose"] = {"x": 18.0, "y": 7.0}
    with pytest.raises(ctx.Fail, match="was not seen from 4 points"):
        handler("find").run(ctx)
    assert len(ctx.sent("capture")) == 4, "the point to the north is in the rack"
    verbs = [verb for verb, _ in ctx.commands]
    view = ["state", "goto", "capture"]
    assert verbs == ["state", "capture", "state", "state", "state", *view, *view, *view], "numbers are kept"


def test_track_follows_and_counts_losses(make_ctx: Make, handler: Load, picture: Draw) -> None:
    """Each view gives the box at its time; one without the thing counts as lost."""
    ctx = make_ctx(target="red box", duration_s=1, window_ms=250)
    views = iter([picture(RED), picture(), picture(RED_2), picture(RED_2)])
    ctx.answers["capture"] = lambda _: {"blobs": {"image.png": next(views)}}
    result = handler("track").run(ctx)
    assert [each["box"] and each["box"][0] for each in result["track"]] == [40, None, 90, 90]
    assert (result["lost"], result["count"]) == (1, 1)


def test_track_of_nothing_fails(make_ctx: Make, handler: Load) -> None:
    """A thing that no view shows was not tracked."""
    ctx = make_ctx(target="red box", duration_s=1, window_ms=500)
    with pytest.raises(ctx.Fail, match="never seen in 2 views"):
        handler("track").run(ctx)
