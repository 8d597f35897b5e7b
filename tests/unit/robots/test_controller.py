"""What a vehicle's verbs are made of, against the simulated autopilot: halts, and what a pilot or a failsafe keeps."""

import asyncio
from typing import Any

import pytest

from appliance.robots.mavlink import dialect
from appliance.robots.mavlink.command_dispatcher import Copter
from appliance.robots.mavlink.dialect import Message
from appliance.robots.mavlink.missions import Missions
from appliance.robots.mavlink.payload import Payload
from appliance.robots.mavlink.protocols import command
from appliance.robots.mavlink.vehicle import COPTER, PilotOverride
from appliance.robots.verbs import GimbalArgs, RobotFailure, TakeoffArgs
from tests.unit.robots.flown import Flown
from workshop.robots import orders

pytestmark = pytest.mark.anyio


async def test_a_halt_ends_a_take_off_that_has_not_left_the_ground(flown: Flown) -> None:
    """Armed in GUIDED with a take-off given: the mode is the right one already, and it stays on the ground."""
    await flown.arm()
    flown.standing = True
    flown.sim.flight.target = flown.sim.flight.position._replace(z=5.0)
    await flown.craft.halt()
    flown.standing = False
    await flown.until_still()
    assert flown.sim.flight.landed
    assert flown.sim.flight.target is None


async def test_a_halt_ends_a_climb_and_a_target_of_the_guided_mode(flown: Flown) -> None:
    """A take-off under way ends where it is, and so does a flight to a target; the same mode again does not do it."""
    await flown.arm()
    await command(flown.vehicle, dialect.TAKEOFF, 0, 0, 0, 0, 0, 0, 40.0, patience=flown.craft.patience)
    assert await flown.craft.confirm(lambda: flown.vehicle.relative_m > 3.0)
    await flown.craft.mode("GUIDED")
    assert flown.sim.flight.target is not None
    assert flown.sim.flight.target.z == 40.0
    await flown.craft.halt()
    await flown.until_still()
    assert flown.sim.flight.target.z < 39.0
    there = flown.sim.flight.position
    flown.craft.target(*flown.craft.globe_point(500.0, 0.0)[:2], there.z)
    assert await flown.craft.confirm(lambda: flown.sim.flight.position.x > 5.0)
    await flown.craft.halt()
    await flown.until_still()
    assert flown.sim.flight.target.x < 400.0
    assert flown.vehicle.custom_mode == COPTER.numbers["GUIDED"]


async def test_a_seized_vehicle_is_not_said_to_be_halted(flown: Flown) -> None:
    """A pilot flies it: the halt fails with who has it, and changes nothing; disarmed there is nothing to halt."""
    await flown.arm()
    await flown.craft.mode("GUIDED")
    flown.sim.set_mode(COPTER.numbers["LOITER"])
    assert await flown.craft.confirm(lambda: flown.vehicle.control.seized is not None)
    with pytest.raises(RobotFailure, match="was not halted") as caught:
        await flown.craft.halt()
    assert caught.value.failure.code == "taken"
    assert flown.vehicle.mode == "LOITER"
    flown.sim.disarm(force=True)
    assert await flown.craft.confirm(lambda: not flown.vehicle.armed)
    await flown.craft.halt()


async def test_a_vehicle_that_cannot_be_told_is_not_said_to_be_halted(flown: Flown) -> None:
    """Offline, armed when it was heard last: the halt fails and says so; back again it is halted."""
    await flown.arm()
    flown.vehicle.online = False
    with pytest.raises(RobotFailure, match="could not be told to hold: it is offline, and was armed") as caught:
        await flown.craft.halt()
    assert caught.value.failure.retryable
    flown.vehicle.online = True
    await flown.craft.halt()


@pytest.mark.parametrize("answered", [True, False])
async def test_a_pilot_who_takes_it_during_a_change_of_mode_keeps_it(
    flown: Flown, monkeypatch: pytest.MonkeyPatch, answered: bool
) -> None:
    """The mode is not sent again: neither after an acknowledgement, nor where the acknowledgement was lost."""
    real = orders.answer

    def answer(vehicle: Any, message: Message, sender: Any) -> list[Message]:
        if message.command != dialect.SET_MODE:
            return real(vehicle, message, sender)
        acks = [each for each in real(vehicle, message, sender) if each.get_type() == "COMMAND_ACK"]
        vehicle.set_mode(COPTER.numbers["LOITER"])  # before a heartbeat tells of the gateway's
        return acks if answered else []

    await flown.arm()
    monkeypatch.setattr(orders, "answer", answer)
    flown.sent.clear()
    with pytest.raises(RobotFailure, match="changed from RTL to LOITER") as caught:
        await flown.craft.mode("RTL")
    assert caught.value.failure.code == "taken"
    assert len(flown.commands(dialect.SET_MODE)) == 1
    with pytest.raises(RobotFailure, match="is not commanded"):
        await flown.craft.mode("RTL")
    assert len(flown.commands(dialect.SET_MODE)) == 1
    assert flown.vehicle.mode == "LOITER"
    assert flown.vehicle.control.seized is not None


async def test_a_failsafe_keeps_it_from_all_but_what_is_safe(flown: Flown, monkeypatch: pytest.MonkeyPatch) -> None:
    """Landing goes on under a failsafe, and a pilot ends that as well."""
    await flown.arm()
    control = flown.vehicle.control
    monkeypatch.setattr(control, "hear", lambda *_: False)
    control.seized = PilotOverride("failsafe", "battery critical")
    with pytest.raises(RobotFailure, match="battery critical"):
        await flown.craft.mode("BRAKE")
    await flown.craft.mode("LAND", safe=True)
    assert flown.vehicle.mode == "LAND"
    control.seized = PilotOverride("pilot", "somebody flies it")
    with pytest.raises(RobotFailure, match="somebody flies it"):
        await flown.craft.mode("RTL", safe=True)


async def test_what_a_person_chose_on_the_ground_is_not_armed(flown: Flown) -> None:
    """The mode was changed between the gateway's own and the arming: the motors stay off."""
    await flown.craft.mode("GUIDED")
    flown.sim.set_mode(COPTER.numbers["STABILIZE"])
    assert await flown.craft.confirm(lambda: flown.vehicle.mode == "STABILIZE")
    with pytest.raises(RobotFailure, match="changed to STABILIZE meanwhile") as caught:
        await flown.craft.arm()
    assert caught.value.failure.code == "taken"
    assert not flown.commands(dialect.ARM)
    assert not flown.sim.flight.armed


@pytest.mark.parametrize("verb", ["takeoff", "goto"])
async def test_a_pilot_who_takes_it_as_it_is_armed_keeps_it(
    flown: Flown, monkeypatch: pytest.MonkeyPatch, verb: str
) -> None:
    """Neither the take-off nor the mission's mode and start are sent to a vehicle that somebody has."""
    real = orders._do

    def do(vehicle: Any, number: int, *given: Any) -> int:
        result = real(vehicle, number, *given)
        if number == dialect.ARM:
            vehicle.set_mode(COPTER.numbers["LOITER"])
        return result

    monkeypatch.setattr(orders, "_do", do)
    missions = Missions(flown.craft)
    copter = Copter(flown.craft, missions)
    going = copter.takeoff(TakeoffArgs()) if verb == "takeoff" else missions.fly("goto", [(0.0, 20.0, 5.0)], None)
    with pytest.raises(RobotFailure, match="LOITER") as caught:
        await going
    assert caught.value.failure.code == "taken"
    assert not flown.commands(dialect.TAKEOFF)
    assert not flown.commands(dialect.MISSION_START)
    assert len(flown.commands(dialect.SET_MODE)) == 1  # GUIDED, before it was armed
    assert flown.vehicle.mode == "LOITER"


@pytest.mark.parametrize(
    ("args", "number"),
    [(GimbalArgs(x=5.0, y=5.0), dialect.LOOK_AT), (GimbalArgs(pitch_deg=-30.0), dialect.GIMBAL_ANGLES)],
)
async def test_a_pilot_who_takes_it_keeps_its_gimbal(
    flown: Flown, monkeypatch: pytest.MonkeyPatch, args: GimbalArgs, number: int
) -> None:
    """What turns a gimbal may turn its vehicle: once a pilot has taken over it is sent no more."""
    real = orders.answer

    def answer(vehicle: Any, message: Message, sender: Any) -> list[Message]:
        if message.command == number:
            vehicle.set_mode(COPTER.numbers["LOITER"])
            flown.say([vehicle.heartbeat()])
            return []
        if message.command in (dialect.REQUEST_MESSAGE, dialect.constant("MAV_CMD_DO_GIMBAL_MANAGER_CONFIGURE")):
            return [_accepted(message)]
        return real(vehicle, message, sender)

    monkeypatch.setattr(orders, "answer", answer)
    payload = Payload(flown.craft)
    await flown.arm()
    for times in (1, 1):
        with pytest.raises(RobotFailure, match="LOITER") as caught:
            await payload.gimbal(args)
        assert caught.value.failure.code == "taken"
        assert len(flown.commands(number)) == times


def _accepted(message: Message) -> Message:
    target = {"target_system": 242, "target_component": 191}
    return dialect.make(
        "COMMAND_ACK", command=message.command, result=dialect.ACCEPTED, progress=0, result_param2=0, **target
    )


async def test_a_vehicle_that_is_only_watched_is_not_said_to_be_halted(flown: Flown) -> None:
    """Armed, of a kind whose modes are not known here: nobody has halted it."""
    await flown.arm()
    flown.vehicle.autopilot = dialect.constant("MAV_AUTOPILOT_PX4")
    with pytest.raises(RobotFailure, match="was not halted: it is watched, not commanded"):
        await flown.craft.halt()


async def test_a_mode_is_confirmed_by_what_was_heard_after_it_was_asked_for(flown: Flown) -> None:
    """An acknowledgement and a mode of before do not do: silence after the order is a failure."""
    await flown.arm()
    flown.silent = True
    late = dialect.make(
        "COMMAND_ACK",
        command=dialect.SET_MODE,
        result=dialect.ACCEPTED,
        progress=0,
        result_param2=0,
        target_system=242,
        target_component=191,
    )
    changing = asyncio.create_task(flown.craft.mode("GUIDED"))
    await asyncio.sleep(0.05)
    flown.hear([late])
    await asyncio.sleep(0.3)
    assert not changing.done()
    flown.silent = False
    await changing
