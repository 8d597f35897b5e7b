"""Recording and sampling video, with a stand-in for the ffmpeg program; the real one is in the vision image."""

import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

Make = Callable[..., Any]
Load = Callable[..., ModuleType]

PROGRAM = """#!{python}
import json, pathlib, sys
arguments = sys.argv[1:]
here = pathlib.Path()
with open({log!r}, "a") as log:
    log.write(json.dumps(arguments) + "\\n")
if {broken}:
    sys.exit("moov atom not found\\nInvalid data found when processing input")
target = arguments[-1]
if "%" in target:
    assert (here / "video").read_bytes()
    for number in range(min({frames}, int(arguments[arguments.index("-frames:v") + 1]))):
        (here / (target % (number + 1))).write_bytes(b"frame %d" % number)
else:
    made = b"".join(each.read_bytes() for each in sorted(here.glob("piece-*.mp4"))) if target == "video.mp4" else b""
    (here / target).write_bytes(made or b"%d frames;" % len(list(here.glob("frame-*.jpg"))))
"""


@pytest.fixture
def ffmpeg(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Callable[[], list[list[str]]]]:
    """Return a function that puts a stand-in on PATH; what that returns gives the calls made."""

    def install(*, frames: int = 3, broken: bool = False) -> Callable[[], list[list[str]]]:
        folder = tmp_path / "bin"
        folder.mkdir()
        log = folder / "log"
        log.touch()
        text = PROGRAM.format(python=sys.executable, log=str(log), broken=broken, frames=frames)
        (folder / "ffmpeg").write_text(text)
        (folder / "ffmpeg").chmod(0o755)
        monkeypatch.setenv("PATH", f"{folder}{os.pathsep}{os.environ['PATH']}")
        return lambda: [json.loads(line) for line in log.read_text().splitlines()]

    return install


def with_video(ctx: Any, name: str = "aisle.mp4") -> None:
    """Hand a video on as record_video does."""
    ctx.inputs[f"s{len(ctx.inputs) + 1}"] = {
        "skill": "record_video",
        "video": ctx.put_artifact(name, f"bytes of {name}".encode(), "video/mp4"),
    }


def test_a_recording_becomes_one_video(make_ctx: Make, handler: Load, ffmpeg: Callable[..., Any]) -> None:
    """Twelve seconds are recorded and encoded in two pieces, which are joined into one MP4."""
    calls = ffmpeg()
    ctx = make_ctx(target="the aisle", duration_s=12)
    result = handler("record_video").run(ctx)
    assert [args["duration_s"] for args in ctx.sent("record")] == [10.0, 2.0]
    assert result["frames_recorded"] == 60
    assert ctx.files[result["video"]["artifact"]] == b"50 frames;10 frames;"
    assert (result["video"]["name"], result["video"]["media_type"]) == ("the-aisle.mp4", "video/mp4")
    first, second, joined = calls()
    assert first[first.index("-framerate") + 1] == "5"
    assert "yuv420p" in second
    assert joined[joined.index("-c") + 1] == "copy"
    assert not list(ctx.scratch.glob("frame-*.jpg")), "frames do not pile up in the container's memory"


def test_a_recording_is_short_unless_asked(make_ctx: Make, handler: Load, ffmpeg: Callable[..., Any]) -> None:
    """Without a duration it is five seconds."""
    ffmpeg()
    ctx = make_ctx(target="aisle")
    assert handler("record_video").run(ctx)["duration_s"] == 5.0
    assert ctx.sent("record") == [{"target": "aisle", "duration_s": 5.0, "fps": 5.0}]


@pytest.mark.parametrize("seconds", [0, -3, 601, "long"])
def test_an_absurd_duration_is_refused(make_ctx: Make, handler: Load, seconds: Any) -> None:
    """A duration that cannot be is refused before recording."""
    ctx = make_ctx(target="aisle", duration_s=seconds)
    with pytest.raises(ctx.Fail, match="duration_s is"):
        handler("record_video").run(ctx)
    assert ctx.commands == []


def test_no_frames_is_a_failure(make_ctx: Make, handler: Load) -> None:
    """A camera that records nothing is a failure that another attempt may cure."""
    ctx = make_ctx(target="aisle")

    def nothing(_: object) -> dict[str, Any]:
        return {}

    ctx.answers["record"] = nothing
    with pytest.raises(ctx.Fail, match="no frame") as caught:
        handler("record_video").run(ctx)
    assert caught.value.retryable


def test_ffmpeg_s_words_are_passed_on(make_ctx: Make, handler: Load, ffmpeg: Callable[..., Any]) -> None:
    """What ffmpeg complains of is the failure's message."""
    ffmpeg(broken=True)
    ctx = make_ctx(target="aisle")
    with pytest.raises(ctx.Fail, match="encoding the video failed: moov atom not found / Invalid data"):
        handler("record_video").run(ctx)


def test_an_image_without_ffmpeg_is_told(
    make_ctx: Make, handler: Load, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Where the program is missing, the failure names the image that has it."""
    monkeypatch.setenv("PATH", str(tmp_path))
    ctx = make_ctx(target="aisle")
    with pytest.raises(ctx.Fail, match="no ffmpeg") as caught:
        handler("record_video").run(ctx)
    assert "vision" in caught.value.remedy


def test_frames_are_sampled_from_the_video(make_ctx: Make, handler: Load, ffmpeg: Callable[..., Any]) -> None:
    """The video is fetched, sampled at the rate asked for, and each frame kept under the video's name."""
    calls = ffmpeg(frames=3)
    ctx = make_ctx(fps=15)
    with_video(ctx)
    result = handler("extract_frames").run(ctx)
    assert [each["name"] for each in result["frames"]] == [f"aisle-00{number}.jpg" for number in (1, 2, 3)]
    assert ctx.files[result["frames"][1]["artifact"]] == b"frame 1"
    assert (result["count"], result["source"]) == (3, "aisle.mp4")
    assert "fps=15" in calls()[0]
    assert "note" not in result


def test_a_video_is_opened_as_a_file_of_a_known_format_only(
    make_ctx: Make, handler: Load, ffmpeg: Callable[..., Any]
) -> None:
    """A playlist handed on as a video would have ffmpeg open what it names: neither format nor protocol is let in."""
    calls = ffmpeg(frames=1)
    ctx = make_ctx()
    with_video(ctx)
    handler("extract_frames").run(ctx)
    (call,) = calls()
    before = call[: call.index("-i")]
    assert before[before.index("-protocol_whitelist") + 1] == "file"
    formats = before[before.index("-format_whitelist") + 1].split(",")
    assert {"mov", "avi", "wav", "flac"} <= set(formats)
    assert not {"hls", "dash", "concat", "sdp", "image2", "lavfi", "rtsp"} & set(formats)


def test_the_number_of_frames_is_bounded(make_ctx: Make, handler: Load, ffmpeg: Callable[..., Any]) -> None:
    """Of a long video sixty frames are kept, and the result says that there were more."""
    ffmpeg(frames=500)
    ctx = make_ctx()
    with_video(ctx)
    result = handler("extract_frames").run(ctx)
    assert result["count"] == 60
    assert "lower fps" in result["note"]


def test_the_source_chooses_the_video(make_ctx: Make, handler: Load, ffmpeg: Callable[..., Any]) -> None:
    """A named video is taken, by its file name or by what it shows; without a name the last is."""
    ffmpeg()
    for source, name in (("ramp.mp4", "ramp.mp4"), ("Ramp", "ramp.mp4"), (None, "dock.mp4")):
        ctx = make_ctx(**({"source": source} if source else {}))
        for each in ("ramp.mp4", "dock.mp4"):
            with_video(ctx, each)
        assert handler("extract_frames").run(ctx)["source"] == name
        for stale in ctx.scratch.glob("extracted-*"):
            stale.unlink()


def test_a_missing_video_is_named(make_ctx: Make, handler: Load) -> None:
    """Without a video, or with another name, it says what was handed on."""
    ctx = make_ctx()
    with pytest.raises(ctx.Fail, match="no video was handed on"):
        handler("extract_frames").run(ctx)
    ctx = make_ctx(source="forklift_17.mp4")
    with_video(ctx)
    with pytest.raises(ctx.Fail, match=r"no video 'forklift_17.mp4' among what was handed on \(aisle.mp4\)"):
        handler("extract_frames").run(ctx)


@pytest.mark.parametrize("fps", [0, -1, 1000, "all"])
def test_an_absurd_rate_is_refused(make_ctx: Make, handler: Load, fps: Any) -> None:
    """A rate that cannot be is refused."""
    ctx = make_ctx(fps=fps)
    with_video(ctx)
    with pytest.raises(ctx.Fail, match="fps is"):
        handler("extract_frames").run(ctx)


def test_a_video_without_frames_is_a_failure(make_ctx: Make, handler: Load, ffmpeg: Callable[..., Any]) -> None:
    """A video from which nothing comes is not an empty success."""
    ffmpeg(frames=0)
    ctx = make_ctx()
    with_video(ctx)
    with pytest.raises(ctx.Fail, match=r"aisle\.mp4 has no frame"):
        handler("extract_frames").run(ctx)


def test_a_recording_takes_its_pieces_along(
    make_ctx: Make, handler: Load, leave: Callable[..., Any], ffmpeg: Callable[..., Any]
) -> None:
    """Pieces recorded elsewhere are fetched, the others recorded, and all are in the video."""
    ffmpeg()
    whole = make_ctx(target="aisle", duration_s=25)
    wanted = handler("record_video").run(whole)
    for each in whole.scratch.glob("*.mp4"):
        each.unlink()
    first, second = make_ctx(target="aisle", duration_s=25), make_ctx(target="aisle", duration_s=25)
    second.resume = leave(handler("record_video").run, first, 2)
    for each in whole.scratch.glob("*.mp4"):
        each.unlink()  # the scratch folder of the first attempt is gone
    second.files = first.files
    result = handler("record_video").run(second)
    assert len(first.sent("record")) == 2
    assert len(second.sent("record")) == 1
    assert result["frames_recorded"] == wanted["frames_recorded"]
    assert second.files[result["video"]["artifact"]] == whole.files[wanted["video"]["artifact"]]
