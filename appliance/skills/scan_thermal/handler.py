"""scan_thermal: how warm an asset is, from the robot's thermal camera.

The robot sends `thermal.png`: 16 bits a pixel, hundredths of a kelvin, as radiometric cameras write it. That file is
kept, and a coloured one for people beside it. Needs numpy and Pillow, which image `vision` has.
"""

import io
from typing import Any

import numpy as np
from _lib import params
from _lib.context import Context
from PIL import Image, UnidentifiedImageError

KELVIN = 273.15
MAX_PIXELS = 4_000_000
HOTSPOT_K = 15.0
"""So much above the picture's median a pixel counts as a hot spot."""


def run(ctx: Context) -> dict[str, Any]:
    """Return image (coloured), raw, asset, lowest, highest and median (degrees Celsius), and the hottest point."""
    asset = params.text(ctx, "asset")
    ctx.progress(0.1, f"scanning {asset}")
    answer = ctx.command("thermal", timeout_s=60, target=asset)
    blobs: dict[str, bytes] = answer.get("blobs") or {}
    data = blobs.get("thermal.png", b"")
    celsius = _temperatures(ctx, data)
    low, high, middle = float(celsius.min()), float(celsius.max()), float(np.median(celsius))
    y, x = (int(each) for each in np.unravel_index(int(celsius.argmax()), celsius.shape))
    raw = ctx.put_artifact(f"{params.slug(asset)}-thermal.png", data, "image/png")
    image = ctx.put_artifact(f"{params.slug(asset)}-thermal-colour.png", _coloured(celsius, low, high), "image/png")
    ctx.progress(1.0, f"{asset}: {low:.1f} to {high:.1f} °C")
    return {
        "image": image,
        "raw": raw,
        "asset": asset,
        "lowest_c": round(low, 2),
        "highest_c": round(high, 2),
        "median_c": round(middle, 2),
        "hottest": [x, y],
        "hot_share": round(float((celsius > middle + HOTSPOT_K).mean()), 4),
    }


def _temperatures(ctx: Context, data: bytes) -> "np.ndarray[Any, np.dtype[np.float64]]":
    try:
        picture = Image.open(io.BytesIO(data))
        if picture.width * picture.height > MAX_PIXELS:
            raise ctx.Fail(f"the scan has {picture.width} x {picture.height} pixels", f"{MAX_PIXELS:,} are possible")
        pixels = np.asarray(picture)
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError, SyntaxError, ValueError) as error:
        raise ctx.Fail(f"{ctx.robot} sent no thermal picture: {error}", "look at its camera", retryable=True) from error
    if pixels.ndim != 2 or pixels.dtype.name not in ("uint16", "int32") or not pixels.size:
        raise ctx.Fail(
            f"{ctx.robot} sent a picture of {pixels.dtype}, not of 16-bit temperatures", "send hundredths of a kelvin"
        )
    return pixels.astype(np.float64) / 100.0 - KELVIN


def _coloured(celsius: "np.ndarray[Any, np.dtype[np.float64]]", low: float, high: float) -> bytes:
    """Black over red and yellow to white, the picture's own range."""
    share = (celsius - low) / max(high - low, 0.1)
    channels = [np.clip(share * 3.0 - start, 0.0, 1.0) for start in (0.0, 1.0, 2.0)]
    out = io.BytesIO()
    Image.fromarray((np.stack(channels, axis=-1) * 255).astype(np.uint8)).save(out, "PNG")
    return out.getvalue()
