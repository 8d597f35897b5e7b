"""Which robots a dry run simulates, and how; the map is given on whole."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import RefusedError
from appliance.model import Plan, Pose, Proposal, RobotInfo, Subtask, TaskRecord
from appliance.skills.sites import SITES, load_site, site_text
from workshop.dry_run import MOST_ROBOTS, plan_of, simulated

SITE = load_site("warehouse")
NAMES = st.sets(st.from_regex(r"[a-z]{1,6}_[0-9]", fullmatch=True), min_size=1, max_size=20)


def robot(name: str, **fields: object) -> RobotInfo:
    """Return a mobile robot that stands at (3, 4)."""
    return RobotInfo(**{"id": name, "kind": "zenoh", "pose": Pose(x=3.0, y=4.0)} | fields)  # pyright: ignore[reportArgumentType]


def plan(*robots: str) -> Plan:
    """Return a plan with a subtask for each robot."""
    return Plan(
        domain="ground",
        subtasks=tuple(
            Subtask(id=f"s{at}", skill="goto", robot=name, params={"to": "dock 1"}) for at, name in enumerate(robots)
        ),
    )


@given(NAMES, st.data())
def test_robots_of_the_plan_come_first(names: set[str], data: st.DataObject) -> None:
    """All of them are simulated or it is refused, others as far as there is room; who is left out is named."""
    named = data.draw(st.sets(st.sampled_from(sorted(names))))
    robots = {name: robot(name) for name in names}
    if len(named) > MOST_ROBOTS:
        with pytest.raises(RefusedError, match="cannot be simulated"):
            simulated(plan(*named), robots, SITE)
        return
    chosen, differs = simulated(plan(*named), robots, SITE)
    assert named <= {each.name for each in chosen} <= names
    assert len(chosen) == min(len(names), MOST_ROBOTS)
    assert len(differs) == len(names) - len(chosen)


def test_a_robot_is_simulated_as_it_is() -> None:
    """Its kind, place, home, charge and load."""
    robots = {
        "rover_1": robot("rover_1", battery_percent=42.0, holding="red box", home=Pose(x=1.0, y=2.0)),
        "drone_1": robot("drone_1", kind="mavlink", flies=True, pose=Pose(x=5.0, y=6.0, z=8.0)),
        "car_1": robot("car_1", kind="mavlink"),
    }
    chosen, differs = simulated(plan("rover_1"), robots, SITE)
    found = {each.name: each for each in chosen}
    assert {name: each.kind for name, each in found.items()} == {
        "rover_1": "mobile", "drone_1": "copter", "car_1": "rover"
    }  # fmt: skip
    rover = found["rover_1"]
    assert (rover.at, rover.start, rover.battery_percent, rover.holding) == (
        "3.000, 4.000",
        "1.000, 2.000",
        42.0,
        "red box",
    )
    assert found["drone_1"].at == "5.000, 6.000"
    assert differs == ("drone_1 flies; simulated, it begins on the ground below",)


def test_a_robot_without_position_is_not_guessed() -> None:
    """One of the plan: refused, with what does without; another: named."""
    robots = {"rover_1": robot("rover_1", pose=None), "rover_2": robot("rover_2")}
    with pytest.raises(RefusedError, match="position is not known") as refused:
        simulated(plan("rover_1"), robots, SITE)
    assert "estimate" in refused.value.remedy
    assert simulated(plan("rover_2"), robots, SITE)[1] == ("without rover_1: its position is not known",)


def test_the_plan_that_waits_is_meant() -> None:
    """Else the one that runs; without any it is refused."""
    first, second = plan("rover_1"), plan("rover_2")
    record = TaskRecord(id="t", instruction="go", plan=first)
    assert plan_of(record) == first
    waiting = Proposal(plan=second, waits=True, hash="h" * 64)
    assert plan_of(TaskRecord(id="t", instruction="go", plan=first, proposal=waiting)) == second
    with pytest.raises(RefusedError, match="no plan yet"):
        plan_of(TaskRecord(id="t", instruction="go"))


@pytest.mark.parametrize("name", sorted(each.stem for each in SITES.glob("*.toml")))
def test_a_site_that_is_written_is_read_again(name: str, tmp_path: Path) -> None:
    """As a file it is the same map."""
    site = load_site(name)
    file = tmp_path / "site.toml"
    file.write_text(site_text(site))
    assert load_site(file) == site
