"""The measurement by the size of the fleet: which plans are right, and that it has a row for each size."""

import pytest
from msgspec.structs import replace

from appliance.llm.settings import LlmConfig
from appliance.model import MAX_SUBTASKS, Plan, Subtask
from workshop.bench.plan.rosters import ORDERS, SIZES, Order, by_size, fleet, is_right

pytestmark = pytest.mark.anyio


def plan(*steps: tuple[str, str | None]) -> Plan:
    """Return a plan of skills and robots."""
    subtasks = tuple(Subtask(id=f"s{n}", skill=skill, robot=who, params={}) for n, (skill, who) in enumerate(steps, 1))
    return Plan(domain="navigation", subtasks=subtasks)


@pytest.mark.parametrize("size", SIZES)
def test_a_fleet_of_each_size_can_be_given_every_order(size: int) -> None:
    """So many robots, each once, and those that orders name among them."""
    names = [each.id for each in fleet(size)]
    assert len(set(names)) == len(names) == size
    assert {"rover_5", "drone_1"} <= set(names)


def test_each_of_a_group_and_no_other_is_right() -> None:
    """One drone too few, one robot too many, another skill: each is wrong."""
    order = Order("all drones return home", (("return_home", "drones"),))
    robots = fleet(8)
    drones = [("return_home", f"drone_{number}") for number in (1, 2, 3, 4)]
    assert is_right(order, plan(*drones), robots)
    assert not is_right(order, plan(*drones[1:]), robots)
    assert not is_right(order, plan(*drones, ("return_home", "rover_1")), robots)
    assert not is_right(order, plan(*drones[1:], ("land", "drone_1")), robots)
    assert not is_right(order, None, robots)


def test_no_plan_is_right_where_none_can_have_so_many_subtasks() -> None:
    """A plan for a part of a group is wrong where there are too many for one plan."""
    order = Order("all drones return home", (("return_home", "drones"),))
    robots = fleet(4 * MAX_SUBTASKS)
    assert is_right(order, None, robots)
    assert not is_right(order, plan(*(("return_home", f"drone_{n}") for n in range(1, MAX_SUBTASKS + 1))), robots)


def test_whoever_was_not_named_is_open_or_one_that_was_meant() -> None:
    """It is `any` for a robot, a drone for "a drone"."""
    anybody, drone = Order("", (("goto", "any"),)), Order("", (("goto", "a drone"),))
    robots = fleet(8)
    assert is_right(anybody, plan(("goto", "any")), robots)
    assert is_right(anybody, plan(("goto", "rover_2")), robots)
    assert is_right(drone, plan(("goto", "drone_3")), robots)
    assert not is_right(drone, plan(("goto", "rover_2")), robots)
    assert not is_right(drone, plan(("goto", "any")), robots)
    assert is_right(Order("", (("report", "-"),)), plan(("report", None)), robots)


async def test_there_is_a_row_for_each_size() -> None:
    """By the rules, which need no model: every order has an end, and what was planned its confidence."""
    rows = await by_size(replace(LlmConfig(), tiers=("rules",)), sizes=(2, 16), repeats=1)
    assert list(rows) == ["2", "16"]
    for each in rows.values():
        assert each["run"] + each["held"] + each["refused"] == each["orders"] == len(ORDERS)
        assert 0 <= each["confidence"]["least"] <= each["confidence"]["mean"] <= 1
        assert each["right"] >= 50
