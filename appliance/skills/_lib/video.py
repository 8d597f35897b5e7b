"""Runs ffmpeg, which image `vision` has, with its errors turned into words.

What comes from elsewhere is opened as a file of a known format and as nothing else: a playlist or a description of a
session that is handed on as a video would have ffmpeg open what it names.
"""

import subprocess
from collections.abc import Sequence
from pathlib import Path

from .context import Context

FORMATS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts,mpeg,flv,asf,ogg,wav,w64,flac,mp3,aac,aiff,au,caf,amr,ac3"
"""Formats of videos and recordings that are read, as ffmpeg names them; none of them refers to other files."""


def opened(path: str | Path) -> list[str | Path]:
    """Return the arguments with which ffmpeg reads a file that comes from elsewhere."""
    return ["-protocol_whitelist", "file", "-format_whitelist", FORMATS, "-i", path]


def ffmpeg(ctx: Context, arguments: Sequence[str | Path], *, what: str, timeout_s: float = 240.0) -> None:
    """Run ffmpeg in the run's scratch folder; ctx.Fail with its last words when it does not end well."""
    # One thread: the container's process limit and the other containers' cores are shared.
    command = ["ffmpeg", "-hide_banner", "-nostdin", "-loglevel", "error", "-y", "-threads", "1", *map(str, arguments)]
    try:
        done = subprocess.run(command, cwd=ctx.scratch, capture_output=True, timeout=timeout_s, check=False)
    except FileNotFoundError as error:
        raise ctx.Fail("there is no ffmpeg in this image", "run this skill in image 'vision'") from error
    except subprocess.TimeoutExpired as error:
        raise ctx.Fail(f"{what} took longer than {timeout_s:g} s", "make it shorter", retryable=True) from error
    if done.returncode != 0:
        words = done.stderr.decode("utf-8", "replace").strip().splitlines()
        told = " / ".join(words[-3:])[:500] or f"ffmpeg ended with {done.returncode}"
        raise ctx.Fail(f"{what} failed: {told}", "look whether what it was made from is whole")
