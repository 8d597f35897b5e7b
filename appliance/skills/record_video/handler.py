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
    saved = ctx.resume or {}
    count, kept = int(saved.get("frames", 0)), [dict(each) for each in params.rows(saved.get("pieces"))]
    begin = int(saved.get("next", 0))
    for each in kept:
        (ctx.scratch / str(each["name"])).write_bytes(ctx.get_artifact(each))
    for piece in range(begin, pieces):
        seconds = min(PIECE_S, lasting - piece * PIECE_S)
        ctx.progress(0.9 * piece / pieces, f"recording {target}: {piece * PIECE_S:g} of {lasting:g} s")
        answer = ctx.command("record", timeout_s=60 + seconds, target=target, duration_s=seconds, fps=FPS)
        count += _encode(ctx, piece, answer.get("blobs") or {})
        if piece + 1 < pieces and ctx.checkpoint_due():
            kept += _keep(ctx, {str(each["name"]) for each in kept})
            ctx.checkpoint({"frames": count, "pieces": kept, "next": piece + 1})
    if count == 0:
        raise ctx.Fail(f"{ctx.robot} recorded no frame of {target}", "look at its camera", retryable=True)
    ctx.progress(0.95, f"joining {count} frames")
    _join(ctx)
    data = (ctx.scratch / "video.mp4").read_bytes()
    video = ctx.put_artifact(f"{params.slug(target)}.mp4", data, "video/mp4")
    ctx.progress(1.0, f"{count} frames, {len(data):,} bytes")
    return {"video": video, "target": target, "duration_s": lasting, "fps": FPS, "frames_recorded": count}


def _encode(ctx: Context, piece: int, blobs: dict[str, bytes]) -> int:
    """Encode the frames of one piece, so that they need not wait in memory for the others; return their number."""
    if not blobs:
        return 0
    frames = [ctx.scratch / f"frame-{number:03d}.jpg" for number in range(len(blobs))]
    for file, name in zip(frames, sorted(blobs), strict=True):
        file.write_bytes(blobs[name])
    # H.264 wants even sides; every player takes yuv420p.
    picture = ["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p"]
    coder = ["-c:v", "libx264", "-preset", "veryfast", "-threads", "1"]
    source = ["-framerate", f"{FPS:g}", "-i", "frame-%03d.jpg"]
    ffmpeg(ctx, [*source, *picture, *coder, f"piece-{piece:03d}.mp4"], what="encoding the video")
    for file in frames:
        file.unlink()
    return len(frames)


def _keep(ctx: Context, known: set[str]) -> list[dict[str, Any]]:
    """Keep the pieces that are not kept yet, for an attempt on another gateway; return references to them."""
    new = sorted(each for each in ctx.scratch.glob("piece-*.mp4") if each.name not in known)
    return [ctx.put_artifact(each.name, each.read_bytes(), "video/mp4") for each in new]


def _join(ctx: Context) -> None:
    """Put the pieces into one file, index first, without encoding them again."""
    pieces = sorted(each.name for each in ctx.scratch.glob("piece-*.mp4"))
    (ctx.scratch / "pieces.txt").write_text("".join(f"file '{name}'\n" for name in pieces), encoding="ascii")
    joined = ["-f", "concat", "-i", "pieces.txt", "-c", "copy", "-movflags", "+faststart", "video.mp4"]
    ffmpeg(ctx, joined, what="joining the video")
