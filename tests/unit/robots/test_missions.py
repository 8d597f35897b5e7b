"""Homes and missions of a vehicle, against the simulated autopilot: begun, gone on with, named by their items."""

import asyncio
import contextlib
import math
from typing import Any

import pytest

from appliance.model import Box, Pose, Site
from appliance.robots.mavlink import dialect
from appliance.robots.mavlink.dialect import Message
from appliance.robots.mavlink.missions import Missions
from appliance.robots.mavlink.protocols import command
from appliance.robots.mavlink.vehicle import COPTER
from appliance.robots.verbs import MissionArgs, MissionStep, RobotFailure
from tests.unit.robots.flown import Flown
from workshop.robots import orders
from workshop.robots.flight import Point

pytestmark = pytest.mark.anyio


async def _give_up(flying: "asyncio.Task[Any]") -> None:
    flying.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await flying


async def test_a_home_is_told_when_it_is_known(flown: Flown) -> None:
    """In metres of the site, as the vehicle has told it; before that none is."""
    assert flown.vehicle.info("gw-1", ()).home is None
    flown.hear([flown.sim.requested(dialect.constant("MAVLINK_MSG_ID_HOME_POSITION"))])
    home = flown.vehicle.info("gw-1", ()).home
    assert home is not None
    assert math.dist(_across(home), (0.0, 0.0)) < 0.1


async def test_a_new_mission_begins_at_its_beginning(flown: Flown) -> None:
    """One that was stopped half-way keeps its item in the autopilot; the next is flown from its first point."""
    missions = Missions(flown.craft)
    await flown.arm()
    first = asyncio.create_task(missions.fly("goto", [(0.0, 20.0, 5.0), (20.0, 20.0, 5.0), (400.0, 20.0, 5.0)], None))
    # Home, take-off, speed, then the points.
    assert await flown.craft.confirm(lambda: flown.sim.at == 5 and flown.vehicle.airborne, within_s=20.0)
    await _give_up(first)
    await flown.craft.halt()
    far = [(60.0, -400.0, 5.0), (0.0, 0.0, 5.0), (5.0, 5.0, 5.0), (9.0, 9.0, 5.0), (12.0, 12.0, 5.0)]
    second = asyncio.create_task(missions.fly("goto", far, None))
    assert await flown.craft.confirm(lambda: len(flown.sim.mission) == 7 and flown.sim.running, within_s=20.0)
    # Home, speed, then the points: the first is far away.
    assert flown.sim.at == 2
    await _give_up(second)


async def test_a_mission_that_cannot_be_started_does_not_fly(flown: Flown, monkeypatch: pytest.MonkeyPatch) -> None:
    """The autopilot took the mode and declines the start: it is halted, and the failure is the autopilot's."""
    entered: list[str] = []
    enter = flown.sim.enter
    monkeypatch.setattr(flown.sim, "enter", lambda name: (entered.append(name), enter(name)))
    monkeypatch.setattr(orders, "_start", lambda *_: dialect.FAILED)
    await flown.arm()
    with pytest.raises(RobotFailure, match="MISSION_START with FAILED"):
        await Missions(flown.craft).fly("goto", [(0.0, 20.0, 5.0)], None)
    assert entered[-2:] == ["AUTO", "GUIDED"]
    await flown.until_still()
    assert flown.sim.flight.landed


async def test_an_autopilot_that_knows_no_command_for_the_item_gets_the_message(
    flown: Flown, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Older firmware answers UNSUPPORTED: the item is set by MISSION_SET_CURRENT, and the mission flies."""
    real = orders._do
    monkeypatch.setattr(
        orders, "_do", lambda *given: dialect.UNSUPPORTED if given[1] == dialect.SET_CURRENT else real(*given)
    )
    await flown.arm()
    await Missions(flown.craft).fly("goto", [(0.0, 10.0, 5.0)], None)
    assert [each.seq for each in flown.sent if each.get_type() == "MISSION_SET_CURRENT"] == [1]
    assert abs(flown.sim.flight.position.y - 10.0) < 2.0


async def test_a_message_for_the_item_is_repeated_until_it_is_confirmed(
    flown: Flown, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Lost twice it is sent again; never confirmed the mission is not begun, which would fly from anywhere."""
    real, deliver = orders._do, flown.vehicle.send
    monkeypatch.setattr(
        orders, "_do", lambda *given: dialect.UNSUPPORTED if given[1] == dialect.SET_CURRENT else real(*given)
    )
    lost = 2

    def send(message: Message) -> None:
        nonlocal lost
        if message.get_type() == "MISSION_SET_CURRENT" and lost:
            lost -= 1
            flown.sent.append(message)
            return
        deliver(message)

    monkeypatch.setattr(flown.vehicle, "send", send)
    await flown.arm()
    await Missions(flown.craft).fly("goto", [(0.0, 10.0, 5.0)], None)
    assert [each.seq for each in flown.sent if each.get_type() == "MISSION_SET_CURRENT"] == [1] * 3
    lost = 1000
    flown.sent.clear()
    with pytest.raises(RobotFailure, match="did not confirm mission item 1 in 8 tries") as caught:
        await Missions(flown.craft).fly("goto", [(0.0, 20.0, 5.0)], None)
    assert caught.value.failure.retryable
    assert not [each for each in flown.commands(dialect.SET_MODE) if each.param2 == COPTER.numbers["AUTO"]]
    assert not flown.commands(dialect.MISSION_START)


@pytest.mark.parametrize("anew", [True, False])
async def test_a_mission_is_gone_on_with_by_an_autopilot_that_begins_anew(flown: Flown, anew: bool) -> None:
    """MIS_RESTART = 1: the item is said again once it flies; without it that is not done, nor any act twice."""
    steps = (MissionStep(0.0, 30.0, 5.0, act="photo"), MissionStep(30.0, 30.0, 5.0), MissionStep(30.0, 0.0, 5.0))
    missions = Missions(flown.craft)
    await flown.arm()
    flying = asyncio.create_task(missions.mission(MissionArgs(steps=steps)))
    # Home, take-off, speed, the first point and its picture, then the second point.
    assert await flown.craft.confirm(lambda: flown.sim.at == 5 and flown.vehicle.airborne, within_s=20.0)
    await _give_up(flying)
    await flown.craft.halt()
    flown.sim.parameters.values["MIS_RESTART"] = float(anew)
    flown.sent.clear()
    done = await missions.mission(MissionArgs(steps=steps))
    assert done.result["resumed_at"] == 5
    assert [each.param1 for each in flown.commands(dialect.SET_CURRENT)] == [5.0] * (2 if anew else 1)
    assert flown.sim.pictures == 1
    assert flown.craft.distance((30.0, 0.0, 5.0)) < 3.0


@pytest.mark.parametrize("anew", [True, False])
async def test_a_mission_that_is_flown_all_the_while_is_told_no_item(flown: Flown, anew: bool) -> None:
    """A gateway was restarted, the vehicle flew on: nothing is said that could bring it back to what it has passed."""
    steps = (MissionStep(0.0, 30.0, 5.0, act="photo"), MissionStep(30.0, 30.0, 5.0, act="photo"))
    missions = Missions(flown.craft)
    await flown.arm()
    flown.sim.parameters.values["MIS_RESTART"] = float(anew)
    flying = asyncio.create_task(missions.mission(MissionArgs(steps=steps)))
    assert await flown.craft.confirm(lambda: flown.sim.at == 5 and flown.vehicle.airborne, within_s=20.0)
    await _give_up(flying)
    flown.sent.clear()
    done = await missions.mission(MissionArgs(steps=steps))
    assert done.result["resumed_at"] >= 5
    assert not flown.commands(dialect.SET_CURRENT)
    assert flown.sim.pictures == 2


async def test_a_start_names_no_items(flown: Flown) -> None:
    """ArduPilot denies a start that names a first or last item: the mission flies since none is named."""
    await flown.arm()
    await Missions(flown.craft).fly("goto", [(0.0, 10.0, 5.0)], None)
    (start,) = [each for each in flown.sent if getattr(each, "command", 0) == dialect.MISSION_START]
    assert (start.param1, start.param2) == (0, 0)
    with pytest.raises(RobotFailure, match="DENIED"):
        await command(flown.vehicle, dialect.MISSION_START, 2.0, 0.0, patience=flown.craft.patience)


async def test_a_mission_is_gone_on_with_by_an_allowed_way_alone(flown: Flown) -> None:
    """Left half-way and brought elsewhere: the leg from there is looked at, not the legs that are behind."""
    flown.craft.site = Site(forbidden=(Box(name="the pit", x=(40.0, 60.0), y=(-10.0, 10.0)),))
    steps = (MissionStep(0.0, 30.0, 5.0), MissionStep(30.0, 30.0, 5.0), MissionStep(30.0, 0.0, 5.0))
    missions = Missions(flown.craft)
    await flown.arm()
    flying = asyncio.create_task(missions.mission(MissionArgs(steps=steps)))
    assert await flown.craft.confirm(lambda: flown.sim.at == 5 and flown.vehicle.airborne, within_s=20.0)
    await _give_up(flying)
    await flown.craft.halt()

    async def bring(x: float, y: float) -> None:
        flown.sim.flight.position = flown.sim.flight.target = Point(x, y, 5.0)
        assert await flown.craft.confirm(lambda: math.dist((x, y), _across(flown.craft.position())) < 1.0)

    await bring(90.0, 0.0)
    with pytest.raises(RobotFailure, match="the leg to waypoint 3 goes through the pit"):
        await missions.mission(MissionArgs(steps=steps))
    assert flown.vehicle.mode == "GUIDED"
    await bring(30.0, -30.0)
    done = await missions.mission(MissionArgs(steps=steps))
    assert done.result["resumed_at"] == 5
    assert flown.craft.distance((30.0, 0.0, 5.0)) < 3.0


def _across(pose: Pose) -> tuple[float, float]:
    return pose.x, pose.y
