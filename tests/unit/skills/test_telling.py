"""Reports and notices: what the subtasks before have found, in words."""

from collections.abc import Callable
from types import ModuleType
from typing import Any

import pytest

Make = Callable[..., Any]
Load = Callable[..., ModuleType]


def with_inputs(ctx: Any) -> None:
    """Hand on what a small inspection gives."""
    image = ctx.put_artifact("shelf-1.png", b"picture", "image/png")
    marked = ctx.put_artifact("shelf-marked-1.png", b"marked", "image/png")
    row = {"label": "red box", "colour": "red", "box": [1, 2, 3, 4], "area": 12, "confidence": 0.93, "image": "x"}
    video = ctx.put_artifact("aisle.mp4", b"video", "video/mp4")
    ctx.inputs = {
        "s1": {"skill": "goto", "place": "dock 3", "path_m": 35.24, "pose": {"x": 36.0}, "waypoints": [{"x": 36.0}]},
        "s2": {"skill": "photograph", "image": image, "images": [image], "target": "shelf", "count": 1, "camera": {}},
        "s3": {"skill": "detect", "target": "red box", "detections": [row, row], "count": 2, "images": [image],
               "annotated": [marked]},
        "s4": {"skill": "count", "number": 2, "target": "red boxes"},
        "s5": {"skill": "record_video", "video": video, "target": "aisle", "duration_s": 5.0},
        "s6": {"skill": "scan_gas", "ppm": 12.5, "place of leak": "valve 3"},
        "s7": {"skill": "hold"},
    }  # fmt: skip


def test_a_report_tells_everything_found(make_ctx: Make, handler: Load) -> None:
    """Places, pictures, detections, numbers, videos and results of skills it does not know are all in it."""
    ctx = make_ctx(about="dock 3", to="line supervisor")
    with_inputs(ctx)
    result = handler("report").run(ctx)
    text = ctx.files[result["report"]["artifact"]].decode()
    picture = ctx.inputs["s2"]["image"]["artifact"]
    for part in (
        "# Report: dock 3",
        "For: line supervisor.",
        "## goto (s1)",
        "- reached dock 3 after 35.2 m",
        "- 1 picture of shelf",
        f"- ![shelf-1.png](artifact:{picture})",
        "- 2 detections of red box: 2 red box",
        "red box, confidence 0.93, box [1, 2, 3, 4]",
        "![shelf-marked-1.png](artifact:",
        "- counted 2 red boxes",
        "- video aisle.mp4 of aisle, 5 s",
        "- [aisle.mp4](artifact:",
        "- ppm: 12.5",
        "- place of leak: valve 3",
        "## hold (s7)\n\n- done",
    ):
        assert part in text, part
    assert result["text"] == text
    assert result["report"]["media_type"] == "text/markdown"


def test_a_report_tells_whom_it_is_for(make_ctx: Make, handler: Load) -> None:
    """With `to` the person gets the title and the summary; without, nobody gets a notice."""
    ctx = make_ctx(to="farmer")
    with_inputs(ctx)
    handler("report").run(ctx)
    ((to, text),) = ctx.notices
    assert to == "farmer"
    assert text.startswith("Report\ngoto (s1): reached dock 3")
    quiet = make_ctx()
    with_inputs(quiet)
    handler("report").run(quiet)
    assert quiet.notices == []


def test_a_report_of_nothing_says_so(make_ctx: Make, handler: Load) -> None:
    """Without inputs the report is short and honest."""
    ctx = make_ctx()
    assert "Nothing was handed on to report." in handler("report").run(ctx)["text"]


def test_a_long_report_is_whole_in_its_file(make_ctx: Make, handler: Load) -> None:
    """The result's text is cut to what fits a record, the file is not."""
    ctx = make_ctx()
    ctx.inputs = {f"s{number}": {"skill": "count", "number": number, "target": "red boxes"} for number in range(200)}
    result = handler("report").run(ctx)
    assert len(result["text"]) == 4000
    assert b"counted 199 red boxes" in ctx.files[result["report"]["artifact"]]
    assert len(result["summary"]) <= 2000


def test_odd_results_do_no_harm(make_ctx: Make, handler: Load) -> None:
    """Results of shapes that nobody promised are reported as far as they can be read."""
    ctx = make_ctx()
    deep: dict[str, Any] = {}
    for _ in range(50):
        deep = {"in": deep}
    ctx.inputs = {
        "s1": {"skill": "detect", "detections": ["no dict", None, {"label": "x"}]},
        "s2": {"detections": "none", "number": "many", "image": {"artifact": 3}, "path_m": "far", "place": "home"},
        "s3": deep,
        "s4": {"text": "x" * 5000, "video": [1, 2]},
    }
    text = handler("report").run(ctx)["text"]
    assert "reached home" in text
    assert len(text) < 2000


def test_a_notice_keeps_its_words(make_ctx: Make, handler: Load) -> None:
    """A text that is given is sent as it is."""
    ctx = make_ctx(to="medical tent", text="the stretcher has arrived")
    result = handler("notify").run(ctx)
    assert ctx.notices == [("medical tent", "the stretcher has arrived")]
    assert result == {"notice": "t1/s1/1", "to": "medical tent", "text": "the stretcher has arrived"}


def test_a_notice_without_words_tells_what_was_found(make_ctx: Make, handler: Load) -> None:
    """Without a text the notice sums up the inputs."""
    ctx = make_ctx(to="operator")
    with_inputs(ctx)
    handler("notify").run(ctx)
    assert "detect (s3): 2 detections of red box: 2 red box" in ctx.notices[0][1]
    empty = make_ctx(to="operator")
    handler("notify").run(empty)
    assert "nothing was handed on" in empty.notices[0][1]


def test_a_notice_needs_a_recipient(make_ctx: Make, handler: Load) -> None:
    """Without `to` nothing is sent."""
    ctx = make_ctx(text="hello")
    with pytest.raises(ctx.Fail, match="'to' is missing"):
        handler("notify").run(ctx)
    assert ctx.notices == []
