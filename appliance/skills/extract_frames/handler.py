"""extract_frames: sample still pictures from a video handed on."""

from typing import Any

from _lib import params, pictures
from _lib.context import Context
from _lib.video import ffmpeg, opened

USUAL_FPS = 1.0
MAX_FRAMES = 60
"""Of one video; the later ones are left out, and the result says so."""


def run(ctx: Context) -> dict[str, Any]:
    """Return frames (references), count, fps and the video's name."""
    fps = params.number(ctx, "fps", default=USUAL_FPS, low=0.01, high=60.0)
    video = _video(ctx, params.text(ctx, "source", default=""))
    name = str(video.get("name", "video"))
    ctx.progress(0.1, f"fetching {name}")
    (ctx.scratch / "video").write_bytes(ctx.get_artifact(video))
    ctx.progress(0.3, f"sampling {name} at {fps:g} frames a second")
    # One more than is kept, to know whether there were more.
    sampling = [*opened("video"), "-vf", f"fps={fps:g}", "-frames:v", str(MAX_FRAMES + 1), "-q:v", "3"]
    ffmpeg(ctx, [*sampling, "extracted-%04d.jpg"], what=f"decoding {name}")
    files = sorted(ctx.scratch.glob("extracted-*.jpg"))
    if not files:
        raise ctx.Fail(f"{name} has no frame", "record it again")
    frames: list[pictures.Reference] = []
    stem = params.slug(name.rsplit(".", 1)[0])
    for number, file in enumerate(files[:MAX_FRAMES], start=1):
        frames.append(ctx.put_artifact(f"{stem}-{number:03d}.jpg", file.read_bytes(), "image/jpeg"))
        ctx.progress(0.4 + 0.6 * number / min(len(files), MAX_FRAMES), f"frame {number}")
    result: dict[str, Any] = {"frames": frames, "count": len(frames), "fps": fps, "source": name}
    if len(files) > MAX_FRAMES:
        result["note"] = f"only the first {MAX_FRAMES} frames are kept: ask for a lower fps to span the whole video"
    return result


def _video(ctx: Context, source: str) -> pictures.Reference:
    videos = list(pictures.references(ctx.inputs, "video/"))
    if source:
        wanted = source.lower()
        named = [each for each in videos if str(each.get("name", "")).lower() in (wanted, f"{params.slug(wanted)}.mp4")]
        if not named:
            have = ", ".join(str(each.get("name", "")) for each in videos) or "none"
            raise ctx.CallError(
                "not-found",
                f"there is no video {source!r} among what was handed on ({have})",
                "record it in a subtask before this one",
            )
        return named[-1]
    if not videos:
        raise ctx.CallError("precondition", "no video was handed on", "record one in a subtask before this one")
    return videos[-1]
