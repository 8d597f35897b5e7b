"""Who obeys: the review of plans, the choice of robots, commands, alerts, the list of robots, the terminal UI."""

from typing import TYPE_CHECKING, Any

import pytest

from appliance.alerts.rules import Facts, findings
from appliance.llm.checks.safety import unsafe
from appliance.llm.settings import OutOfUse, PlanContext, SafetyConfig
from appliance.model import Place, Plan, RobotCommand, RobotInfo, Site, Subtask
from appliance.robots.authority.authority import Authority
from appliance.skills.catalogue import load_catalogue
from tests.unit.tasks.fake_plane import FakePlane

if TYPE_CHECKING:
    from appliance.skills.catalogue import Catalogue

SITE = Site(places={"dock 2": Place(x=1.0, y=2.0, aliases=("second dock",)), "home": Place(x=0.0, y=0.0)})
ROBOTS = (RobotInfo(id="rover_1", kind="zenoh"), RobotInfo(id="rover_2", kind="zenoh"))


@pytest.fixture(scope="module")
def catalogue() -> "Catalogue":
    """Return the product's skills."""
    return load_catalogue()


@pytest.mark.parametrize(
    ("subtask", "says"),
    [
        (Subtask(id="s1", skill="goto", robot="rover_1", params={"place": "dock 2"}), "'dock 2' is closed by ann"),
        (Subtask(id="s1", skill="goto", robot="rover_1", params={"place": "the second dock"}), "closed by ann"),
        (Subtask(id="s1", skill="goto", robot="rover_1", params={"place": "1, 2"}), "closed by ann"),
        (Subtask(id="s1", skill="goto", robot="rover_2", params={"place": "home"}), "rover_2 is in maintenance"),
        (Subtask(id="s1", skill="goto", robot="rover_1", params={"place": "home"}), ""),
        (Subtask(id="s1", skill="report", params={"text": "dock 2"}), ""),
    ],
)
def test_the_review_refuses_what_is_out_of_use(subtask: Subtask, says: str, catalogue: "Catalogue") -> None:
    """A closed place by each of its names and its coordinates, a robot by its name; with who, why and what to do."""
    closed = OutOfUse(places={"dock 2": "closed by ann: wet"}, robots={"rover_2": "in maintenance by ann"})
    context = PlanContext(instruction="", robots=ROBOTS, site=SITE, out_of_use=closed)
    found = unsafe(Plan(domain="any", subtasks=(subtask,)), context, catalogue, SafetyConfig())
    if not says:
        assert found == ()
        return
    assert says in found[0]
    assert "choose another, or wait" in found[0]


def test_no_task_commands_a_robot_in_maintenance() -> None:
    """Its operator does, by taking it over; and it may always be stopped."""
    plane: Any = FakePlane()
    authority = Authority(plane, out_of_use=lambda robot: "in maintenance" if robot == "rover_1" else "")
    assert authority.hindrance("rover_1") == "in maintenance"
    assert authority.hindrance("rover_2") == ""
    move = RobotCommand(id="c", verb="goto", args={})
    assert authority.refuses("rover_1", move) == "in maintenance"
    assert authority.refuses("rover_2", move) == ""
    for verb in ("stop", "hold", "state"):
        assert authority.refuses("rover_1", RobotCommand(id="c", verb=verb, args={})) == ""


def test_what_is_wrong_with_a_robot_in_maintenance_is_no_alert() -> None:
    """It is known; that of others stands."""
    robots = {name: RobotInfo(id=name, kind="zenoh", online=False) for name in ("rover_1", "rover_2")}
    found = findings(Facts(robots=robots, in_maintenance=frozenset({"rover_1"})))
    assert set(found) == {"robot-offline.rover_2"}
