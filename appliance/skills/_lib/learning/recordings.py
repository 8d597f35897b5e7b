"""Recordings among what was handed on, or in the gateway's folder of data, in whatever format, as waves of 16 kHz."""

from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from _lib import pictures
from _lib.context import Context
from _lib.video import ffmpeg, opened
from numpy.typing import NDArray

from .sounds import RATE
from .work import FOLDER

AUDIO = "audio"
"""Folder of recordings in the gateway's folder of data."""
LONGEST_S = 1200
"""What is looked at of a recording: 20 minutes."""


def given(ctx: Context, source: str) -> list[pictures.Reference]:
    """Return the recordings handed on: that of a name, or all; ctx.CallError where there is none of that name."""
    found = list(pictures.references(ctx.inputs, "audio/"))
    if not source:
        return found
    named = [each for each in found if str(each.get("name", "")).lower() == source.lower()]
    if not named and found:
        have = ", ".join(str(each.get("name", "")) for each in found)
        raise ctx.CallError(
            "not-found", f"there is no recording {source!r} among what was handed on ({have})", "name one of them"
        )
    return named


def in_folder(ctx: Context, source: str) -> Path:
    """Return a recording in the gateway's folder; ctx.CallError where there is none, or its name leads elsewhere."""
    parts = PurePosixPath(source).parts
    folder = ctx.host_folder(FOLDER) / AUDIO
    path = folder.joinpath(*parts) if parts and ".." not in parts and parts[0] != "/" else None
    if path is None or not path.is_file():
        raise ctx.CallError(
            "not-found",
            f"no recording was handed on, and there is no {source!r} in the gateway's folder {AUDIO}",
            f"record sound in a subtask before this one, or put the file into {AUDIO} of pool.folders.{FOLDER}",
        )
    return path


def wave(ctx: Context, data: bytes | Path, name: str) -> NDArray[np.float32]:
    """Return a recording in any format that ffmpeg reads as one channel of 16 kHz; ctx.Fail where it is none."""
    source = ctx.scratch / "recording"
    if isinstance(data, Path):
        source = data
    else:
        source.write_bytes(data)
    what = [*opened(source), "-vn", "-ac", "1", "-ar", str(RATE), "-t", str(LONGEST_S), "-f", "f32le", "recording.raw"]
    ffmpeg(ctx, what, what=f"decoding {name}")
    raw = ctx.scratch / "recording.raw"
    samples = np.fromfile(raw, dtype="<f4")
    raw.unlink()
    if not len(samples):
        raise ctx.Fail(f"{name} holds no sound", "record it again")
    return np.nan_to_num(samples, nan=0.0, posinf=0.0, neginf=0.0).clip(-1.0, 1.0)


def keep(ctx: Context, samples: NDArray[np.float32], name: str) -> dict[str, Any]:
    """Keep a wave as FLAC."""
    import io  # noqa: PLC0415 - with soundfile

    import soundfile  # pyright: ignore[reportMissingImports]  # noqa: PLC0415 - in image `learn` only

    out = io.BytesIO()
    soundfile.write(out, samples, RATE, format="FLAC", subtype="PCM_16")  # pyright: ignore[reportUnknownMemberType]
    return ctx.put_artifact(name, out.getvalue(), "audio/flac")
