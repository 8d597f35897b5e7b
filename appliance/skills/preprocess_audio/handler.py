"""preprocess_audio: a recording as one channel of 16 kHz, with less noise, cut at pauses."""

from typing import Any

import numpy as np
from _lib import params
from _lib.context import Context
from _lib.learning import recordings, sounds

MOST_SEGMENTS = 200
LONGEST = 30 * sounds.RATE
"""Samples of a segment: longer speech without a pause is cut."""


def run(ctx: Context) -> dict[str, Any]:
    """Return audio (references to segments), their times in the recording, and how long it is."""
    source = params.text(ctx, "source", default="")
    given = recordings.given(ctx, source)
    if not given and not source:
        raise ctx.CallError("precondition", "no recording was handed on", "record sound in a subtask before this one")
    name = str(given[-1].get("name", "recording")) if given else source
    ctx.progress(0.1, f"decoding {name}")
    data = ctx.get_artifact(given[-1]) if given else recordings.in_folder(ctx, source)
    wave = recordings.wave(ctx, data, name)
    ctx.progress(0.4, "reducing noise")
    cleaned = sounds.denoise(wave)
    loudest = float(np.abs(cleaned).max())
    cleaned = cleaned * np.float32(0.9 / loudest) if loudest > 1e-4 else cleaned
    spans = [part for start, end in sounds.voiced(cleaned) for part in _cut(start, end)]
    result: dict[str, Any] = {"source": name, "duration_s": round(len(wave) / sounds.RATE, 2)}
    if not spans:
        spans = list(_cut(0, len(cleaned)))
        result["note"] = "nobody seems to speak: it is handed on whole"
    elif len(wave) >= recordings.LONGEST_S * sounds.RATE:
        result["note"] = f"only the first {recordings.LONGEST_S // 60} minutes are kept: cut it before"
    elif len(spans) > MOST_SEGMENTS:
        result["note"] = f"only the first {MOST_SEGMENTS} of {len(spans)} segments are kept"
    stem = params.slug(name.rsplit(".", 1)[0])
    kept: list[dict[str, Any]] = []
    for number, (start, end) in enumerate(spans[:MOST_SEGMENTS], start=1):
        kept.append(recordings.keep(ctx, cleaned[start:end], f"{stem}-{number:03d}.flac"))
        ctx.progress(0.5 + 0.5 * number / min(len(spans), MOST_SEGMENTS), f"segment {number}")
    times = [
        {"start_s": round(start / sounds.RATE, 2), "end_s": round(end / sounds.RATE, 2)}
        for start, end in spans[:MOST_SEGMENTS]
    ]
    return {"audio": kept, "segments": times, **result}


def _cut(start: int, end: int) -> list[tuple[int, int]]:
    return [(at, min(at + LONGEST, end)) for at in range(start, end, LONGEST)]
