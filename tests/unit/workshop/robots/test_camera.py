"""Pictures of the simulated world."""

import io

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from appliance.model import Box, Place, Pose, Site, SiteObject
from workshop.robots import camera
from workshop.robots.world import World, aim

SITE = Site(
    places={"dock": Place(x=0.0, y=10.0), "home": Place(x=0.0, y=0.0)},
    obstacles=(Box(name="wall", x=(-5.0, 5.0), y=(-4.0, -3.0)),),
    objects=(SiteObject(name="red box", colour="red", at="dock"),),
)


def red(picture: Image.Image) -> NDArray[np.bool_]:
    """Tell which pixels are red."""
    pixels = np.asarray(picture.convert("RGB"), dtype=int)
    return (pixels[..., 0] > 90) & (pixels[..., 1] < 60) & (pixels[..., 2] < 60)


def look(world: World, target: str, pose: Pose, **size: int) -> Image.Image:
    """Take a picture of a target."""
    return camera.render(world, pose, aim(world, target, pose, camera.EYE_M), robot="r", **size)


def test_the_red_box_is_red_in_the_middle() -> None:
    """Looking at the red box puts red pixels in the middle of the picture and nowhere at its edge."""
    picture = look(World(SITE), "red box", Pose())
    mask = red(picture)
    assert picture.size == (320, 240)
    assert mask[120, 160]
    assert 20 < mask.sum() < 2000
    assert not mask[:, 0].any()
    assert not mask[:, -1].any()


def test_nearer_is_larger() -> None:
    """From a quarter of the distance it covers far more of the picture."""
    far = red(look(World(SITE), "red box", Pose())).sum()
    near = red(look(World(SITE), "red box", Pose(y=7.5))).sum()
    assert near > 6 * far


def test_nothing_red_the_other_way_or_behind_a_wall() -> None:
    """The box is not in a picture of the wall, nor seen through it."""
    world = World(SITE)
    assert not red(look(world, "wall", Pose())).any()
    assert not red(look(world, "red box", Pose(y=-8.0))).any()


def test_what_is_held_is_in_view_ahead() -> None:
    """A held box shows at the lower edge of a picture straight ahead."""
    world = World(SITE)
    pose = Pose(y=10.0)
    world.pick("r", world.check_pick("r", "red box", pose))
    world.carry("r", pose)
    mask = red(look(world, "nothing special", pose))
    assert mask[-1, 160]
    assert not mask[0].any()


@pytest.mark.parametrize("bearing", [0.0, 45.0, 90.0, 180.0, 270.0, 359.9])
def test_any_direction_renders(bearing: float) -> None:
    """No direction divides by zero; sizes are as asked."""
    picture = look(World(SITE), "ahead", Pose(x=3.0, y=3.0, heading_deg=bearing), width=64, height=48)
    assert picture.size == (64, 48)


def test_encodings() -> None:
    """PNG and JPEG are what they say and open again."""
    picture = look(World(SITE), "red box", Pose(), width=64, height=48)
    assert Image.open(io.BytesIO(camera.png(picture))).format == "PNG"
    assert Image.open(io.BytesIO(camera.jpeg(picture))).format == "JPEG"


def test_colours() -> None:
    """Known names have their colour, others of the web's names too, and nonsense is grey."""
    assert camera.colour_of("Red")[0] > 200
    assert camera.colour_of("teal") == (0, 128, 128)
    assert camera.colour_of("no such colour") == camera.PALETTE["grey"]
