"""What a task would cost each robot: way, time, work that waits, battery, hands; and which one is taken."""

import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.model import Place, Pose, RobotInfo, RobotLimits, Site, Subtask, SubtaskRecord
from appliance.tasks.allocation import Cost, best_first, choose, cost, used_percent
from appliance.tasks.placement import candidates
from appliance.tasks.settings import BatteryConfig

SITE = Site(
    places={
        "home": Place(x=0.0, y=0.0),
        "shelf": Place(x=100.0, y=0.0),
        "charger 1": Place(x=100.0, y=5.0),
    },
    speed_limit_mps=2.0,
)
BATTERY = BatteryConfig(reserve_percent=20.0, range_m=1000.0, lasts_s=5000.0, flies_s=500.0)
ROVER = RobotInfo(id="rover_1", kind="zenoh", pose=Pose(x=0.0, y=0.0), battery_percent=50.0)


def go(place: str = "shelf", robot: str = "any") -> Subtask:
    """Return a subtask that goes somewhere."""
    return Subtask(id="s1", skill="goto", robot=robot, params={"place": place})


def reckon(robot: RobotInfo, *subtasks: Subtask, queue_s: float = 0.0) -> Cost:
    """Return what subtasks cost a robot."""
    return cost(robot, subtasks, queue_s=queue_s, site=SITE, expected=lambda _skill, _robot: None, battery=BATTERY)


def taken(*robots: RobotInfo, place: str = "shelf", queue_s: float = 0.0) -> tuple[str | None, str]:
    """Choose for `any` that goes somewhere; the first robot has `queue_s` of work to do before."""
    found, why = candidates(
        "any", [SubtaskRecord(subtask=go(place))], robots={each.id: each for each in robots}, uses={}, verbs={},
        busy=frozenset(),
        choose=lambda able, subtasks, behind, hindered: choose(
            [reckon(each, *subtasks, queue_s=queue_s if each is robots[0] else 0.0) for each in able], behind, hindered
        ),
    )  # fmt: skip
    return next(iter(found), None), why


def test_a_cost_is_way_time_and_charge() -> None:
    """100 m at 2 m/s: 10 % of the range and 1 % of the time that a battery lasts; work before it counts as time."""
    found = reckon(ROVER, go())
    assert (found.way_m, found.takes_s, found.queue_s) == (100.0, 50.0, 0.0)
    assert found.ends_percent == pytest.approx(39.0)
    later = reckon(ROVER, go(), queue_s=33.0)
    assert (later.queue_s, later.ends_s) == (33.0, 83.0)
    assert later.ends_percent == pytest.approx(39.0 - 0.66)


def test_its_own_range_counts_before_the_configured_one() -> None:
    """A robot that tells its range is reckoned by it; one that flies lasts shorter."""
    far = replace(ROVER, limits=RobotLimits(range_m=10_000.0))
    assert used_percent(far, 100.0, 0.0, BATTERY) == pytest.approx(1.0)
    assert used_percent(replace(ROVER, flies=True), 0.0, 50.0, BATTERY) == pytest.approx(10.0)


def test_the_nearer_robot_is_taken_and_the_reason_names_both() -> None:
    """Not the first by name; `task why` prints what each would have cost."""
    near = replace(ROVER, id="rover_2", pose=Pose(x=90.0, y=0.0))
    robot, why = taken(ROVER, near)
    assert robot == "rover_2"
    assert why.startswith("took rover_2 5 s, way 10 m, ends with 49 %; not rover_1 50 s, way 100 m"), why


def test_work_that_waits_counts_as_its_time() -> None:
    """A near robot with much to do comes after a free one further away."""
    near, far = replace(ROVER, pose=Pose(x=90.0, y=0.0)), replace(ROVER, id="rover_2")
    assert taken(near, far)[0] == "rover_1"
    assert taken(near, far, queue_s=60.0)[0] == "rover_2"


def test_no_robot_is_taken_that_would_end_below_its_reserve() -> None:
    """The nearer one is passed over, and when none is left the task waits, with the reason of each."""
    near = replace(ROVER, id="rover_2", pose=Pose(x=90.0, y=0.0), battery_percent=20.5)
    robot, why = taken(ROVER, near)
    assert robot == "rover_1"
    assert "rover_2 would end with 19.4 % of its battery, below the reserve of 20 %" in why
    robot, why = taken(replace(ROVER, battery_percent=25.0), near)
    assert robot is None
    assert "rover_1 would end with 14 %" in why
    assert "rover_2 would end with 19.4 %" in why


def test_a_way_to_the_charger_may_use_the_reserve() -> None:
    """Else a robot that is low could never be sent to charge."""
    low = replace(ROVER, battery_percent=15.0)
    assert taken(low, place="charger 1")[0] == "rover_1"
    dock = Subtask(id="s1", skill="dock", robot="rover_1")
    assert "below the reserve" in reckon(low, dock).short, "the site has no place `charger`"
    assert reckon(low, replace(dock, params={"station": "charger 1"})).short == ""
    assert "below the reserve" in reckon(low, replace(go(), params={})).short


def test_a_robot_that_charges_is_taken_when_it_has_charged_enough() -> None:
    """With `auto_charge`: one at a charger is passed over up to that charge; it may be sent to charge on."""
    battery = replace(BATTERY, auto_charge=True, charged_percent=80.0)

    def why(robot: RobotInfo, subtask: Subtask, battery: BatteryConfig = battery) -> str:
        return cost(robot, [subtask], site=SITE, expected=lambda _skill, _robot: None, battery=battery).charging

    robot = replace(ROVER, pose=Pose(x=100.5, y=5.0), battery_percent=79.0)
    assert why(robot, go()) == "rover_1 charges at charger 1, until it has 80 %"
    assert why(robot, go("charger 1")) == ""
    assert why(robot, go(), BATTERY) == ""
    assert why(replace(robot, battery_percent=80.0), go()) == ""
    assert why(replace(robot, pose=Pose(x=102.0, y=5.0)), go()) == ""
    costs = [cost(robot, [go()], site=SITE, expected=lambda _skill, _robot: None, battery=battery)]
    assert choose(costs, {}, {}) == ([], "waits for a robot: rover_1 charges at charger 1, until it has 80 %")


def test_a_battery_that_is_not_told_is_not_judged() -> None:
    """Nor one while the reserve is 0."""
    assert reckon(replace(ROVER, battery_percent=None), go()).short == ""
    none = replace(BATTERY, reserve_percent=0.0)
    low = replace(ROVER, battery_percent=1.0)
    assert not cost(low, [go()], site=SITE, expected=lambda _skill, _robot: None, battery=none).short


def test_hands_that_are_full_come_last_but_for_putting_down() -> None:
    """A robot that holds something is taken last; to put something down one that holds it comes first."""
    full, empty = replace(ROVER, holding="box"), replace(ROVER, id="rover_2")
    assert taken(full, empty)[0] == "rover_2"
    put = Subtask(id="s1", skill="place", robot="any", params={"place": "shelf"})
    costs = [reckon(each, put) for each in (empty, full)]
    assert [each.robot for each in best_first(costs, last=lambda _: (False, False))] == ["rover_1", "rover_2"]


ROBOTS = st.builds(
    RobotInfo,
    id=st.sampled_from([f"r{number}" for number in range(6)]),
    kind=st.just("zenoh"),
    pose=st.none() | st.builds(Pose, x=st.floats(-200, 200), y=st.floats(-200, 200)),
    battery_percent=st.none() | st.floats(0, 100),
    flies=st.booleans(),
    holding=st.sampled_from(["", "box"]),
)


@given(st.lists(ROBOTS, min_size=1, max_size=6, unique_by=lambda each: each.id), st.randoms())
def test_whoever_is_taken_keeps_its_reserve(robots: list[RobotInfo], dice: random.Random) -> None:
    """Over any fleet, in any order of the roster: the same robot, never one that is short, never none needlessly."""
    robot, why = taken(*robots)
    mixed = list(robots)
    dice.shuffle(mixed)
    assert taken(*mixed)[0] == robot
    costs = {each.id: reckon(each, go()) for each in robots}
    assert all(math.isfinite(each.ends_s) and each.ends_s >= 0 for each in costs.values())
    assert (robot is None) == all(each.short for each in costs.values())
    if robot is not None:
        assert not costs[robot].short
        ends = costs[robot].ends_percent
        assert ends is None or ends >= BATTERY.reserve_percent
        assert why
