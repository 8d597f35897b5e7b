"""Who can serve a subtask at all: what was told excludes, what was not told does not."""

import pytest
from msgspec.structs import replace

from appliance.model import GatewayStatus, Need, RobotInfo
from appliance.tasks.placement import Want, image_holders, lacks, why_not

WANT = Want(subtask="s1", skill="look", need=Need(image="vision", cpu=2.0, memory_mb=512), image="localhost/vision:1")
ABLE = GatewayStatus(id="gw-1", fleet="f", cores=4, pool_memory_mb=1024, images=("localhost/vision:1",))


def reason(status: GatewayStatus, **more: object) -> str:
    """Ask with the usual facts."""
    facts: dict[str, object] = {
        "ready": False, "skills": {"look"}, "holders": frozenset({"gw-1"}), "within": (), **more,
    }  # fmt: skip
    return why_not(WANT, status, **facts)  # type: ignore[arg-type]


def test_one_that_can_is_a_candidate() -> None:
    """Also where it does not have the image but somebody has it to give, and where it tells nothing of itself."""
    assert reason(ABLE) == ""
    assert reason(replace(ABLE, images=())) == ""
    assert reason(GatewayStatus(id="gw-1", fleet="f"), skills=None, holders=None) == ""


@pytest.mark.parametrize(
    ("status", "more", "said"),
    [
        (replace(ABLE, draining=True), {}, "draining"),
        (ABLE, {"within": ("gw-2",)}, "does not allow"),
        (ABLE, {"skills": {"walk"}}, "no skill look"),
        (replace(ABLE, pool_memory_mb=256), {}, "512 MB wanted"),
        (replace(ABLE, cores=1), {}, "2 cores wanted"),
        (replace(ABLE, pool_problem="Podman is away"), {}, "Podman is away"),
        (ABLE, {"holders": frozenset()}, "no gateway has it"),
    ],
)
def test_each_thing_that_is_lacking_is_told(status: GatewayStatus, more: dict[str, object], said: str) -> None:
    """The reason names what was wanted and what there is."""
    assert said in reason(status, **more)


def test_a_container_that_runs_needs_no_image_and_no_podman() -> None:
    """What is warm serves on when its image is gone or Podman is away."""
    assert reason(replace(ABLE, pool_problem="Podman is away"), ready=True) == ""
    assert reason(ABLE, holders=frozenset(), ready=True) == ""


def test_who_has_an_image_is_not_known_while_nobody_tells_of_any() -> None:
    """Older versions, and gateways without Podman, tell of no images."""
    silent = GatewayStatus(id="gw-2", fleet="f")
    assert image_holders({"gw-2": silent}, "localhost/vision:1") is None
    assert image_holders({"gw-1": ABLE, "gw-2": silent}, "localhost/vision:1") == {"gw-1"}
    assert image_holders({"gw-1": ABLE}, "localhost/other:1") == frozenset()


def test_a_robot_without_an_arm_lifts_nothing() -> None:
    """What it tells that it has and knows counts; one that tells nothing may have all."""
    rover = RobotInfo(id="rover_1", kind="zenoh", uses=("base",), verbs=("goto",))
    assert lacks(rover, ("base",), ("goto",)) == ""
    assert lacks(rover, ("base", "arm"), ()) == "rover_1 has no arm"
    assert lacks(rover, (), ("grasp",)) == "rover_1 does not know grasp"
    assert lacks(RobotInfo(id="r", kind="zenoh"), ("arm",), ("grasp",)) == ""
