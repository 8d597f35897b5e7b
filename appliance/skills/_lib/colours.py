"""Finds coloured things in pictures: hue, saturation and value thresholds, then connected areas.

Colour is what the skills of this product recognise things by: `red box` is an area that is red. That is plain,
quick (a 640 x 480 picture in some 20 ms on one core) and says what it does; a learned detector would be another skill.
Needs numpy and Pillow, which image `vision` has.
"""

import io
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, UnidentifiedImageError

from .context import Context

Mask = NDArray[np.bool_]

WORK_WIDTH = 480
"""Pictures are looked at no wider than this, in pixels."""
MAX_PIXELS = 40_000_000
MAX_FOUND = 100
"""Things listed per picture; the largest."""
MIN_SHARE = 0.0003
"""Smallest area that counts, as a share of the picture: 92 pixels of 640 x 480."""
_SKY_SHARE = 0.6

HUES: dict[str, tuple[tuple[float, float], ...]] = {
    "red": ((345.0, 360.0), (0.0, 15.0)),
    "orange": ((15.0, 42.0),),
    "yellow": ((42.0, 70.0),),
    "green": ((70.0, 165.0),),
    "cyan": ((165.0, 195.0),),
    "blue": ((195.0, 260.0),),
    "purple": ((260.0, 300.0),),
    "pink": ((300.0, 345.0),),
}
"""Hue ranges in degrees of the colours that stand out by themselves."""
PLAIN = ("white", "grey", "black")
"""Colours without hue: found when asked for, never by themselves, since floors and walls have them."""
SYNONYMS = {
    "gray": "grey",
    "silver": "grey",
    "violet": "purple",
    "magenta": "pink",
    "amber": "orange",
    "gold": "yellow",
    "golden": "yellow",
    "crimson": "red",
    "scarlet": "red",
    "navy": "blue",
    "turquoise": "cyan",
    "lime": "green",
}
GENERIC = frozenset(
    {"object", "thing", "item", "box", "crate", "pallet", "container", "parcel", "package", "cone", "tote", "bin"}
)
"""Words for coloured things in general: any colour will do for them."""


class Wanted(NamedTuple):
    """What a target's words ask for. `sure` is False when nothing in them can be recognised by colour."""

    colours: tuple[str, ...]
    sure: bool


class Area(NamedTuple):
    """A connected area: box in pixels of the picture (left, top, width, height), size in pixels, mean saturation."""

    box: tuple[int, int, int, int]
    pixels: int
    saturation: float


def singular(word: str) -> str:
    """Return a noun's singular, well enough for boxes, pallets and bodies."""
    if word.endswith("ies") and len(word) > 4:
        return word[:-3] + "y"
    for ending in ("xes", "ches", "shes", "sses"):
        if word.endswith(ending):
            return word[:-2]
    return word[:-1] if word.endswith("s") and not word.endswith("ss") else word


def wanted(target: str, site: dict[str, Any]) -> Wanted:
    """Return the colours a target means: its own colour words, else those of the site's objects of that name."""
    words = [each.strip(".,;:!?\"'()") for each in target.lower().replace("-", " ").split()]
    named = [SYNONYMS.get(word, word) for word in words]
    colours = tuple(dict.fromkeys(word for word in named if word in HUES or word in PLAIN))
    if colours:
        return Wanted(colours, sure=True)
    nouns = {singular(word) for word in words}
    known = [
        str(thing.get("colour", "")).lower()
        for thing in site.get("objects") or ()
        if nouns & {singular(word) for word in str(thing.get("name", "")).lower().split()}
    ]
    colours = tuple(dict.fromkeys(SYNONYMS.get(each, each) for each in known if SYNONYMS.get(each, each) in HUES))
    if colours:
        return Wanted(colours, sure=True)
    return Wanted(tuple(HUES), sure=bool(nouns & GENERIC))


def decode(ctx: Context, data: bytes, name: str) -> Image.Image:
    """Return a picture as RGB; ctx.Fail when the bytes are none, or too large a one."""
    try:
        picture = Image.open(io.BytesIO(data))
        if picture.width * picture.height > MAX_PIXELS:
            raise ctx.Fail(f"{name} has {picture.width} x {picture.height} pixels", f"{MAX_PIXELS:,} are possible")
        return picture.convert("RGB")
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError, SyntaxError, ValueError) as error:
        raise ctx.Fail(f"{name} is no picture that can be read: {error}", "take it again") from error


def find(picture: Image.Image, colours: tuple[str, ...]) -> list[tuple[str, Area]]:
    """Return the areas of those colours, largest first."""
    scale = max(1.0, picture.width / WORK_WIDTH)
    small = picture
    if scale > 1.0:
        size = (WORK_WIDTH, max(1, round(picture.height / scale)))
        small = picture.resize(size, Image.Resampling.BOX)
    pixels = np.asarray(small, dtype=np.float32) / 255.0
    hue, saturation, value = _hsv(pixels)
    found: list[tuple[str, Area]] = []
    for colour in colours:
        mask = _mask(colour, hue, saturation, value)
        found += [
            (colour, _scaled(area, scale, picture))
            for area in _areas(mask, saturation, max(4, round(mask.size * MIN_SHARE)))
            if not _is_sky(colour, area, small.width)
        ]
    found.sort(key=lambda each: (-each[1].pixels, each[1].box))
    return found[:MAX_FOUND]


def detections(picture: Image.Image, target: str, site: dict[str, Any]) -> list[dict[str, Any]]:
    """Return what was found: dicts of label, colour, box [x, y, w, h], area (pixels), confidence (0 to 1).

    Confidence says how full and how strongly coloured the area is; it is a rank, not a probability.
    """
    want = wanted(target, site)
    rows: list[dict[str, Any]] = []
    for colour, area in find(picture, want.colours):
        left, top, width, height = area.box
        fill = min(1.0, area.pixels / max(1, width * height))
        strength = 1.0 if colour in PLAIN else area.saturation
        label = _label(target) if want.sure and len(want.colours) == 1 else f"{colour} object"
        rows.append(
            {
                "label": label,
                "colour": colour,
                "box": [left, top, width, height],
                "area": area.pixels,
                "confidence": round(0.5 * fill + 0.5 * strength, 2),
            }
        )
    return rows


def _label(target: str) -> str:
    """Return what one of the target's things is called: `red boxes` are each a `red box`."""
    *first, last = target.lower().split()
    return " ".join([*first, singular(last)])


def annotated(picture: Image.Image, rows: list[dict[str, Any]]) -> bytes:
    """Return the picture as PNG with a frame and a label on each detection."""
    marked = picture.copy()
    draw = ImageDraw.Draw(marked)
    for row in rows:
        left, top, width, height = row["box"]
        draw.rectangle((left - 2, top - 2, left + width + 1, top + height + 1), outline=(0, 0, 0), width=1)
        draw.rectangle((left - 1, top - 1, left + width, top + height), outline=(255, 255, 255), width=1)
        text = f"{row['label']} {row['confidence']:.2f}"
        at = (max(0, left), max(0, top - 13))
        around = draw.textbbox(at, text)
        draw.rectangle(around, fill=(0, 0, 0))
        draw.text(at, text, fill=(255, 255, 255))
    out = io.BytesIO()
    marked.save(out, "PNG")
    return out.getvalue()


def _hsv(rgb: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Hue in degrees, saturation and value 0 to 1, of an array (height, width, 3) of 0 to 1."""
    red, green, blue = rgb[..., 0], rgb[..., 1], rgb[..., 2]
    value = rgb.max(axis=2)
    spread = value - rgb.min(axis=2)
    safe = np.where(spread > 0, spread, 1)
    hue = np.where(
        value == red,
        ((green - blue) / safe) % 6,
        np.where(value == green, (blue - red) / safe + 2, (red - green) / safe + 4),
    )
    saturation = spread / np.where(value > 0, value, 1)
    return (hue * 60.0).astype(np.float32), saturation.astype(np.float32), value.astype(np.float32)


def _mask(colour: str, hue: NDArray[np.float32], saturation: NDArray[np.float32], value: NDArray[np.float32]) -> Mask:
    if colour == "white":
        return (saturation < 0.12) & (value > 0.85)
    if colour == "grey":
        return (saturation < 0.12) & (value >= 0.2) & (value <= 0.85)
    if colour == "black":
        return value < 0.15
    # Floors, cardboard and haze stay below these; painted things in light and in shade above.
    strong = (saturation >= 0.55) & (value >= 0.25)
    inside = np.zeros(hue.shape, dtype=np.bool_)
    for low, high in HUES[colour]:
        inside |= (hue >= low) & (hue < high)
    return strong & inside


def _areas(mask: Mask, saturation: NDArray[np.float32], least: int) -> list[Area]:
    """Connected areas (eight neighbours) of at least `least` pixels: runs of each row, joined by union-find."""
    height, width = mask.shape
    padded = np.zeros((height, width + 2), dtype=np.int8)
    padded[:, 1:-1] = mask
    change = np.diff(padded, axis=1)
    rows, begins = np.nonzero(change == 1)
    ends = np.nonzero(change == -1)[1]
    runs: list[tuple[int, int, int]] = list(zip(rows.tolist(), begins.tolist(), ends.tolist(), strict=True))
    parent = list(range(len(runs)))

    def root(index: int) -> int:
        while parent[index] != index:
            parent[index] = parent[parent[index]]
            index = parent[index]
        return index

    before = 0
    for index, (row, begin, end) in enumerate(runs):
        while before < index and (
            runs[before][0] < row - 1 or (runs[before][0] == row - 1 and runs[before][2] < begin)
        ):
            before += 1
        other = before
        while other < index and runs[other][0] == row - 1 and runs[other][1] <= end:
            if runs[other][2] >= begin:
                parent[root(other)] = root(index)
            other += 1
    sums = np.concatenate([np.zeros((height, 1), dtype=np.float32), np.cumsum(saturation, axis=1)], axis=1)
    groups: dict[int, list[float]] = {}
    for index, (row, begin, end) in enumerate(runs):
        strength = float(sums[row, end] - sums[row, begin])
        group = groups.setdefault(root(index), [begin, row, end, row + 1, 0, 0.0])
        group[0] = min(group[0], begin)
        group[2] = max(group[2], end)
        group[3] = row + 1
        group[4] += end - begin
        group[5] += strength
    return [
        Area((int(g[0]), int(g[1]), int(g[2] - g[0]), int(g[3] - g[1])), int(g[4]), g[5] / g[4])
        for g in groups.values()
        if g[4] >= least
    ]


def _is_sky(colour: str, area: Area, width: int) -> bool:
    """Whether an area is more likely the sky: blue, across most of the top edge."""
    return colour in ("blue", "cyan") and area.box[1] == 0 and area.box[2] >= _SKY_SHARE * width


def _scaled(area: Area, scale: float, picture: Image.Image) -> Area:
    if scale == 1.0:
        return area
    left, top = round(area.box[0] * scale), round(area.box[1] * scale)
    width = min(picture.width - left, max(1, round(area.box[2] * scale)))
    height = min(picture.height - top, max(1, round(area.box[3] * scale)))
    return Area((left, top, width, height), round(area.pixels * scale * scale), area.saturation)
