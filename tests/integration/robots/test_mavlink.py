"""A real gateway hub, real Zenoh sessions, real UDP and a simulated vehicle in a process of its own."""

import asyncio
import contextlib
import math
import sys
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from pymavlink import mavutil

from appliance.errors import ConfigError, SwiftbotError
from appliance.model import Place, RobotCommand, RobotInfo, RobotReply, Site, encode, keyspace
from appliance.model.robot_api import MavlinkLink
from appliance.plane.session import Session
from appliance.plane.settings import PlaneConfig
from appliance.plane.store import Store
from appliance.robots.hub import RobotHub
from appliance.robots.mavlink.dialect import Codec, make
from appliance.robots.sender import send_command
from appliance.robots.settings import RobotsConfig
from workshop.robots.mavlink import VehicleSettings

pytestmark = pytest.mark.anyio

SITE = Site(places={"home": Place(x=4.0, y=4.0)}, altitude_limit_m=30.0, speed_limit_mps=6.0)
_PROCESS = """
import asyncio, sys, msgspec
from workshop.robots.mavlink import VehicleSettings, run_vehicle
asyncio.run(run_vehicle(msgspec.json.decode(sys.argv[1], type=VehicleSettings)))
"""


async def start_vehicle(order: VehicleSettings) -> asyncio.subprocess.Process:
    """Start a simulated vehicle as a process of its own."""
    return await asyncio.create_subprocess_exec(sys.executable, "-c", _PROCESS, msgspec.json.encode(order).decode())


class Yard:
    """A hub on one session, a client on another, and what the client saw."""

    def __init__(self, client: Session, hub: RobotHub, port: int) -> None:
        self.client = client
        self.hub = hub
        self.port = port
        self.infos: list[RobotInfo] = []
        self.commanded: list[RobotCommand] = []
        self.frames: dict[str, list[bytes]] = {"rx": [], "tx": []}
        self.alive: list[bool] = []
        self.processes: list[asyncio.subprocess.Process] = []
        self.number = 0
        keys = client.keys
        client.subscribe(
            keys(keyspace.ROBOT), lambda m: self.infos.append(msgspec.json.decode(m.payload, type=RobotInfo))
        )
        client.subscribe(
            keys(keyspace.COMMANDED), lambda m: self.commanded.append(msgspec.json.decode(m.payload, type=RobotCommand))
        )
        client.subscribe(keys(keyspace.MAVLINK), lambda m: self.frames[m.key[-2:]].append(m.payload))
        client.watch_alive(keys(keyspace.ROBOT_ALIVE), lambda _, alive: self.alive.append(alive))

    async def vehicle(self, **settings: Any) -> asyncio.subprocess.Process:
        """Start a vehicle and wait until the roster has it online."""
        usual = {"to": f"udp://127.0.0.1:{self.port}", "site": SITE, "rate": 8.0}
        order = VehicleSettings(**(usual | settings))
        process = await start_vehicle(order)
        self.processes.append(process)
        self.infos.clear()
        await until(lambda: any(each.online and each.pose for each in self.infos))
        return process

    async def tell(self, verb: str, *, identity: str = "", attempt: int = 1, **args: Any) -> RobotReply:
        """Give drone_1 a command."""
        self.number += 1
        command = RobotCommand(
            id=identity or f"t/s/{self.number}", verb=verb, args=args, task="t", subtask="s", attempt=attempt
        )
        return await send_command(self.client, "drone_1", command, timeout_s=90.0)

    async def done(self, verb: str, **args: Any) -> dict[str, Any]:
        """Give drone_1 a command that must succeed; returns its result."""
        reply = await self.tell(verb, **args)
        assert reply.failure is None, reply.failure
        return reply.result


async def until(holds: Callable[[], object], limit_s: float = 30.0) -> None:
    """Wait for something to become true."""
    async with asyncio.timeout(limit_s):
        while not holds():
            await asyncio.sleep(0.02)


Open = Callable[..., Awaitable[Yard]]


@pytest.fixture
async def open_yard(free_port: int, free_udp_port: int, tmp_path: Path) -> AsyncIterator[Open]:
    """Return a function that opens a yard; everything is closed afterwards."""
    async with contextlib.AsyncExitStack() as stack:
        endpoint = f"tcp/127.0.0.1:{free_port}"

        async def start(*, links: tuple[MavlinkLink, ...] = (), **changes: Any) -> Yard:
            session = await Session.open(PlaneConfig(listen=(endpoint,)), "yard")
            stack.push_async_callback(session.close)
            store = await Store.open(tmp_path / "store.sqlite")
            stack.push_async_callback(store.close)
            links = links or (MavlinkLink(listen=f"udp://127.0.0.1:{free_udp_port}", prefix="drone_"),)
            config = RobotsConfig(mavlink=links, **changes)
            hub = RobotHub(config, session=session, store=store, gateway="gw-1", site=SITE)
            await hub.start()
            stack.push_async_callback(hub.stop)
            client = await Session.open(PlaneConfig(mode="client", connect=(endpoint,)), "yard")
            stack.push_async_callback(client.close)
            yard = Yard(client, hub, free_udp_port)
            stack.push_async_callback(_end, yard.processes)
            return yard

        yield start


async def _end(processes: list[asyncio.subprocess.Process]) -> None:
    for process in processes:
        if process.returncode is None:
            process.kill()
        await process.wait()


async def test_a_flight(open_yard: Open) -> None:
    """Arm, take off, fly a mission through two waypoints, land: each ends when the vehicle says it is so."""
    yard = await open_yard()
    await yard.vehicle()
    await yard.done("arm")
    assert (await yard.done("takeoff", altitude_m=6.0))["altitude_m"] == pytest.approx(6.0, abs=0.6)
    result = await yard.done("goto", waypoints=[{"x": 14, "y": 4}, {"x": 14, "y": 20, "z": 9}], speed_mps=6.0)
    assert (result["pose"]["x"], result["pose"]["y"], result["pose"]["z"]) == pytest.approx((14, 20, 9), abs=1.5)
    assert result["mode"] == "AUTO"
    assert (await yard.done("land"))["landed"] is True
    state = await yard.done("state")
    assert (state["flies"], state["armed"], state["uses"]) == (True, False, ["base", "speaker"])
    assert [each.verb for each in yard.commanded] == ["arm", "takeoff", "goto", "land"]
    info = yard.infos[-1]
    assert (info.id, info.kind, info.gateway, info.flies, info.uses) == (
        "drone_1",
        "mavlink",
        "gw-1",
        True,
        ("base", "speaker"),
    )
    assert info.battery_percent is not None
    # The raw frames of both directions are on the plane, whole.
    for direction, sender in (("rx", 1), ("tx", 242)):
        frames = [each for data in yard.frames[direction] for each in Codec(9, 9).read(data)]
        assert frames
        assert {each.system for each in frames} == {sender}  # pyright: ignore[reportAttributeAccessIssue]


async def test_a_vehicle_that_listens(open_yard: Open, free_ports: Callable[[int], list[int]]) -> None:
    """A gateway connects to a vehicle that listens on TCP, as SITL does; the vehicle may start later, and again."""
    url = f"tcp://127.0.0.1:{free_ports(1)[0]}"
    yard = await open_yard(links=(MavlinkLink(connect=url, prefix="drone_"),), heartbeat_lost_s=1.5)
    process = await yard.vehicle(to=url, listen=True)
    assert (await yard.done("takeoff", altitude_m=6.0))["altitude_m"] == pytest.approx(6.0, abs=0.6)
    process.kill()
    await until(lambda: not yard.infos[-1].online)
    await yard.vehicle(to=url, listen=True)
    assert (await yard.done("state"))["armed"] is False


async def test_a_signed_link(open_yard: Open, free_udp_port: int, tmp_path: Path) -> None:
    """A vehicle with the key flies; one without it, and one with another key, is not even seen, and is counted."""
    keys = [tmp_path / name for name in ("key", "other")]
    for key in keys:
        key.write_text(f"secret {key.name}")
        key.chmod(0o600)
    url = f"udp://127.0.0.1:{free_udp_port}"
    yard = await open_yard(links=(MavlinkLink(listen=url, prefix="drone_", signing=str(keys[0])),))
    yard.processes.append(await start_vehicle(VehicleSettings(to=url, system=2, site=SITE)))
    yard.processes.append(await start_vehicle(VehicleSettings(to=url, system=3, site=SITE, signing=str(keys[1]))))
    await until(lambda: {"unsigned", "bad_signature"} <= yard.hub.refused.keys())
    await yard.vehicle(signing=str(keys[0]))
    assert (await yard.done("takeoff", altitude_m=6.0))["altitude_m"] == pytest.approx(6.0, abs=0.6)
    assert yard.hub.attached == ("drone_1",)


async def test_a_ground_station_through_the_gateway(
    open_yard: Open, free_ports: Callable[[int], list[int]], free_udp_port: int
) -> None:
    """Pymavlink's own ground station on a TCP link sees the vehicle of a UDP link, arms it, and gets its answer.

    What it sends is recorded as sent to the vehicle; what is for nobody here goes nowhere.
    """
    url = f"tcp:127.0.0.1:{free_ports(1)[0]}"
    links = (
        MavlinkLink(listen=f"udp://127.0.0.1:{free_udp_port}", prefix="drone_"),
        MavlinkLink(listen=url.replace("tcp:", "tcp://"), not_out=("SYS_STATUS",)),
    )
    yard = await open_yard(links=links)
    await yard.vehicle()

    def station() -> tuple[int, int, set[str]]:
        ground = mavutil.mavlink_connection(url, source_system=255, source_component=190)
        try:
            ground.mav.heartbeat_send(6, 8, 0, 0, 4)
            beat = ground.recv_match(type="HEARTBEAT", condition="HEARTBEAT.autopilot==3", blocking=True, timeout=20)
            ground.mav.command_long_send(9, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0)  # for a vehicle that is not there
            ground.mav.command_long_send(beat.get_srcSystem(), 1, 176, 0, 1, 4, 0, 0, 0, 0, 0)  # GUIDED
            ground.mav.command_long_send(beat.get_srcSystem(), 1, 400, 0, 1, 0, 0, 0, 0, 0, 0)
            ack = ground.recv_match(type="COMMAND_ACK", condition="COMMAND_ACK.command==400", blocking=True, timeout=20)
            seen: set[str] = set()
            while "MISSION_CURRENT" not in seen:
                seen.add(ground.recv_match(blocking=True, timeout=20).get_type())
            return beat.get_srcSystem(), ack.result, seen
        finally:
            ground.close()

    system, result, seen = await asyncio.to_thread(station)
    assert (system, result) == (1, 0)
    assert "SYS_STATUS" not in seen
    await until(lambda: yard.infos[-1].armed)
    sent = [each for data in yard.frames["tx"] for each in Codec(9, 9).read(data)]
    assert [each.message.command for each in sent if each.system == 255 and each.name == "COMMAND_LONG"] == [176, 400]  # pyright: ignore[reportAttributeAccessIssue]


async def test_goto_from_the_ground_and_home_again(open_yard: Open) -> None:
    """A goto on the ground arms and takes off by its mission; return_home lands at home and disarms."""
    yard = await open_yard(takeoff_altitude_m=5.0)
    await yard.vehicle()
    pose = (await yard.done("goto", waypoints=[{"x": 12, "y": 10, "z": 0.0}]))["pose"]
    assert (pose["x"], pose["y"], pose["z"]) == pytest.approx((12, 10, 5), abs=1.5)
    pose = (await yard.done("return_home"))["pose"]
    assert (pose["x"], pose["y"]) == pytest.approx((4, 4), abs=1.5)
    assert (await yard.done("state"))["armed"] is False


async def test_a_fifth_of_all_frames_lost(open_yard: Open) -> None:
    """With 20 % of frames dropped each way the same flight still completes."""
    yard = await open_yard(ack_timeout_s=0.3)
    await yard.vehicle(drop=0.2, seed=7)
    await yard.done("goto", waypoints=[{"x": 12, "y": 10}, {"x": 20, "y": 10, "z": 8}, {"x": 20, "y": 4}])
    await yard.done("land")


async def test_a_repeated_command_flies_once(open_yard: Open) -> None:
    """The same id given three times, twice at once and once after, is flown and announced once."""
    yard = await open_yard()
    await yard.vehicle()
    way = {"waypoints": [{"x": 10, "y": 10}]}
    first, second = await asyncio.gather(
        yard.tell("goto", identity="t/s/1", **way), yard.tell("goto", identity="t/s/1", attempt=2, **way)
    )
    third = await yard.tell("goto", identity="t/s/1", attempt=2, **way)
    assert first == second == third
    assert first.failure is None
    assert [each.id for each in yard.commanded] == ["t/s/1"]
    stale = await yard.tell("goto", identity="t/s/2", attempt=1, **way)
    assert stale.failure is not None
    assert stale.failure.code == "refused"


async def test_hold_and_stop_end_a_flight(open_yard: Open) -> None:
    """A second goto is refused as busy; hold ends the first; a stop ends the next; the vehicle stays where it is."""
    yard = await open_yard()
    await yard.vehicle(rate=2.0)
    await yard.done("takeoff", altitude_m=5)
    far = {"waypoints": [{"x": 200, "y": 4}]}
    for ending in ("hold", "stop"):
        going = asyncio.create_task(yard.tell("goto", **far))
        await until(lambda: yard.infos[-1].mode == "AUTO")
        busy = await yard.tell("goto", **far)
        assert busy.failure is not None
        assert (busy.failure.code, busy.failure.retryable) == ("busy", True)
        await yard.done(ending)
        failure = (await going).failure
        assert failure is not None
        assert failure.code == "cancelled"
        await until(lambda: yard.infos[-1].mode == "GUIDED")
    here = (await yard.done("state"))["pose"]
    assert 4.0 <= here["x"] < 150.0
    assert here["z"] > 3.0


async def test_cancelling_the_caller_stops_the_vehicle(open_yard: Open) -> None:
    """When a caller of send_command is cancelled its command ends on the vehicle too."""
    yard = await open_yard()
    await yard.vehicle(rate=2.0)
    await yard.done("takeoff", altitude_m=5)
    going = asyncio.create_task(yard.tell("goto", waypoints=[{"x": 200, "y": 4}]))
    await until(lambda: yard.infos[-1].mode == "AUTO")
    going.cancel()
    await until(lambda: yard.infos[-1].mode == "GUIDED")
    assert yard.commanded[-1].verb == "stop"


async def test_a_killed_vehicle_goes_offline_and_comes_back(open_yard: Open) -> None:
    """Without heartbeats the command under way fails as retryable and the token goes; a new process is taken back.

    Meanwhile it cannot be stopped either, and nobody says that it was.
    """
    yard = await open_yard(heartbeat_lost_s=1.5)
    process = await yard.vehicle(rate=1.0)
    going = asyncio.create_task(yard.tell("goto", waypoints=[{"x": 200, "y": 4}]))
    await until(lambda: yard.infos[-1].mode == "AUTO")
    process.kill()
    failure = (await going).failure
    assert failure is not None
    assert (failure.code, failure.retryable) == ("robot", True)
    assert "offline" in failure.message
    await until(lambda: not yard.infos[-1].online)
    await until(lambda: yard.alive == [True, False])
    stopped = await yard.tell("stop")
    assert stopped.failure is not None
    assert "could not be told to hold: it is offline, and was armed" in stopped.failure.message
    refused = await yard.tell("arm")
    assert refused.failure is not None
    assert refused.failure.retryable
    await yard.vehicle()
    await until(lambda: yard.alive == [True, False, True])
    await yard.done("arm")


async def test_what_the_autopilot_refuses_is_told_in_its_words(open_yard: Open) -> None:
    """Arming with a low battery fails with the autopilot's own text."""
    yard = await open_yard()
    await yard.vehicle(battery_percent=12.0)
    failure = (await yard.tell("arm")).failure
    assert failure is not None
    assert "PreArm: battery at 12 %" in failure.message


async def test_bad_frames_are_counted_and_the_stream_goes_on(open_yard: Open) -> None:
    """Noise, bad checksums, unknown dialects, cut datagrams, strangers and impostors are counted by kind."""
    yard = await open_yard()
    await yard.vehicle()
    beat = make("HEARTBEAT", type=2, autopilot=3, base_mode=0, custom_mode=4, system_status=4, mavlink_version=3)
    good, stranger, impostor = (Codec(system, 1).pack(beat) for system in (50, 60, 1))
    bad = bytearray(good)
    bad[12] ^= 0xFF
    unknown = bytearray(good)
    unknown[8] = 0xF0
    position = Codec(61, 1).pack(make("SYSTEM_TIME", time_unix_usec=1, time_boot_ms=1))
    station = Codec(255, 190).pack(
        make("HEARTBEAT", type=6, autopilot=8, base_mode=0, custom_mode=0, system_status=4, mavlink_version=3)
    )
    transport, _ = await asyncio.get_running_loop().create_datagram_endpoint(
        asyncio.DatagramProtocol, remote_addr=("127.0.0.1", yard.port)
    )
    for data in (b"noise", bytes(bad), bytes(unknown), good[:-4], position, station, impostor, b"", stranger):
        transport.sendto(data)
    transport.close()
    await until(lambda: "drone_60" in yard.hub.attached)
    for kind in ("noise", "checksum", "unknown_message", "truncated", "address_conflict"):
        assert yard.hub.refused[kind] == 1
    assert "unknown_system" not in yard.hub.refused  # what spoke before its first heartbeat, and the station
    assert yard.hub.attached == ("drone_1", "drone_60")
    await yard.done("arm")


async def test_bad_commands_over_the_plane(open_yard: Open) -> None:
    """Malformed queries are answered with an error that says why, unknown verbs and arguments with a failure."""
    yard = await open_yard()
    await yard.vehicle()
    key = yard.client.keys(keyspace.COMMAND, "drone_1")
    for payload in (b"", b"{", b'{"id": "", "verb": "arm"}', encode(["x"])):
        with pytest.raises(SwiftbotError, match=r"RobotCommand|characters"):
            await yard.client.query(key, payload, timeout_s=5.0)
    for verb, args in (("pick", {"object": "box"}), ("goto", {"waypoints": []}), ("takeoff", {"altitude_m": 500})):
        failure = (await yard.tell(verb, **args)).failure
        assert failure is not None
    # Only what was well-formed was taken up, and nothing of it flew.
    assert {each.verb for each in yard.commanded} <= {"goto", "takeoff"}
    assert (await yard.done("state"))["armed"] is False


async def test_a_port_in_use_is_a_config_error(open_yard: Open, free_udp_port: int) -> None:
    """A second listener on the port is refused with the remedy."""
    transport, _ = await asyncio.get_running_loop().create_datagram_endpoint(
        asyncio.DatagramProtocol, local_addr=("127.0.0.1", free_udp_port)
    )
    try:
        with pytest.raises(ConfigError, match=r"set another robots\.mavlink listen"):
            await open_yard()
    finally:
        transport.close()


async def test_a_restarted_gateway_resumes_the_flight(free_port: int, free_udp_port: int, tmp_path: Path) -> None:
    """The hub stops in mid-flight and another takes its place: the same id flies on and is announced once."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    link = MavlinkLink(listen=f"udp://127.0.0.1:{free_udp_port}")
    session = await Session.open(PlaneConfig(listen=(endpoint,)), "yard")
    store = await Store.open(tmp_path / "store.sqlite")
    client = await Session.open(PlaneConfig(mode="client", connect=(endpoint,)), "yard")

    def hub() -> RobotHub:
        return RobotHub(RobotsConfig(mavlink=(link,)), session=session, store=store, gateway="gw-1", site=SITE)

    first = hub()
    await first.start()
    yard = Yard(client, first, free_udp_port)
    try:
        await yard.vehicle(rate=3.0)
        going = asyncio.create_task(yard.tell("goto", waypoints=[{"x": 60, "y": 4}]))
        await until(lambda: yard.infos[-1].mode == "AUTO" and yard.infos[-1].pose is not None)
        await first.stop()
        second = hub()
        await second.start()
        try:
            reply = await going
            assert reply.failure is None, reply.failure
            assert reply.result["pose"]["x"] == pytest.approx(60.0, abs=1.5)
            assert [each.verb for each in yard.commanded] == ["goto"]
        finally:
            await second.stop()
    finally:
        await _end(yard.processes)
        await client.close()
        await store.close()
        await session.close()


async def test_a_vehicle_is_moved_by_hand_and_holds_by_itself(open_yard: Open) -> None:
    """On the ground it is refused with the remedy; in the air it moves while orders come, then stays where it is."""
    yard = await open_yard()
    await yard.vehicle(rate=2.0)
    refused = await yard.tell("velocity", forward_mps=1.0)
    assert refused.failure is not None
    assert "takeoff" in refused.failure.remedy
    await yard.done("takeoff", altitude_m=6.0)
    before = (await yard.done("state"))["pose"]
    for _ in range(3):
        moved = await yard.done("velocity", forward_mps=2.0, for_s=0.5)
    assert (moved["pose"]["x"], moved["pose"]["y"]) != (before["x"], before["y"])
    async with asyncio.timeout(60):
        last = (await yard.done("state"))["pose"]
        while (now := (await yard.done("state"))["pose"]) != last or math.dist(xy(now), xy(before)) < 0.5:
            last = now
            await asyncio.sleep(0.5)
    assert now["z"] == pytest.approx(before["z"], abs=1.0)


def xy(pose: dict[str, float]) -> tuple[float, float]:
    """Return where it is on the map."""
    return (pose["x"], pose["y"])
