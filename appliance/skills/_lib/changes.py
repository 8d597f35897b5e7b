"""What has changed between two pictures of one thing. Needs numpy and Pillow, which image `vision` has.

Both are brought to one small size and to one mean brightness, and blocks are compared: light that is a little brighter
and a camera that stands a pixel aside are no change, a thing that is missing is.
"""

import io
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from . import colours
from .context import Context

SIDE = (160, 120)
BLOCK = 8
CHANGED = 0.12
"""Mean difference of a block's brightness or colour, of 1, from which on it has changed."""


def small(ctx: Context, data: bytes, name: str) -> "NDArray[np.float64]":
    """Return a picture as SIDE pixels of three channels, 0 to 1; ctx.Fail when it is none."""
    picture = colours.decode(ctx, data, name).resize(SIDE, Image.Resampling.BOX)
    return np.asarray(picture, dtype=np.float64) / 255.0


def between(one: "NDArray[np.float64]", other: "NDArray[np.float64]") -> dict[str, Any]:
    """Return changed_share (0 to 1) and boxes: left, top, width, height as shares of the picture, of what changed."""
    shift = one.mean() - other.mean()
    if abs(shift) < 0.2:  # light; beyond that it is another scene
        other = other + shift
    difference = np.abs(one - other).max(axis=2)
    rows, columns = SIDE[1] // BLOCK, SIDE[0] // BLOCK
    blocks = difference.reshape(rows, BLOCK, columns, BLOCK).mean(axis=(1, 3))
    changed = blocks > CHANGED
    boxes = [
        [round(left / columns, 3), round(top / rows, 3), round(width / columns, 3), round(height / rows, 3)]
        for left, top, width, height in _groups(changed)
    ]
    return {"changed_share": round(float(changed.mean()), 4), "boxes": boxes}


def _groups(changed: "NDArray[np.bool_]") -> list[tuple[int, int, int, int]]:
    """Boxes of blocks that touch, largest first."""
    left = {(int(row), int(column)) for row, column in np.argwhere(changed)}
    found: list[tuple[int, int, int, int]] = []
    while left:
        group, edge = set[tuple[int, int]](), [left.pop()]
        while edge:
            row, column = edge.pop()
            group.add((row, column))
            for near in ((row + 1, column), (row - 1, column), (row, column + 1), (row, column - 1)):
                if near in left:
                    left.remove(near)
                    edge.append(near)
        rows, columns = [row for row, _ in group], [column for _, column in group]
        found.append((min(columns), min(rows), max(columns) - min(columns) + 1, max(rows) - min(rows) + 1))
    return sorted(found, key=lambda box: -box[2] * box[3])


def sharpness(picture: "NDArray[np.float64]") -> float:
    """Return the variance of the Laplacian of the brightness: a blurred picture has hardly any."""
    grey = picture.mean(axis=2)
    laplacian = grey[1:-1, :-2] + grey[1:-1, 2:] + grey[:-2, 1:-1] + grey[2:, 1:-1] - 4.0 * grey[1:-1, 1:-1]
    return float(laplacian.var())


def png(data: "NDArray[np.float64]") -> bytes:
    """Encode what `small` returned."""
    out = io.BytesIO()
    Image.fromarray((np.clip(data, 0.0, 1.0) * 255).astype(np.uint8)).save(out, "PNG")
    return out.getvalue()
