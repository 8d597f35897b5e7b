"""What a MAVLink vehicle can be told, and what becomes of it when somebody else takes it: with real processes."""

import asyncio
import contextlib
import sys
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from pymavlink import mavutil

from appliance.model import Box, Failure, Place, RobotCommand, RobotInfo, RobotReply, Site, keyspace
from appliance.model.robot_api import MavlinkLink
from appliance.plane.session import Session
from appliance.plane.settings import PlaneConfig
from appliance.plane.store import Store
from appliance.robots.hub import RobotHub
from appliance.robots.sender import hold_robot, send_command
from appliance.robots.settings import RobotsConfig
from workshop.robots.mavlink import VehicleSettings

pytestmark = pytest.mark.anyio

SITE = Site(
    places={"home": Place(x=4.0, y=4.0)},
    fence=Box(name="the yard", x=(-10.0, 210.0), y=(-10.0, 60.0)),
    altitude_limit_m=30.0,
    speed_limit_mps=6.0,
)
_VEHICLE = """
import asyncio, sys, msgspec
from workshop.robots.mavlink import VehicleSettings, run_vehicle
asyncio.run(run_vehicle(msgspec.json.decode(sys.argv[1], type=VehicleSettings)))
"""


class Yard:
    """A hub with a link for vehicles and one for ground stations, a client, and what it saw."""

    def __init__(self, client: Session, vehicles: int, stations: int) -> None:
        self.client = client
        self.vehicles = vehicles
        self.stations = stations
        self.infos: list[RobotInfo] = []
        self.processes: list[asyncio.subprocess.Process] = []
        self.number = 0
        client.subscribe_typed(keyspace.ROBOT, self._info)

    def _info(self, _: str, info: RobotInfo | None) -> None:
        if info is not None:
            self.infos.append(info)

    @property
    def now(self) -> RobotInfo:
        """The newest roster entry."""
        return self.infos[-1]

    async def vehicle(self, **settings: Any) -> None:
        """Start a vehicle and wait until the roster has it online."""
        order = VehicleSettings(**({"to": f"udp://127.0.0.1:{self.vehicles}", "site": SITE, "rate": 4.0} | settings))
        self.processes.append(
            await asyncio.create_subprocess_exec(sys.executable, "-c", _VEHICLE, msgspec.json.encode(order).decode())
        )
        await until(lambda: any(each.online and each.pose for each in self.infos))

    async def tell(self, verb: str, **args: Any) -> RobotReply:
        """Give drone_1 a command."""
        self.number += 1
        command = RobotCommand(id=f"t/s/{self.number}", verb=verb, args=args, task="t", subtask="s", attempt=1)
        return await send_command(self.client, "drone_1", command, timeout_s=90.0)

    async def done(self, verb: str, **args: Any) -> dict[str, Any]:
        """Give drone_1 a command that must succeed; returns its result."""
        reply = await self.tell(verb, **args)
        assert reply.failure is None, reply.failure
        return reply.result

    async def fails(self, verb: str, **args: Any) -> Failure:
        """Give drone_1 a command that must fail; returns the failure."""
        reply = await self.tell(verb, **args)
        assert reply.failure is not None, reply.result
        return reply.failure

    async def station(self, *actions: Callable[[Any], None], until_heard: str = "COMMAND_ACK") -> None:
        """Do something as a ground station on the other link, once the vehicle has been heard there."""

        def act() -> None:
            ground = mavutil.mavlink_connection(f"tcp:127.0.0.1:{self.stations}", source_system=255)
            try:
                for _ in range(20):
                    # As a real station does, each second: the first may be taken for a repetition of the last one's.
                    ground.mav.heartbeat_send(6, 8, 0, 0, 4)
                    if ground.recv_match(
                        type="HEARTBEAT", condition="HEARTBEAT.autopilot==3", blocking=True, timeout=1
                    ):
                        break
                else:
                    raise AssertionError("the vehicle is not heard")
                for action in actions:
                    action(ground)
                    assert ground.recv_match(type=until_heard, blocking=True, timeout=20)
            finally:
                ground.close()

        await asyncio.to_thread(act)


def mode(number: int) -> Callable[[Any], None]:
    """Change the mode, as a pilot at a ground station does."""
    return lambda ground: ground.mav.command_long_send(1, 1, 176, 0, 1, number, 0, 0, 0, 0, 0)


def parameter(name: str, value: float) -> Callable[[Any], None]:
    """Write a parameter."""
    return lambda ground: ground.mav.param_set_send(1, 1, name.encode(), value, 9)


async def until(holds: Callable[[], object], limit_s: float = 40.0) -> None:
    """Wait for something to become true."""
    async with asyncio.timeout(limit_s):
        while not holds():
            await asyncio.sleep(0.02)


Open = Callable[..., Awaitable[Yard]]


@pytest.fixture
async def open_yard(free_ports: Callable[..., list[int]], tmp_path: Path) -> AsyncIterator[Open]:
    """Return a function that opens a yard; everything is closed afterwards."""
    async with contextlib.AsyncExitStack() as stack:
        plane, stations = free_ports(2)
        (vehicles,) = free_ports(1, udp=True)

        async def start(**changes: Any) -> Yard:
            session = await Session.open(PlaneConfig(listen=(f"tcp/127.0.0.1:{plane}",)), "yard")
            stack.push_async_callback(session.close)
            store = await Store.open(tmp_path / "store.sqlite")
            stack.push_async_callback(store.close)
            links = (
                MavlinkLink(listen=f"udp://127.0.0.1:{vehicles}"),
                MavlinkLink(listen=f"tcp://127.0.0.1:{stations}"),
            )
            hub = RobotHub(
                RobotsConfig(mavlink=links, **changes), session=session, store=store, gateway="gw-1", site=SITE
            )
            await hub.start()
            stack.push_async_callback(hub.stop)
            yard = Yard(session, vehicles, stations)
            stack.push_async_callback(_end, yard.processes)
            return yard

        yield start


async def _end(processes: list[asyncio.subprocess.Process]) -> None:
    for process in processes:
        if process.returncode is None:
            process.kill()
        await process.wait()


STEPS = [
    {"x": 14, "y": 4, "z": 8},
    {"x": 14, "y": 14, "z": 8, "hold_s": 2, "act": "photo"},
    {"x": 60, "y": 14, "z": 8},
]


async def test_a_mission_goes_on_where_it_was_left(open_yard: Open) -> None:
    """Held after its second step, the same mission given again continues there instead of from the beginning."""
    yard = await open_yard()
    await yard.vehicle()
    going = asyncio.create_task(yard.tell("mission", steps=STEPS, end="return"))
    await until(lambda: yard.now.mode == "AUTO" and yard.now.mission_item >= 6)
    held = await hold_robot(yard.client, "drone_1", why="the operator looks first", identity="hold-1")
    assert held.failure is None
    failure = (await going).failure
    assert failure is not None
    assert failure.code == "cancelled"
    assert "the operator looks first" in failure.message
    await until(lambda: yard.now.mode == "GUIDED")
    assert yard.now.pose is not None
    assert yard.now.pose.x > 13.0
    result = await yard.done("mission", steps=STEPS, end="return")
    assert result["resumed_at"] >= 6
    assert result["steps"] == 3
    assert not yard.now.armed or result["mode"] == "AUTO"


async def test_a_pilot_takes_over_and_gives_back(open_yard: Open) -> None:
    """A pilot's mode ends the flight with the reason and bars further commands; a release, or GUIDED, ends that."""
    yard = await open_yard()
    await yard.vehicle()
    going = asyncio.create_task(yard.tell("goto", waypoints=[{"x": 200, "y": 4}]))
    await until(lambda: yard.now.mode == "AUTO" and yard.now.pose is not None and yard.now.pose.z > 4)
    await yard.station(mode(5))
    failure = (await going).failure
    assert failure is not None
    assert failure.code == "taken"
    assert "LOITER" in failure.message
    await until(lambda: yard.now.seized)
    assert "from AUTO to LOITER" in yard.now.seized
    barred = await yard.fails("goto", waypoints=[{"x": 20, "y": 4}])
    assert (barred.code, "release" in barred.remedy) == ("taken", True)
    # Neither a hold nor a stop takes it away from the pilot, and a stop does not say that it holds.
    assert (await yard.fails("hold")).code == "taken"
    assert (await yard.fails("stop")).code == "taken"
    assert yard.now.mode == "LOITER"
    assert "LOITER" in (await yard.done("release"))["was"]
    await until(lambda: not yard.now.seized)
    await yard.done("hold")
    await yard.station(mode(16))
    await until(lambda: yard.now.seized)
    await yard.station(mode(4))
    await until(lambda: not yard.now.seized)
    await yard.done("land")


async def test_moved_sticks_are_a_takeover(open_yard: Open) -> None:
    """Overrides of the sticks that pass the gateway seize the vehicle, and let it go when they rest."""
    yard = await open_yard()
    await yard.vehicle()
    going = asyncio.create_task(yard.tell("goto", waypoints=[{"x": 200, "y": 4}]))
    await until(lambda: yard.now.mode == "AUTO")

    def push(ground: Any) -> None:
        ground.mav.rc_channels_override_send(1, 1, 1800, 0, 0, 0, 0, 0, 0, 0)

    await yard.station(push, until_heard="HEARTBEAT")
    failure = (await going).failure
    assert failure is not None
    assert (failure.code, "sticks" in failure.message) == ("taken", True)
    await until(lambda: not yard.now.seized)


async def test_a_failsafe_ends_the_flight_and_landing_is_still_taken(open_yard: Open) -> None:
    """A failsafe of the vehicle ends the command with its words, shows on the plane, and leaves only the ways down."""
    yard = await open_yard()
    await yard.vehicle()
    going = asyncio.create_task(yard.tell("goto", waypoints=[{"x": 200, "y": 4}]))
    await until(lambda: yard.now.mode == "AUTO" and yard.now.pose is not None and yard.now.pose.x > 15)
    await yard.station(parameter("SIM_RC_FAIL", 1), until_heard="PARAM_VALUE")
    failure = (await going).failure
    assert failure is not None
    assert failure.code == "taken"
    assert "radio failsafe" in failure.message
    await until(lambda: yard.now.failsafe and yard.now.seized)
    assert (await yard.fails("goto", waypoints=[{"x": 20, "y": 4}])).code == "taken"
    assert (await yard.fails("release")).code == "refused"
    assert (await yard.done("land"))["landed"] is True
    refused = await yard.fails("arm")
    assert "PreArm: Radio failsafe on" in refused.message


async def test_the_estimator_is_on_the_plane_and_keeps_it_on_the_ground(open_yard: Open) -> None:
    """Without GPS the roster says so, and arming fails with what the gateway and the autopilot have against it."""
    yard = await open_yard()
    await yard.vehicle(parameters={"SIM_GPS_DISABLE": 1.0})
    await until(lambda: yard.now.estimator)
    assert "no position" in yard.now.estimator
    failure = await yard.fails("arm")
    assert "no position" in failure.message or "requires position" in failure.message


async def test_the_policy_has_the_last_word(open_yard: Open) -> None:
    """Outside the fence, too high, too fast: each refused with the reason, whatever the command; nothing flies."""
    yard = await open_yard()
    await yard.vehicle()
    for verb, args, why in (
        ("goto", {"waypoints": [{"x": 300, "y": 4}]}, "outside the yard"),
        ("mission", {"steps": [{"x": 20, "y": 80}]}, "outside the yard"),
        ("orbit", {"x": 205, "y": 30, "radius_m": 20}, "outside the yard"),
        ("orbit", {"x": 50, "y": 20, "z": 40}, "the site allows 30 m"),
        ("mission", {"steps": [{"x": 20, "y": 8}], "speed_mps": 7}, "above the site's limit"),
        ("takeoff", {"altitude_m": 31}, "30"),
        ("set_mode", {"mode": "STABILIZE"}, "sticks"),
        ("set_mode", {"mode": "AUTO"}, "nobody has checked"),
        ("set_mode", {"mode": "flip"}, "sticks"),
        ("parameter", {"name": "FENCE_ENABLE", "value": 0}, "keeps the vehicle safe"),
        ("servo", {"output": 3, "pwm_us": 1900}, "not the gateway's to set"),
    ):
        failure = await yard.fails(verb, **args)
        assert why in failure.message, failure
    assert not yard.now.armed


async def test_a_vehicle_that_is_blown_off_the_site_is_held(open_yard: Open) -> None:
    """A storm takes it over the fence: the command ends with where it is, and the vehicle gets the order to hold."""
    yard = await open_yard()
    await yard.vehicle(parameters={"SIM_WIND_SPD": 18.0, "SIM_WIND_DIR": 0.0})
    failure = await yard.fails("goto", waypoints=[{"x": 20, "y": 4, "z": 10}])
    assert failure.code == "refused"
    assert "was stopped during goto: it is outside the yard" in failure.message
    await until(lambda: yard.now.mode == "GUIDED")


async def test_an_orbit(open_yard: Open) -> None:
    """A circle is flown all the way round at its radius."""
    yard = await open_yard()
    await yard.vehicle(rate=6.0)
    result = await yard.done("orbit", x=30, y=20, z=8, radius_m=8, laps=1, speed_mps=5)
    assert result["laps"] == 1
    around = [each.pose for each in yard.infos if each.pose and each.mode == "AUTO" and each.mission_item == 3]
    radii = [((pose.x - 30) ** 2 + (pose.y - 20) ** 2) ** 0.5 for pose in around]
    assert min(radii[len(radii) // 2 :]) == pytest.approx(8, abs=2.5)
    assert {(pose.x > 30, pose.y > 20) for pose in around} == {(a, b) for a in (True, False) for b in (True, False)}


@pytest.mark.parametrize("drop", [0.0, 0.2])
async def test_what_it_carries(open_yard: Open, drop: float) -> None:
    """Pictures, recording, gimbal, gripper, servo, words and parameters, also over a link that loses a fifth."""
    yard = await open_yard(servos=(9,), ack_timeout_s=0.3)
    await yard.vehicle(drop=drop, double=drop / 2, seed=5)
    pictures = await yard.done("trigger", count=2, interval_s=0.2)
    assert pictures["confirmed"] == 2
    assert [each["index"] for each in pictures["images"]] == [0, 1]
    assert pictures["images"][0]["file_url"].startswith("sim://1/")
    for action in ("start", "stop"):
        assert (await yard.done("video", action=action))["recording"] == (action == "start")
    assert (await yard.done("gimbal", pitch_deg=-45, yaw_deg=30))["confirmed"] or drop
    await yard.done("gimbal", x=20, y=4)
    assert (await yard.fails("gimbal", pitch_deg=80)).code == "robot"  # the gimbal's own limit
    for action in ("grab", "release"):
        assert (await yard.done("gripper", action=action))["gripper"] == action
    await yard.done("servo", output=9, pwm_us=1200)
    assert (await yard.done("say", text="mind your heads"))["said"] == "mind your heads"
    assert (await yard.done("parameter", name="WPNAV_SPEED"))["value"] == 500.0
    assert (await yard.done("parameter", name="wpnav_speed", value=400))["value"] == 400.0
    assert (await yard.done("set_mode", mode="brake"))["mode"] == "BRAKE"


async def test_words_reach_the_ground_station(open_yard: Open) -> None:
    """What a vehicle is to say is shown on the ground stations of the other links too."""
    yard = await open_yard()
    await yard.vehicle()
    texts: list[str] = []

    def listen(ground: Any) -> None:
        while not any("mind your heads" in each for each in texts):
            message = ground.recv_match(type="STATUSTEXT", blocking=True, timeout=20)
            assert message is not None
            texts.append(str(message.text))

    listening = asyncio.create_task(yard.station(listen, until_heard="HEARTBEAT"))
    while not listening.done():
        await yard.done("say", text="mind your heads")
        await asyncio.wait([listening], timeout=0.5)
    await listening


async def test_a_rover_by_mavlink(open_yard: Open) -> None:
    """A rover is commanded too: it drives to places and home, has no take-off, and arms by itself."""
    yard = await open_yard()
    await yard.vehicle(kind="rover", rate=6.0)
    assert (yard.now.flies, yard.now.uses) == (False, ("base", "speaker"))
    assert "takeoff" not in yard.now.verbs
    pose = (await yard.done("goto", waypoints=[{"x": 14, "y": 4}, {"x": 14, "y": 12}]))["pose"]
    assert (pose["x"], pose["y"]) == pytest.approx((14, 12), abs=1.6)
    assert "does not know" in (await yard.fails("takeoff")).message
    pose = (await yard.done("return_home"))["pose"]
    assert (pose["x"], pose["y"]) == pytest.approx((4, 4), abs=1.6)
    await yard.done("hold")
    await yard.done("disarm")


async def test_a_very_bad_link(open_yard: Open) -> None:
    """A flight over a link that loses, doubles, delays and mixes up frames still ends where it should."""
    yard = await open_yard(ack_timeout_s=0.4)
    await yard.vehicle(drop=0.15, double=0.1, mix=0.1, delay_s=0.05, seed=3)
    pose = (await yard.done("goto", waypoints=[{"x": 20, "y": 10, "z": 8}]))["pose"]
    assert (pose["x"], pose["y"]) == pytest.approx((20, 10), abs=1.6)
    await yard.done("land")
