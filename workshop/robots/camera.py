"""Pictures of the simulated world, so that what handlers find in them is really there to be found.

One ray a pixel against axis-aligned boxes (slab method, Kay and Kajiya 1986), with numpy: occlusion is exact, and
320 x 240 pixels take some 30 ms on one core. Obstacles are grey, things have their colour, everything else has
hardly any, so colour means something in these pictures.
"""

import io
import math

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray
from PIL import Image, ImageColor

from appliance.model import Pose, Site
from workshop.robots.world import ON, Aim, World

EYE_M = 1.0
"""Height of the camera above the ground."""
FIELD_OF_VIEW_DEG = 70.0
WIDTH, HEIGHT = 320, 240
_OBSTACLE_M = 2.2
_FAR_M = 1000.0
_SKY = (206, 212, 218)
_FLOOR = (150, 148, 145)
_CLOSED_FLOOR = (92, 90, 88)
_OBSTACLE = (120, 122, 126)
_SHADES = (0.78, 0.62, 1.0)
"""Of faces across x, across y, and of tops: what makes a box look like one."""
_HELD_AHEAD_M, _HELD_UP_M = 0.55, 0.25

PALETTE: dict[str, tuple[int, int, int]] = {
    "red": (222, 28, 28),
    "orange": (246, 132, 16),
    "yellow": (242, 214, 24),
    "green": (28, 176, 62),
    "cyan": (24, 200, 214),
    "blue": (30, 76, 224),
    "purple": (136, 40, 200),
    "pink": (240, 60, 160),
    "white": (245, 245, 245),
    "grey": (128, 128, 128),
    "black": (24, 24, 24),
    "brown": (140, 84, 36),
}

Floats = NDArray[np.float32]
Pixels = NDArray[np.uint8]


class _Solid(Struct, frozen=True):
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    colour: tuple[int, int, int]


def colour_of(name: str) -> tuple[int, int, int]:
    """Return the RGB of a colour name; mid grey for one that nobody knows."""
    known = PALETTE.get(name.lower())
    if known is not None:
        return known
    try:
        return ImageColor.getrgb(name)[:3]  # pyright: ignore[reportReturnType] - three of three or four
    except ValueError:
        return PALETTE["grey"]


def render(world: World, pose: Pose, view: Aim, *, robot: str, width: int = WIDTH, height: int = HEIGHT) -> Image.Image:
    """Return what the robot's camera sees from `pose` along `view`."""
    eye = np.array([pose.x, pose.y, EYE_M], dtype=np.float32)
    rays = _rays(view, width, height)
    picture = _ground(world, eye, rays)
    inverse: list[Floats] = [np.ascontiguousarray(1.0 / rays[..., axis]) for axis in range(3)]
    depth = np.full(rays.shape[:2], _FAR_M, dtype=np.float32)
    for solid in _solids(world, pose, robot):
        _draw(solid, eye, inverse, picture, depth)
    return Image.fromarray(picture)


AIR_C, WARM_C, SUN_C = 20.0, 55.0, 24.0
"""Temperature of everything, of a device that is on, and of the ground outside."""


def temperatures(world: World, pose: Pose, view: Aim, *, robot: str) -> Floats:
    """Return what its thermal camera sees, degrees Celsius, half as wide and high as pictures are."""
    eye = np.array([pose.x, pose.y, EYE_M], dtype=np.float32)
    rays = _rays(view, WIDTH // 2, HEIGHT // 2)
    inverse: list[Floats] = [np.ascontiguousarray(1.0 / rays[..., axis]) for axis in range(3)]
    celsius = np.where(rays[..., 2] < 0, np.float32(SUN_C), np.float32(AIR_C))
    depth = np.full(rays.shape[:2], _FAR_M, dtype=np.float32)
    warm = {(each.x, each.y) for each in world.things if each.state == ON}
    for solid in _solids(world, pose, robot):
        middle = tuple(round((low + high) / 2, 3) for low, high in zip(solid.low[:2], solid.high[:2], strict=True))
        hit, near, _ = _met(solid, eye, inverse, depth)
        celsius[hit] = WARM_C if middle in {(round(x, 3), round(y, 3)) for x, y in warm} else AIR_C
        depth[hit] = near[hit]
    return celsius


def reach(site: Site, pose: Pose, bearings: Floats, most_m: float) -> Floats:
    """Return how far beams at these compass bearings (radians) get to an obstacle or the fence, `most_m` at most."""
    slopes = [1.0 / np.where(np.abs(each) < 1e-6, 1e-6, each) for each in (np.sin(bearings), np.cos(bearings))]
    found = np.full(bearings.shape, most_m, dtype=np.float64)
    boxes = [(box, False) for box in site.obstacles] + ([(site.fence, True)] if site.fence is not None else [])
    for box, inside in boxes:
        enters, leaves = np.full(bearings.shape, -np.inf), np.full(bearings.shape, np.inf)
        for slope, (low, high), at in zip(slopes, (box.x, box.y), (pose.x, pose.y), strict=True):
            one, other = (low - at) * slope, (high - at) * slope
            enters, leaves = np.maximum(enters, np.minimum(one, other)), np.minimum(leaves, np.maximum(one, other))
        hit = (enters < leaves) & (leaves > 0)
        found = np.where(hit, np.minimum(found, np.where(inside | (enters < 0), leaves, enters)), found)
    return np.maximum(found, 0.0).astype(np.float32)


def png(picture: Image.Image) -> bytes:
    """Encode as PNG."""
    out = io.BytesIO()
    picture.save(out, "PNG", compress_level=4)
    return out.getvalue()


def jpeg(picture: Image.Image) -> bytes:
    """Encode as JPEG."""
    out = io.BytesIO()
    picture.save(out, "JPEG", quality=85)
    return out.getvalue()


def _rays(view: Aim, width: int, height: int) -> Floats:
    """Directions (height, width, 3), not normalised, of the pixels' middles."""
    yaw, pitch = math.radians(view.bearing_deg), math.radians(view.elevation_deg)
    forward = np.array([math.sin(yaw) * math.cos(pitch), math.cos(yaw) * math.cos(pitch), math.sin(pitch)])
    right = np.array([math.cos(yaw), -math.sin(yaw), 0.0])
    up = np.cross(right, forward)
    focal = width / 2 / math.tan(math.radians(FIELD_OF_VIEW_DEG) / 2)
    across = (np.arange(width) + 0.5 - width / 2) / focal
    down = (np.arange(height) + 0.5 - height / 2) / focal
    rays = forward + across[None, :, None] * right - down[:, None, None] * up
    # A ray exactly along an axis would divide by zero below.
    rays = np.where(np.abs(rays) < 1e-6, 1e-6, rays)
    return rays.astype(np.float32)


def _ground(world: World, eye: Floats, rays: Floats) -> Pixels:
    """Sky above, floor below: squares of a metre in two greys, closed areas darker."""
    reach = -eye[2] / rays[..., 2]
    below = (reach > 0) & (reach < _FAR_M)
    at = np.where(below, reach, 0.0)
    x, y = eye[0] + at * rays[..., 0], eye[1] + at * rays[..., 1]
    light = np.where((np.floor(x) + np.floor(y)) % 2 == 0, 1.0, 0.93)[..., None]
    picture = np.where(below[..., None], np.array(_FLOOR) * light, np.array(_SKY))
    for box in world.site.forbidden:
        closed = below & (x > box.x[0]) & (x < box.x[1]) & (y > box.y[0]) & (y < box.y[1])
        picture[closed] = _CLOSED_FLOOR
    return picture.astype(np.uint8)


def _solids(world: World, pose: Pose, robot: str) -> list[_Solid]:
    solids = [
        _Solid((box.x[0], box.y[0], 0.0), (box.x[1], box.y[1], _OBSTACLE_M), _OBSTACLE) for box in world.site.obstacles
    ]
    heading = math.radians(pose.heading_deg)
    for thing in world.things:
        if thing.holder not in ("", robot):
            continue  # carried by a robot that is not drawn
        x, y, low, half = thing.x, thing.y, 0.0, thing.size / 2
        if thing.holder == robot:
            x, y = pose.x + _HELD_AHEAD_M * math.sin(heading), pose.y + _HELD_AHEAD_M * math.cos(heading)
            low, half = _HELD_UP_M, min(half, 0.2)
        solids.append(_Solid((x - half, y - half, low), (x + half, y + half, low + 2 * half), colour_of(thing.colour)))
    return solids


def _draw(solid: _Solid, eye: Floats, inverse: list[Floats], picture: Pixels, depth: Floats) -> None:
    """Paint a box where it is nearer than what is there; `inverse` holds one over each ray's x, y and z."""
    hit, near, face = _met(solid, eye, inverse, depth)
    if hit.any():
        shades = np.array(_SHADES, dtype=np.float32)[face[hit]][:, None]
        picture[hit] = (np.array(solid.colour, dtype=np.float32) * shades).astype(np.uint8)
        depth[hit] = near[hit]


def _met(
    solid: _Solid, eye: Floats, inverse: list[Floats], depth: Floats
) -> tuple[NDArray[np.bool_], Floats, NDArray[np.uint8]]:
    """Return which rays meet a box before what is there, how far away, and across which axis its face lies."""
    near, far = np.full(depth.shape, -np.inf, dtype=np.float32), np.full(depth.shape, np.inf, dtype=np.float32)
    face = np.zeros(depth.shape, dtype=np.uint8)
    for axis, slope in enumerate(inverse):
        one = (solid.low[axis] - float(eye[axis])) * slope
        other = (solid.high[axis] - float(eye[axis])) * slope
        enters, leaves = np.minimum(one, other), np.maximum(one, other)
        face[enters > near] = axis
        near, far = np.maximum(near, enters), np.minimum(far, leaves)
    return (near < far) & (near > 0.05) & (near < depth), near, face
