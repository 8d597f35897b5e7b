"""What a vehicle's verbs are made of, against the simulated autopilot on the other side of a link without a network."""

import asyncio
import contextlib
import math
from collections.abc import AsyncIterator, Container
from typing import Any

import pytest

from appliance.model import Box, Pose, Site
from appliance.model.geo import to_globe
from appliance.robots.mavlink import dialect
from appliance.robots.mavlink.control import Seizure
from appliance.robots.mavlink.copter import Copter
from appliance.robots.mavlink.craft import Craft
from appliance.robots.mavlink.dialect import Codec, Frame, Message
from appliance.robots.mavlink.missions import Missions
from appliance.robots.mavlink.modes import COPTER
from appliance.robots.mavlink.payload import Payload
from appliance.robots.mavlink.protocol import command
from appliance.robots.mavlink.vehicle import Vehicle
from appliance.robots.settings import RobotsConfig
from appliance.robots.sim import orders
from appliance.robots.sim.copter import SimCopter
from appliance.robots.sim.flight import Point
from appliance.robots.verbs import GimbalArgs, MissionArgs, MissionStep, RobotFailure, TakeoffArgs

pytestmark = pytest.mark.anyio
_EVERY_S = 0.02


class Flown:
    """A copter that time passes for, and the craft that commands it; what is sent to it is kept."""

    def __init__(self) -> None:
        self.sim = SimCopter(system=1, site=Site(), home=(0.0, 0.0))
        self.sent: list[Message] = []
        self.silent = False
        self.placed = False
        """Its positions are told by the test alone (`tell`)."""
        self.standing = False
        """Whether time stands still for what flies; it answers and tells of itself all the same."""
        self._up, self._down = Codec(242, 191), Codec(1, 1)
        self.vehicle = Vehicle("drone_1", site=Site(), send=self._send, own=242)
        self.craft = Craft(self.vehicle, site=Site(), config=RobotsConfig(ack_timeout_s=0.2))
        self.vehicle.online = True

    def _send(self, message: Message) -> None:
        self.sent.append(message)
        asyncio.get_running_loop().call_soon(self._arrive, self._up.pack(message))

    def _arrive(self, raw: bytes) -> None:
        (frame,) = self._up.read(raw)
        assert isinstance(frame, Frame)
        self.say(self.sim.handle(frame, asyncio.get_running_loop().time()))

    def say(self, messages: list[Message]) -> None:
        """Let the vehicle say something, unless it is silent."""
        if not self.silent:
            self.hear(messages)

    def hear(self, messages: list[Message]) -> None:
        """Hear what it says, or said before."""
        for each in messages:
            (frame,) = self._down.read(self._down.pack(each))
            assert isinstance(frame, Frame)
            self.vehicle.hear(frame, asyncio.get_running_loop().time())

    async def live(self) -> None:
        """Let time pass, ten times as fast, with heartbeats and positions."""
        loop = asyncio.get_running_loop()
        while True:
            passed_s = 0.0 if self.standing else _EVERY_S * 10
            self.say([*self.sim.step(passed_s, loop.time()), self.sim.heartbeat(), self.sim.mission_current()])
            if not self.placed:
                self.say([self.sim.requested(dialect.constant("MAVLINK_MSG_ID_GLOBAL_POSITION_INT"))])
            await asyncio.sleep(_EVERY_S)

    def tell(self, x: float, y: float, at_s: float) -> None:
        """Say that it was there, five metres up, at that time of its own clock."""
        latitude, longitude, altitude = to_globe(Site(), x, y, 5.0)
        where = {"lat": round(latitude * 1e7), "lon": round(longitude * 1e7), "alt": round(altitude * 1e3)}
        moving = {"vx": 0, "vy": 0, "vz": 0, "hdg": 0}
        at_ms = round(at_s * 1000)
        self.hear([dialect.make("GLOBAL_POSITION_INT", time_boot_ms=at_ms, relative_alt=5000, **where, **moving)])

    def commands(self, number: int) -> list[Message]:
        """Return the commands of that number that were sent to it."""
        kinds = ("COMMAND_LONG", "COMMAND_INT")
        return [each for each in self.sent if each.get_type() in kinds and each.command == number]

    async def until_still(self) -> None:
        """Give it the time in which it would have gone on."""
        await asyncio.sleep(0.5)

    async def arm(self) -> None:
        """Arm it in GUIDED."""
        await self.craft.mode("GUIDED")
        await self.craft.arm()


@pytest.fixture
async def flown() -> AsyncIterator[Flown]:
    """A copter on the ground."""
    each = Flown()
    life = asyncio.create_task(each.live())
    await asyncio.sleep(_EVERY_S)
    yield each
    life.cancel()
    await asyncio.wait([life])


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
    control.seized = Seizure("failsafe", "battery critical")
    with pytest.raises(RobotFailure, match="battery critical"):
        await flown.craft.mode("BRAKE")
    await flown.craft.mode("LAND", safe=True)
    assert flown.vehicle.mode == "LAND"
    control.seized = Seizure("pilot", "somebody flies it")
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
    """What turns a gimbal may turn its vehicle: once a pilot has taken over it is not sent again, nor anew."""
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


async def test_what_goes_through_a_narrow_area_between_two_looks_is_stopped(flown: Flown) -> None:
    """It was on one side of a wall and is on the other, and no look found it inside."""
    flown.craft.site = Site(forbidden=(Box(name="the line", x=(-50.0, 50.0), y=(10.0, 10.05)),))
    await flown.arm()
    flown.sim.flight.position = flown.sim.flight.target = Point(0.0, 5.0, 5.0)
    assert await flown.craft.confirm(lambda: abs(flown.craft.position().y - 5.0) < 1.0)
    way = _Endless()
    going = asyncio.create_task(way.travel(flown.craft))
    assert await flown.craft.confirm(lambda: way.looks > 0)
    flown.sim.flight.position = flown.sim.flight.target = Point(0.0, 15.0, 5.0)
    with pytest.raises(RobotFailure, match="stopped during goto: it went through the line") as caught:
        await going
    assert caught.value.failure.code == "refused"


class _Endless:
    """A way that never ends by itself; how often it was looked at is counted."""

    def __init__(self) -> None:
        self.looks = 0
        self.over: int | None = None
        """It has arrived after so many looks."""

    def left(self) -> float:
        """Return what is left, as a look at the way asks for it."""
        self.looks += 1
        return 100.0

    async def travel(self, craft: Craft) -> None:
        """Be under way."""
        await craft.travel("goto", "GUIDED", lambda: self.over is not None and self.looks >= self.over, self.left)


Told = list[tuple[float, float, float]]
"""Where it says that it was: x, y, and the time of its own clock in seconds."""
_HANGAR = Box(name="the hangar", x=(0.0, 40.0), y=(0.0, 40.0))


async def _goes(flown: Flown, area: Box, told: Told) -> None:
    """Be under way for some looks; all but the first position is heard at once, between two of them."""
    flown.craft.site = Site(forbidden=(area,))
    await flown.arm()
    flown.placed = True
    flown.tell(*told[0])
    way = _Endless()
    going = asyncio.create_task(way.travel(flown.craft))
    assert await flown.craft.confirm(lambda: way.looks > 0)
    for each in told[1:]:
        flown.tell(*each)
    way.over = way.looks + 2
    await going


def _past_the_corner(every_s: float, *, first_s: float = 0.0, missing: Container[int] = ()) -> Told:
    """Along (0, 30), (0, 0), (30, 0) at 5 m/s, without the reports of those numbers; at the corner after 6 s."""
    times = [first_s + number * every_s for number in range(round(12.0 / every_s)) if number not in missing]
    return [(max(5.0 * time - 30.0, 0.0), max(30.0 - 5.0 * time, 0.0), 1000.0 + time) for time in times]


@pytest.mark.parametrize(
    "told",
    [
        pytest.param(_past_the_corner(0.2), id="5 Hz"),
        pytest.param(_past_the_corner(0.2, missing=(29, 30, 31)), id="three of 5 Hz lost"),
        pytest.param(_past_the_corner(1.0), id="1 Hz"),
        pytest.param(_past_the_corner(1.0, first_s=0.5), id="1 Hz, none at the corner"),
        pytest.param([(-3.0, 5.0, 1000.0), (5.0, -3.0, 1003.0)], id="an outage of 3 s"),
        pytest.param([(-3.0, 20.0, 1000.0), (43.0, 20.0, 1030.0)], id="the other side after an outage"),
        pytest.param([(-3.0, 20.0, 1000.0), (43.0, 20.0, 1.0)], id="a clock that began anew"),
    ],
)
async def test_a_gap_in_the_positions_is_no_flight_through_an_area(flown: Flown, told: Told) -> None:
    """It went round the corner as it was allowed to, and told so seldom: it goes on."""
    await _goes(flown, _HANGAR, told)
    assert not [each for each in flown.sent if each.get_type() == "SET_POSITION_TARGET_LOCAL_NED"]


@pytest.mark.parametrize(
    "told",
    [
        pytest.param([(-5.0, 10.0, 1000.0), (5.0, 10.0, 1003.0)], id="after an outage"),
        pytest.param([(-2.0, 2.0, 1000.0), (2.0, 2.0, 1001.0), (2.0, -2.0, 1002.0)], id="for a moment"),
    ],
)
async def test_what_was_inside_an_area_is_stopped(flown: Flown, told: Told) -> None:
    """However long nothing was heard before, and where it had left again before anybody looked."""
    with pytest.raises(RobotFailure, match="stopped during goto: it is in the hangar") as caught:
        await _goes(flown, _HANGAR, told)
    assert caught.value.failure.code == "refused"


async def test_a_thin_wall_is_not_crossed_unseen_though_nobody_looked_in_time(flown: Flown) -> None:
    """Told at 5 Hz and heard all at once: the times of the reports count, not that of looking."""
    told = [(number - 5.5, 20.0, 1000.0 + number * 0.2) for number in range(12)]
    with pytest.raises(RobotFailure, match="stopped during goto: it went through the line"):
        await _goes(flown, Box(name="the line", x=(0.0, 0.02), y=(0.0, 40.0)), told)


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
