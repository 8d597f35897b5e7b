# pyright: basic, reportMissingImports=false
# PyAV and soundfile are in image `learn` only.
"""Decodes videos and recordings, with PyAV (FFmpeg's libraries) and soundfile (libsndfile).

Both are imported when they are first needed: a reader of lists of files does without.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .sounds import RATE


class CorruptFileError(ValueError):
    """A file cannot be decoded."""


def pictures(path: Path, *, side: int, most: int) -> list[NDArray[np.uint8]]:
    """Return a video's pictures, grey and square; CorruptFileError where it does not end as its header says.

    Args:
        path: the video.
        side: height and width of the pictures, whatever the video's are.
        most: pictures that are read at most.
    """
    import av  # noqa: PLC0415 - in image `learn` only

    # Damage raises exceptions; each picture would warn of how its colours are written.
    av.logging.set_level(av.logging.FATAL)
    found: list[NDArray[np.uint8]] = []
    announced = 0
    try:
        # What a data set has under the name of a video is an AVI file, and opens nothing else.
        with av.open(str(path), format="avi", options={"protocol_whitelist": "file"}) as container:
            stream = container.streams.video[0]
            stream.thread_type = "NONE"
            announced = int(stream.frames)
            for frame in container.decode(stream):
                found.append(frame.reformat(width=side, height=side, format="gray").to_ndarray())
                if len(found) == most:
                    break
    except (av.AVError, IndexError, ValueError, OSError) as error:
        raise CorruptFileError(f"cannot be decoded: {error}"[:200]) from error
    if not found or len(found) < 0.9 * min(announced, most):
        raise CorruptFileError(f"{len(found)} of {announced} pictures can be decoded")
    return found


def sound(path: Path) -> NDArray[np.float32]:
    """Return a recording of 16 kHz and one channel; CorruptFileError where it is anything else, or ends early."""
    import soundfile  # noqa: PLC0415 - in image `learn` only

    try:
        with soundfile.SoundFile(str(path)) as file:
            rate, channels, announced = int(file.samplerate), int(file.channels), int(file.frames)
            wave: NDArray[np.float32] = file.read(dtype="float32", always_2d=False)
    except (soundfile.LibsndfileError, RuntimeError, OSError) as error:
        raise CorruptFileError(f"cannot be decoded: {error}"[:200]) from error
    if rate != RATE or channels != 1:
        raise CorruptFileError(f"{rate:,} Hz and {channels} channels, not {RATE:,} Hz and one")
    if len(wave) < announced or not len(wave):
        raise CorruptFileError(f"{len(wave)} of {announced} samples can be decoded")
    return wave
