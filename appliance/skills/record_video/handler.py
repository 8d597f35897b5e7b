"""record_video: record a target and keep it as an MP4."""

from typing import Any

from _lib import params
from _lib.context import Context
from _lib.video import ffmpeg

USUAL_S = 5.0
MAX_S = 600.0
FPS = 5.0
PIECE_S = 10.0
"""Recorded at a time: 50 pictures fit one message, and a failure costs ten seconds, not the whole video."""


def run(ctx: Context) -> dict[str, Any]:
    """Return video (a reference), target, duration_s, fps and frames_recorded."""
    target = params.text(ctx, "target")
    lasting = params.number(ctx, "duration_s", default=USUAL_S, low=0.2, high=MAX_S)
    pieces = max(1, -int(-lasting // PIECE_S))
    count = 0
    for piece in range(pieces):
        seconds = min(PIECE_S, lasting - piece * PIECE_S)
        ctx.progress(0.9 * piece / pieces, f"recording {target}: {piece * PIECE_S:g} of {lasting:g} s")
        answer = ctx.command("record", timeout_s=60 + seconds, target=target, duration_s=seconds, fps=FPS)
        blobs: dict[str, bytes] = answer.get("blobs") or {}
        for name in sorted(blobs):
            (ctx.scratch / f"frame-{count:05d}.jpg").write_bytes(blobs[name])
            count += 1
    if count == 0:
        raise ctx.Fail(f"{ctx.robot} recorded no frame of {target}", "look at its camera", retryable=True)
    ctx.progress(0.9, f"encoding {count} frames")
    # H.264 wants even sides; every player takes yuv420p.
    even = "pad=ceil(iw/2)*2:ceil(ih/2)*2"
    picture = ["-vf", even, "-pix_fmt", "yuv420p", "-c:v", "libx264", "-preset", "veryfast", "-threads", "1"]
    source = ["-framerate", f"{FPS:g}", "-i", "frame-%05d.jpg"]
    ffmpeg(ctx, [*source, *picture, "-movflags", "+faststart", "video.mp4"], what="encoding the video")
    data = (ctx.scratch / "video.mp4").read_bytes()
    video = ctx.put_artifact(f"{params.slug(target)}.mp4", data, "video/mp4")
    ctx.progress(1.0, f"{count} frames, {len(data):,} bytes")
    return {"video": video, "target": target, "duration_s": lasting, "fps": FPS, "frames_recorded": count}
