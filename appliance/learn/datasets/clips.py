"""Draws action clips as a stand-in for UCF101: ten actions, each clip another person or machine, each group a site.

A site (a group `gGG`) has its own background, light, camera height and things standing about, so a model that has
learned some sites has not learned the others. 16 pictures of 80 x 60.
"""

import io
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw

WIDTH, HEIGHT, FRAMES, FPS = 80, 60, 16, 8
QUALITY = 85
UNIT = 8.5
"""Length of an arm or thigh of a person of size 1, pixels."""
CLASSES = (
    "Walk", "Run", "Jump", "Wave", "Squat", "DriveStraight", "DriveCurve", "DroneTakeoff", "DroneOrbit", "ArmPick",
)  # fmt: skip

Colour = tuple[int, int, int]
Pen = ImageDraw.ImageDraw


class Site(NamedTuple):
    """What all clips of a group share."""

    background: Image.Image
    ground: float
    """Height of the ground where actors stand, pixels from above."""
    size: float
    light: float
    noise: float


class Actor(NamedTuple):
    """Who or what acts in a clip: where it stands, how large and quick it is, where in its movement it begins."""

    x: float
    size: float
    pace: float
    phase: float
    towards: int
    colour: Colour


def site(seed: int, group: int) -> Site:
    """Return the site of a group, the same for the same seed."""
    rng = np.random.Generator(np.random.Philox([seed, group]))
    above, below = (rng.integers(40, 216, 3) for _ in range(2))
    ground = float(rng.uniform(40, 54))
    rows = np.arange(HEIGHT)[:, None]
    shade = np.where(rows < ground - 6, above, below) * (1.0 - 0.25 * rows / HEIGHT)
    picture = Image.fromarray(np.broadcast_to(shade[:, None, :], (HEIGHT, WIDTH, 3)).astype(np.uint8))
    pen = ImageDraw.Draw(picture)
    for _ in range(int(rng.integers(2, 7))):
        left, width, height, drop = (
            int(rng.integers(low, high)) for low, high in ((0, WIDTH - 6), (4, 22), (6, 34), (-2, 3))
        )
        bottom = ground - 6 + drop
        pen.rectangle((left, bottom - height, left + width, bottom), fill=_colour(rng))
    return Site(picture, ground, float(rng.uniform(0.75, 1.3)), float(rng.uniform(0.7, 1.2)), float(rng.uniform(2, 9)))


def clip(where: Site, action: str, seed: int, group: int, number: int) -> list[bytes]:
    """Return the JPEG pictures of a clip, the same for the same arguments."""
    rng = np.random.Generator(np.random.Philox([seed, group, 1 + CLASSES.index(action), number]))
    actor = Actor(
        x=float(rng.uniform(0.3, 0.7)) * WIDTH,
        size=float(rng.uniform(0.8, 1.25)) * where.size,
        pace=float(rng.uniform(0.8, 1.25)),
        phase=float(rng.uniform(0, 2 * math.pi)),
        towards=1 if rng.random() < 0.5 else -1,
        colour=_seen(where, rng),
    )
    shift = rng.integers(-3, 4)
    pictures: list[bytes] = []
    for frame in range(FRAMES):
        picture = where.background.copy()
        _ACTIONS[action](ImageDraw.Draw(picture), where, actor, frame / FRAMES)
        values = np.asarray(picture, dtype=np.float32) * where.light
        noise = rng.standard_normal(values.shape, dtype=np.float32) * where.noise
        values = np.roll(values, int(shift), axis=1) + noise
        out = io.BytesIO()
        Image.fromarray(np.clip(values, 0, 255).astype(np.uint8)).save(out, "JPEG", quality=QUALITY)
        pictures.append(out.getvalue())
    return pictures


def _seen(where: Site, rng: np.random.Generator) -> Colour:
    """Return a colour that stands out from a site's background."""
    behind = float(np.asarray(where.background.convert("L")).mean())
    while True:
        red, green, blue = colour = _colour(rng)
        if abs(0.299 * red + 0.587 * green + 0.114 * blue - behind) > 50:
            return colour


def _colour(rng: np.random.Generator) -> Colour:
    red, green, blue = (int(value) for value in rng.integers(20, 236, 3))
    return red, green, blue


# --- people


def _person(
    pen: Pen, who: Actor, *, x: float, hip: float, legs: tuple[float, float], arms: tuple[float, float],
    knees: float = 0.0, lean: float = 0.0,
) -> None:  # fmt: skip
    """Draw a person by the angles of limbs from straight down, in radians.

    Args:
        pen: of the picture.
        who: size and colour.
        x: where the hip is, pixels.
        hip: how high up in the picture, pixels from above.
        legs: of both thighs.
        arms: of both arms.
        knees: how far the shins are bent back against the thighs.
        lean: of the body.
    """
    unit = UNIT * who.size
    width = max(2, round(1.8 * who.size))
    neck = (x + who.towards * math.sin(lean) * unit * 1.3, hip - math.cos(lean) * unit * 1.3)
    pen.line(((x, hip), neck), fill=who.colour, width=width + 1)
    head = unit * 0.38
    centre = (neck[0] + who.towards * math.sin(lean) * head, neck[1] - head * 1.2)
    pen.ellipse((centre[0] - head, centre[1] - head, centre[0] + head, centre[1] + head), fill=who.colour)
    for angle in legs:
        knee = _end((x, hip), who.towards * angle, unit * 0.85)
        pen.line(((x, hip), knee), fill=who.colour, width=width)
        pen.line((knee, _end(knee, who.towards * (angle - knees), unit * 0.85)), fill=who.colour, width=width)
    for angle in arms:
        pen.line((neck, _end(neck, who.towards * angle, unit * 1.1)), fill=who.colour, width=width)


def _end(start: tuple[float, float], angle: float, length: float) -> tuple[float, float]:
    return start[0] + math.sin(angle) * length, start[1] + math.cos(angle) * length


def _standing(where: Site, who: Actor) -> float:
    return where.ground - UNIT * who.size * 1.7


def _walk(pen: Pen, where: Site, who: Actor, time: float) -> None:
    swing = 0.5 * math.sin(2 * math.pi * 1.6 * who.pace * time + who.phase)
    x = who.x + who.towards * 16 * who.pace * (time - 0.5)
    _person(pen, who, x=x, hip=_standing(where, who), legs=(swing, -swing), arms=(-0.6 * swing, 0.6 * swing))


def _run(pen: Pen, where: Site, who: Actor, time: float) -> None:
    swing = 1.0 * math.sin(2 * math.pi * 3.2 * who.pace * time + who.phase)
    x = who.x + who.towards * 46 * who.pace * (time - 0.5)
    hip = _standing(where, who) - 1.5 * abs(swing)
    _person(pen, who, x=x, hip=hip, legs=(swing, -swing), arms=(-swing, swing), knees=0.7, lean=0.35)


def _jump(pen: Pen, where: Site, who: Actor, time: float) -> None:
    height = abs(math.sin(math.pi * 2.0 * who.pace * time + who.phase))
    hip = _standing(where, who) - 13 * height * who.size
    _person(
        pen, who, x=who.x, hip=hip, legs=(0.25, -0.25), arms=(1.4 + height, -1.4 - height), knees=0.5 * (1 - height)
    )


def _wave(pen: Pen, where: Site, who: Actor, time: float) -> None:
    angle = 2.6 + 0.45 * math.sin(2 * math.pi * 3.0 * who.pace * time + who.phase)
    _person(pen, who, x=who.x, hip=_standing(where, who), legs=(0.12, -0.12), arms=(angle, -0.15))


def _squat(pen: Pen, where: Site, who: Actor, time: float) -> None:
    down = 0.5 - 0.5 * math.cos(2 * math.pi * 1.7 * who.pace * time + who.phase)
    hip = _standing(where, who) + UNIT * who.size * 0.75 * down
    _person(
        pen, who, x=who.x, hip=hip, legs=(1.15 * down, 0.95 * down), arms=(1.4 * down, 1.5 * down), knees=2.1 * down
    )


# --- machines


def _vehicle(pen: Pen, who: Actor, x: float, y: float, size: float) -> None:
    length, height, wheel = 15 * size, 6 * size, 2.2 * size
    pen.rectangle((x - length / 2, y - height - wheel, x + length / 2, y - wheel), fill=who.colour)
    cab = sorted((x + who.towards * length * 0.1, x + who.towards * length * 0.45))
    pen.rectangle((cab[0], y - height * 1.7 - wheel, cab[1], y - height - wheel), fill=who.colour)
    for offset in (-0.3, 0.3):
        centre = x + offset * length
        pen.ellipse((centre - wheel, y - 2 * wheel, centre + wheel, y), fill=(15, 15, 15))


def _drive_straight(pen: Pen, where: Site, who: Actor, time: float) -> None:
    _vehicle(pen, who, who.x + who.towards * 40 * who.pace * (time - 0.5), where.ground, who.size)


def _drive_curve(pen: Pen, where: Site, who: Actor, time: float) -> None:
    angle = math.pi * who.pace * (time - 0.5) * 1.2
    near = math.cos(angle)
    x, y = who.x + who.towards * 26 * math.sin(angle), where.ground - 8 + 10 * near
    _vehicle(pen, who, x, y, who.size * (0.6 + 0.5 * max(0.0, near)))


def _drone(pen: Pen, who: Actor, x: float, y: float, size: float, time: float) -> None:
    arm = 7 * size
    pen.line((x - arm, y, x + arm, y), fill=who.colour, width=max(2, round(2 * size)))
    pen.rectangle((x - 2.5 * size, y - 1, x + 2.5 * size, y + 3 * size), fill=who.colour)
    blade = arm * 0.55 * (0.4 + 0.6 * abs(math.sin(60 * time + who.phase)))
    for side in (-1, 1):
        pen.line((x + side * arm - blade, y - 2, x + side * arm + blade, y - 2), fill=(20, 20, 20), width=1)


def _drone_takeoff(pen: Pen, where: Site, who: Actor, time: float) -> None:
    height = 34 * min(1.0, max(0.0, (time * 1.25 * who.pace) - 0.1 * (who.phase / math.pi)))
    _drone(pen, who, who.x + math.sin(9 * time + who.phase), where.ground - 4 - height, who.size, time)


def _drone_orbit(pen: Pen, where: Site, who: Actor, time: float) -> None:
    angle = who.towards * 2 * math.pi * 1.1 * who.pace * time + who.phase
    x, y = who.x + 18 * math.cos(angle), where.ground - 26 + 6 * math.sin(angle)
    _drone(pen, who, x, y, who.size * (0.9 + 0.25 * math.sin(angle)), time)


def _arm_pick(pen: Pen, where: Site, who: Actor, time: float) -> None:
    cycle = (time * 1.15 * who.pace + who.phase / (2 * math.pi)) % 1.0
    down = 0.5 - 0.5 * math.cos(2 * math.pi * cycle)
    base = (who.x, where.ground)
    length = 13 * who.size
    elbow = _end(base, who.towards * (math.pi - 0.5 - 0.2 * down), length)
    hand = _end(elbow, who.towards * (1.7 - 1.25 * down), length)
    width = max(3, round(3 * who.size))
    pen.rectangle((base[0] - 5, base[1] - 3, base[0] + 5, base[1] + 2), fill=(30, 30, 30))
    pen.line((base, elbow), fill=who.colour, width=width)
    pen.line((elbow, hand), fill=who.colour, width=width - 1)
    box = 2.6 * who.size
    x, y = (hand[0], hand[1] + box) if cycle > 0.5 else (base[0] + who.towards * length * 1.05, where.ground - box)
    pen.rectangle((x - box, y - box, x + box, y + box), fill=(200, 60, 40))


_ACTIONS: dict[str, Callable[[Pen, Site, Actor, float], None]] = {
    "Walk": _walk,
    "Run": _run,
    "Jump": _jump,
    "Wave": _wave,
    "Squat": _squat,
    "DriveStraight": _drive_straight,
    "DriveCurve": _drive_curve,
    "DroneTakeoff": _drone_takeoff,
    "DroneOrbit": _drone_orbit,
    "ArmPick": _arm_pick,
}
