"""Handlers whose work is one order to the robot's arm, base or sensor."""

import array
import io
import wave
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from PIL import Image

Make = Callable[..., Any]
Load = Callable[..., ModuleType]

ORDERS: tuple[tuple[str, dict[str, str]], ...] = (
    ("clean", {"object": "table"}),
    ("cut", {"object": "rope"}),
    ("unfasten", {"object": "cover"}),
    ("fasten", {"object": "cover"}),
    ("fasten", {"object": "cover", "to": "pump"}),
    ("pour", {"object": "bottle", "into": "bucket"}),
    ("push", {"object": "cart"}),
    ("push", {"object": "cart", "to": "dock 2"}),
)


@pytest.mark.parametrize(("skill", "given"), ORDERS)
def test_the_arm_gets_one_order(make_ctx: Make, handler: Load, skill: str, given: dict[str, str]) -> None:
    """The order has the skill's name and what the plan names; what the robot says is in the result."""
    ctx = make_ctx(**given)
    assert handler(skill).run(ctx) == {"did": skill, **given}
    assert ctx.commands == [(skill, given)]
    assert ctx.steps[-1][0] == 1.0


@pytest.mark.parametrize(("skill", "given"), ORDERS)
def test_without_an_object_no_order_is_given(make_ctx: Make, handler: Load, skill: str, given: dict[str, str]) -> None:
    """What is missing is named."""
    ctx = make_ctx(**(given | {"object": " "}))
    with pytest.raises(ctx.Fail, match="'object' is missing"):
        handler(skill).run(ctx)
    assert ctx.commands == []


def test_follow_is_bounded_in_time_and_speed(make_ctx: Make, handler: Load) -> None:
    """Half a minute when no time is said, at the site's speed at most."""
    ctx = make_ctx(target="Ann")
    handler("follow").run(ctx)
    (order,) = ctx.sent("follow")
    assert (order["duration_s"], order["speed_mps"], order["distance_m"]) == (30.0, 6.0, 2.0)
    with pytest.raises(ctx.Fail, match="duration_s"):
        handler("follow").run(make_ctx(target="Ann", duration_s=1e9))


def test_localize_gives_the_middle_and_the_spread(make_ctx: Make, handler: Load) -> None:
    """One estimate far off moves neither; headings about north are not averaged to south."""
    ctx = make_ctx(window_ms=400, method="visual odometry")
    poses = iter([{"x": 1.0, "y": 2.0, "heading_deg": 350.0}, {"x": 1.2, "y": 2.0, "heading_deg": 10.0}])
    ctx.answers["state"] = lambda _: {"pose": next(poses)}
    result = handler("localize").run(ctx)
    assert (result["pose"]["x"], result["spread_m"], result["estimates"]) == (1.1, 0.1, 2)
    assert result["pose"]["heading_deg"] in (0.0, 360.0)
    assert "visual odometry" in result["note"]
    ctx = make_ctx(window_ms=0)
    ctx.answers["state"] = lambda _: {"pose": {"x": float("nan"), "y": 1.0}}
    with pytest.raises(ctx.Fail, match="does not know where it is"):
        handler("localize").run(ctx)


def test_measure_wants_a_number(make_ctx: Make, handler: Load) -> None:
    """Quantity and target go to the robot; what is no number is refused."""
    ctx = make_ctx(quantity="temperature", target="pump")
    ctx.answers["measure"] = lambda _: {"number": 55, "unit": "°C"}
    result = handler("measure").run(ctx)
    assert (result["number"], result["unit"], result["target"]) == (55.0, "°C", "pump")
    for wrong in (None, "hot", True, float("inf")):
        ctx.answers["measure"] = lambda _, wrong=wrong: {"number": wrong}
        with pytest.raises(ctx.Fail, match="no number"):
            handler("measure").run(ctx)


def sound(samples: list[int], *, width: int = 2) -> bytes:
    """Return a WAV file."""
    out = io.BytesIO()
    with wave.open(out, "wb") as file:
        file.setnchannels(1)
        file.setsampwidth(width)
        file.setframerate(8000)
        file.writeframes(array.array("h" if width == 2 else "b", samples).tobytes())
    return out.getvalue()


def test_record_audio_keeps_the_sound_and_says_how_loud_it_is(make_ctx: Make, handler: Load) -> None:
    """Half of full scale is -6 dB; silence is a result and no failure."""
    ctx = make_ctx(target="pump", duration_s=1)
    ctx.answers["listen"] = lambda _: {"blobs": {"sound.wav": sound([16384, -16384] * 4000)}}
    result = handler("record_audio").run(ctx)
    assert (result["duration_s"], result["level_dbfs"], result["silent"]) == (1.0, -6.0, False)
    assert (result["audio"]["name"], result["audio"]["media_type"]) == ("pump.wav", "audio/wav")
    ctx.answers["listen"] = lambda _: {"blobs": {"sound.wav": sound([0] * 8000)}}
    assert handler("record_audio").run(ctx)["silent"]
    for broken in (b"", b"RIFF", sound([1, 2], width=1), sound([])):
        ctx.answers["listen"] = lambda _, broken=broken: {"blobs": {"sound.wav": broken}}
        with pytest.raises(ctx.Fail, match="sent"):
            handler("record_audio").run(ctx)


def thermal(celsius: "np.ndarray[Any, Any]") -> bytes:
    """Return a radiometric picture."""
    out = io.BytesIO()
    Image.fromarray(np.round((celsius + 273.15) * 100).astype(np.uint16)).save(out, "PNG")
    return out.getvalue()


def test_scan_thermal_finds_the_hottest_point(make_ctx: Make, handler: Load) -> None:
    """Temperatures come back to a hundredth of a degree; the file itself and a coloured one are kept."""
    celsius = np.full((60, 80), 20.0)
    celsius[10:16, 30:38] = 55.0
    celsius[12, 33] = 91.25
    ctx = make_ctx(asset="pump")
    ctx.answers["thermal"] = lambda _: {"blobs": {"thermal.png": thermal(celsius)}}
    result = handler("scan_thermal").run(ctx)
    assert (result["lowest_c"], result["highest_c"], result["median_c"], result["hottest"]) == (
        20.0,
        91.25,
        20.0,
        [33, 12],
    )
    assert result["hot_share"] == 0.01
    assert Image.open(io.BytesIO(ctx.get_artifact(result["image"]))).getpixel((33, 12)) == (255, 255, 255)
    for broken in (b"", b"\x89PNG", ctx.picture):
        ctx.answers["thermal"] = lambda _, broken=broken: {"blobs": {"thermal.png": broken}}
        with pytest.raises(ctx.Fail, match="sent"):
            handler("scan_thermal").run(ctx)
