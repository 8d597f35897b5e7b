"""record_audio: sound for some seconds, kept as a WAV file, and how loud it is."""

import array
import io
import math
import sys
import wave
from typing import Any

from _lib import params
from _lib.context import Context

USUAL_S = 5.0
MAX_S = 120.0
SILENCE_DBFS = -60.0
"""Below this there is nothing to be heard."""


def run(ctx: Context) -> dict[str, Any]:
    """Return audio, duration_s, level_dbfs (0 is the loudest that the file can hold) and silent."""
    target = params.text(ctx, "target", default="")
    lasting = params.number(ctx, "duration_s", default=USUAL_S, low=0.5, high=MAX_S)
    ctx.progress(0.1, f"listening for {lasting:g} s")
    answer = ctx.command("listen", timeout_s=lasting + 30.0, duration_s=lasting, target=target)
    blobs: dict[str, bytes] = answer.get("blobs") or {}
    data = blobs.get("sound.wav") or next((blobs[name] for name in sorted(blobs)), b"")
    seconds, level = _measured(ctx, data)
    audio = ctx.put_artifact(f"{params.slug(target or 'sound')}.wav", data, "audio/wav")
    silent = level <= SILENCE_DBFS
    ctx.progress(1.0, "silence" if silent else f"{seconds:.1f} s, {level:.0f} dBFS")
    return {
        "audio": audio,
        "duration_s": round(seconds, 3),
        "level_dbfs": round(level, 1),
        "silent": silent,
        "target": target,
    }


def _measured(ctx: Context, data: bytes) -> tuple[float, float]:
    """Return seconds and level of a WAV file of 16-bit samples; ctx.Fail when it is none."""
    try:
        with wave.open(io.BytesIO(data)) as file:
            width, rate, count = file.getsampwidth(), file.getframerate(), file.getnframes()
            frames = file.readframes(count)
    except (wave.Error, EOFError) as error:
        raise ctx.Fail(f"{ctx.robot} sent no sound: {error}", "look at its microphone", retryable=True) from error
    if width != 2 or not rate or not frames:
        raise ctx.Fail(f"{ctx.robot} sent sound of {8 * width} bits, {len(frames)} bytes", "record 16-bit samples")
    samples = array.array("h", frames[: len(frames) // 2 * 2])
    if sys.byteorder == "big":
        samples.byteswap()
    power = sum(each * each for each in samples) / len(samples)
    return count / rate, 10.0 * math.log10(max(power, 1e-9) / 32768.0**2)
