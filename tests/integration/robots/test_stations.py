"""Ground stations that nobody here wrote, through a real gateway hub to a simulated vehicle.

MAVSDK by its own server and Python client, MAVProxy by its command line, alone and as a router in between. mavp2p
and mavrouter are used where they are installed, found as the benchmark finds them: they come as source in a Go module
and a crate, not with the locked Python packages, so their tests say why they are skipped elsewhere.
"""

import asyncio
import contextlib
import importlib.util
import itertools
import json
import math
import sys
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from mavsdk_grpc import System
from mavsdk_grpc.mavlink_direct import MavlinkMessage
from mavsdk_grpc.mission_raw import MissionItem
from pymavlink import mavutil

from appliance.errors import PrerequisiteError
from appliance.model import (
    Place,
    RobotCommand,
    RobotInfo,
    Site,
    Subtask,
    SubtaskRecord,
    SubtaskState,
    TaskRecord,
    TaskRequest,
    TaskState,
    encode,
    keyspace,
)
from appliance.model.robot_api import MavlinkLink
from appliance.model.site import to_globe
from appliance.plane.session import Session
from appliance.plane.settings import PlaneConfig
from appliance.plane.store import Store
from appliance.robots.hub import RobotHub
from appliance.robots.mavlink.command_server import task_number
from appliance.robots.settings import RobotsConfig, Template
from appliance.robots.task_listener import Tasks
from workshop.bench.mavlink import others
from workshop.robots.mavlink import VehicleSettings

pytestmark = pytest.mark.anyio

SITE = Site(places={"home": Place(x=4.0, y=4.0)}, altitude_limit_m=30.0, speed_limit_mps=6.0)
_VEHICLE = """
import asyncio, sys, msgspec
from workshop.robots.mavlink import VehicleSettings, run_vehicle
asyncio.run(run_vehicle(msgspec.json.decode(sys.argv[1], type=VehicleSettings)))
"""
Ports = Callable[..., list[int]]


class Field:
    """A hub with a link for vehicles and one for stations, a vehicle, and the fleet's tasks."""

    def __init__(self, session: Session, vehicles: int, stations: int, folder: Path) -> None:
        self.session = session
        self.vehicles = vehicles
        self.stations = stations
        self.folder = folder
        self.infos: list[RobotInfo] = []
        self.submitted: list[TaskRequest] = []
        self.processes: list[asyncio.subprocess.Process] = []
        session.subscribe_typed(keyspace.ROBOT, self._info)

    def _info(self, _: str, info: RobotInfo | None) -> None:
        if info is not None:
            self.infos.append(info)

    async def start(self, *command: str, **pipes: Any) -> asyncio.subprocess.Process:
        """Start a process that is ended with the test."""
        process = await asyncio.create_subprocess_exec(*command, cwd=self.folder, **pipes)
        self.processes.append(process)
        return process

    async def vehicle(self, **settings: Any) -> None:
        """Start a simulated vehicle and wait until it is on the roster with its position."""
        usual = {"to": f"udp://127.0.0.1:{self.vehicles}", "site": SITE, "rate": 4.0}
        order = VehicleSettings(**(usual | settings))
        await self.start(sys.executable, "-c", _VEHICLE, msgspec.json.encode(order).decode())
        await until(lambda: any(each.online and each.pose for each in self.infos))

    # --- the fleet's tasks, which the hub is handed as the gateway hands them ------------------------------------

    async def submit(self, request: TaskRequest) -> TaskRecord:
        """Take a task; it is durable here."""
        self.submitted.append(request)
        return TaskRecord(id=request.id, instruction=request.instruction)

    async def look(self, task: str) -> TaskRecord:
        """Tell how a task stands."""
        return TaskRecord(id=task, instruction="")

    def tell(self, state: TaskState, done: int) -> None:
        """Put the record of the last task as its coordinator does."""
        request = self.submitted[-1]
        subtasks = tuple(
            SubtaskRecord(
                subtask=Subtask(id=f"s{number}", skill="goto", robot="drone_1"),
                state=SubtaskState.SUCCEEDED if number < done else SubtaskState.WAITING,
            )
            for number in range(2)
        )
        record = TaskRecord(
            id=request.id, instruction=request.instruction, state=state, subtasks=subtasks, sequence=2 + done
        )
        self.session.publish(keyspace.TASK_UPDATE, record, request.id)


async def until(holds: Callable[[], object], limit_s: float = 60.0) -> None:
    """Wait for something to become true."""
    async with asyncio.timeout(limit_s):
        while not holds():
            await asyncio.sleep(0.05)


@pytest.fixture
async def field(free_ports: Ports, tmp_path: Path) -> AsyncIterator[Field]:
    """Open a field; everything is closed afterwards."""
    plane, stations = free_ports(2)
    (vehicles,) = free_ports(1, udp=True)
    async with contextlib.AsyncExitStack() as stack:
        session = await Session.open(PlaneConfig(listen=(f"tcp/127.0.0.1:{plane}",)), "field")
        stack.push_async_callback(session.close)
        store = await Store.open(tmp_path / "store.sqlite")
        stack.push_async_callback(store.close)
        field = Field(session, vehicles, stations, tmp_path)
        config = RobotsConfig(
            mavlink=(
                MavlinkLink(listen=f"udp://127.0.0.1:{vehicles}"),
                MavlinkLink(listen=f"tcp://127.0.0.1:{stations}"),
            ),
            templates=(Template(id=7, instruction="{robot} film the yard for {2} seconds"),),
        )
        tasks = Tasks(submit=field.submit, cancel=lambda task, _: field.look(task), look=field.look)
        hub = RobotHub(config, session=session, store=store, gateway="gw-1", site=SITE, tasks=tasks)
        await hub.start()
        stack.push_async_callback(hub.stop)
        stack.push_async_callback(end_processes, field.processes)
        yield field


async def end_processes(processes: list[asyncio.subprocess.Process]) -> None:
    """End processes that a test started."""
    for process in processes:
        if process.returncode is None:
            process.kill()
        await process.wait()


# --- MAVSDK ------------------------------------------------------------------------------------------------------


async def mavsdk(field: Field, url: str, port: int) -> System:
    """Start MAVSDK's server as its Python package does, and connect to the vehicle through it."""
    spec = importlib.util.find_spec("mavsdk_grpc")
    assert spec is not None
    assert spec.submodule_search_locations is not None
    server = Path(spec.submodule_search_locations[0]) / "bin" / "mavsdk_server"
    quiet = {"stdout": asyncio.subprocess.DEVNULL, "stderr": asyncio.subprocess.DEVNULL}
    await field.start(str(server), "-p", str(port), url, **quiet)
    drone = System(mavsdk_server_address="127.0.0.1", port=port)
    await drone.connect()
    await first(drone.core.connection_state(), lambda state: state.is_connected)
    return drone


async def first(stream: Any, holds: Callable[[Any], bool], limit_s: float = 60.0) -> Any:
    """Return the first of a stream for which something holds."""
    async with asyncio.timeout(limit_s):
        async for each in stream:
            if holds(each):
                return each
    raise AssertionError("the stream ended")


def item(seq: int, latitude: float, longitude: float, altitude: float) -> MissionItem:
    """Make a waypoint."""
    x, y = round(latitude * 1e7), round(longitude * 1e7)
    return MissionItem(seq, 6, 16, 1 if seq == 0 else 0, 1, 0.0, 0.0, 0.0, 0.0, x, y, altitude, 0)


async def test_mavsdk_flies_a_mission(field: Field, free_ports: Ports) -> None:
    """MAVSDK connects, reads health, version and parameters, arms, takes off, flies a mission and comes home."""
    await field.vehicle()
    drone = await mavsdk(field, f"tcpout://127.0.0.1:{field.stations}", free_ports(1)[0])
    await first(drone.telemetry.health(), lambda health: health.is_global_position_ok and health.is_armable)
    assert (await drone.info.get_version()).flight_sw_major == 4
    assert await drone.param.get_param_float("WPNAV_SPEED") == 500.0
    await drone.action.set_takeoff_altitude(6.0)
    await drone.action.arm()
    await drone.action.takeoff()
    here = await first(drone.telemetry.position(), lambda position: position.relative_altitude_m > 5.0)
    north, east = here.latitude_deg + 1e-4, here.longitude_deg + 2e-4
    way = [
        item(0, here.latitude_deg, here.longitude_deg, 0.0),
        item(1, north, here.longitude_deg, 8.0),
        item(2, north, east, 8.0),
    ]
    await drone.mission_raw.upload_mission(way)
    assert [each.x for each in await drone.mission_raw.download_mission()] == [each.x for each in way]
    await drone.mission_raw.start_mission()
    await first(drone.mission_raw.mission_progress(), lambda progress: progress.current == 2)
    await first(drone.telemetry.position(), lambda position: abs(position.longitude_deg - east) < 1e-5)
    # The gateway has seen the whole flight, and that it was not its own.
    assert any(each.mode == "AUTO" and each.mission_item == 2 for each in field.infos)
    assert {each.mode for each in field.infos if each.seized} <= {"STABILIZE"}, "in which the station has armed it"
    await drone.action.return_to_launch()
    await first(drone.telemetry.armed(), lambda armed: not armed)
    await until(lambda: not field.infos[-1].armed)


async def test_mavsdk_asks_for_a_task(field: Field, free_ports: Ports) -> None:
    """A command by MAVSDK is acknowledged with the task's number, and progress and result come as texts."""
    await field.vehicle()
    drone = await mavsdk(field, f"tcpout://127.0.0.1:{field.stations}", free_ports(1)[0])
    answers: list[dict[str, Any]] = []
    texts: list[str] = []

    async def hear() -> None:
        async for message in drone.mavlink_direct.message("COMMAND_ACK"):
            answers.append(json.loads(message.fields_json))  # noqa: PERF401 - read while it grows

    async def read() -> None:
        async for text in drone.mavlink_direct.message("STATUSTEXT"):
            texts.append(str(json.loads(text.fields_json)["text"]))  # noqa: PERF401 - read while it grows

    async def ask(template: int, confirmation: int = 0) -> None:
        fields = {"target_system": 1, "target_component": 191, "command": 31010, "confirmation": confirmation}
        fields |= {f"param{number}": 0 for number in range(3, 8)} | {"param1": template, "param2": 30}
        await drone.mavlink_direct.send_message(MavlinkMessage("COMMAND_LONG", 245, 190, 1, 191, json.dumps(fields)))

    listeners = [asyncio.create_task(hear()), asyncio.create_task(read())]
    try:
        # Its server says nothing of when it listens: what cannot be is asked for until both streams have told so.
        async with asyncio.timeout(60):
            while not (
                any("no template 99" in each for each in texts) and any(each["result"] == 2 for each in answers)
            ):
                await ask(99)
                await asyncio.sleep(0.2)
        # Sent again as stations do: the last of those may still be at work, and then this is to be asked again.
        for confirmation in itertools.count():
            await ask(7, min(confirmation, 255))
            with contextlib.suppress(TimeoutError):
                await until(lambda: any(each["command"] == 31010 and each["result"] == 0 for each in answers), 2.0)
                break
        (request,) = field.submitted
        assert request.instruction == "drone_1 film the yard for 30 seconds"
        accepted = next(each for each in answers if each["command"] == 31010 and each["result"] == 0)
        assert accepted["result_param2"] == task_number(request.id)
        for state, done in ((TaskState.RUNNING, 0), (TaskState.RUNNING, 1), (TaskState.SUCCEEDED, 2)):
            field.tell(state, done)
            wanted = f"{request.id} {state}" + (f" {done}/2" if state is TaskState.RUNNING else "")
            await until(lambda wanted=wanted: any(wanted in each for each in texts))
    finally:
        for listener in listeners:
            listener.cancel()
        await asyncio.gather(*listeners, return_exceptions=True)


async def test_mavsdk_shows_what_the_gateway_says(field: Field, free_ports: Ports) -> None:
    """Its list is of the vehicle's system: refusals, and what an operator has said, short, full and long."""
    await field.vehicle()
    drone = await mavsdk(field, f"tcpout://127.0.0.1:{field.stations}", free_ports(1)[0])
    shown: list[str] = []

    async def read() -> None:
        async for text in drone.telemetry.status_text():
            shown.append(text.text)  # noqa: PERF401 - read while it grows

    async def ask(template: int) -> None:
        fields = {"target_system": 1, "target_component": 191, "command": 31010, "confirmation": 0}
        fields |= {f"param{number}": 0 for number in range(2, 8)} | {"param1": template}
        await drone.mavlink_direct.send_message(MavlinkMessage("COMMAND_LONG", 245, 190, 1, 191, json.dumps(fields)))

    reading = asyncio.create_task(read())
    try:
        async with asyncio.timeout(60):
            while not any("no template 99" in each for each in shown):
                await ask(99)
                await asyncio.sleep(0.3)
        for number, words in enumerate(("look out", "x" * 50, "y" * 100, "z" * 400)):
            order = RobotCommand(id=f"say-{number}", verb="say", args={"text": words})
            await field.session.query(field.session.keys(keyspace.COMMAND, "drone_1"), encode(order), timeout_s=20.0)
            await until(lambda words=words: words in shown)
    finally:
        reading.cancel()
        await asyncio.gather(reading, return_exceptions=True)


# --- MAVProxy ----------------------------------------------------------------------------------------------------


class MavProxy:
    """MAVProxy's command line: what is typed and what it says."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self.said = ""
        self._process = process
        self._reading = asyncio.create_task(self._read())

    async def _read(self) -> None:
        assert self._process.stdout is not None
        while data := await self._process.stdout.read(4096):
            self.said += data.decode("utf-8", "replace")

    async def type(self, line: str, expect: str) -> None:
        """Type a line and wait until something new is said that has these words."""
        assert self._process.stdin is not None
        before = len(self.said)
        self._process.stdin.write(line.encode() + b"\n")
        try:
            await until(lambda: expect in self.said[before:])
        except TimeoutError:
            pytest.fail(f"{line!r}: {expect!r} was not said, but: {self.said[before:][-2000:]}")

    async def close(self) -> None:
        """Stop reading."""
        self._reading.cancel()
        await asyncio.gather(self._reading, return_exceptions=True)


async def mavproxy(field: Field, master: str, *outs: str) -> MavProxy:
    """Start MAVProxy; `outs` are addresses it passes everything on to."""
    program = Path(sys.executable).with_name("mavproxy.py")
    arguments = [f"--master={master}", *(f"--out={each}" for each in outs), "--nowait", "--retries=20"]
    arguments += ["--default-modules=link,param,mode,arm,misc,cmdlong,wp,output", f"--state-basedir={field.folder}"]
    arguments += [f"--logfile={field.folder / 'mav.tlog'}"]
    pipes = {"stdin": asyncio.subprocess.PIPE, "stdout": asyncio.subprocess.PIPE, "stderr": asyncio.subprocess.STDOUT}
    environment = {"HOME": str(field.folder), "PATH": "/usr/bin:/bin", "PYTHONUNBUFFERED": "1"}
    return MavProxy(await field.start(sys.executable, str(program), *arguments, env=environment, **pipes))


def _waypoints(path: Path, *points: tuple[float, float]) -> None:
    """Write a mission as ground stations keep it in files: home, then points of the site at 7 m."""
    lines = ["QGC WPL 110"]
    for number, point in enumerate(((0.0, 0.0), *points)):
        latitude, longitude, _ = to_globe(SITE, *point)
        place = f"{latitude:.7f}\t{longitude:.7f}\t{7 if number else 0}"
        lines.append(f"{number}\t{int(not number)}\t{3 if number else 0}\t16\t0\t0\t0\t0\t{place}\t1")
    path.write_text("\n".join(lines) + "\n")


async def test_mavproxy_flies_and_asks_for_a_task(field: Field) -> None:
    """MAVProxy reads the parameters, arms, takes off, flies a mission, sends a task, hears of it, and comes home."""
    await field.vehicle()
    station = await mavproxy(field, f"tcp:127.0.0.1:{field.stations}")
    try:
        await until(lambda: "parameters" in station.said and "online system 1" in station.said)
        await station.type("mode guided", "Mode GUIDED")
        await station.type("arm throttle", "ARMED")
        await station.type("takeoff 6", "NAV_TAKEOFF: ACCEPTED")
        await until(lambda: field.infos[-1].pose is not None and field.infos[-1].pose.z > 5.0)
        await station.type("param show WPNAV_SPEED", "500.0")
        way = field.folder / "way.txt"
        _waypoints(way, (8.0, 12.0), (14.0, 12.0))
        await station.type(f"wp load {way}", "Sent all 3")
        await station.type("mode auto", "Mode AUTO")
        await until(lambda: field.infos[-1].mode == "AUTO" and field.infos[-1].mission_item == 2)
        await until(lambda: (pose := field.infos[-1].pose) and math.dist((pose.x, pose.y), (14.0, 12.0)) < 1.5)
        await station.type("mode rtl", "DO_SET_MODE: ACCEPTED")
        await until(lambda: field.infos[-1].mode == "RTL" and not field.infos[-1].armed)
        # It says nothing to a setting that is changed, and the value when it is asked for.
        await station.type("set target_component 191", "")
        await station.type("set target_component", "191")
        await station.type("long USER_1 7 45", "USER_1: ACCEPTED")
        assert [each.instruction for each in field.submitted] == ["drone_1 film the yard for 45 seconds"]
        field.tell(TaskState.RUNNING, 1)
        await until(lambda: "running 1/2" in station.said)
        field.tell(TaskState.SUCCEEDED, 2)
        await until(lambda: f"{field.submitted[0].id} succeeded" in station.said)
    finally:
        await station.close()


# --- routers in between --------------------------------------------------------------------------------------------


def _arm_through(url: str) -> int:
    """Arm the vehicle as a station behind a router; return the answer's result."""
    ground = mavutil.mavlink_connection(url, source_system=254, source_component=190)
    try:
        for _ in range(20):
            ground.mav.heartbeat_send(6, 8, 0, 0, 4)
            beat = ground.recv_match(type="HEARTBEAT", condition="HEARTBEAT.autopilot==3", blocking=True, timeout=2)
            if beat is not None:
                break
        for confirmation in range(10):
            ground.mav.heartbeat_send(6, 8, 0, 0, 4)
            ground.mav.command_long_send(1, 1, 176, confirmation, 1, 4, 0, 0, 0, 0, 0)
            ground.mav.command_long_send(1, 1, 400, confirmation, 1, 0, 0, 0, 0, 0, 0)
            ack = ground.recv_match(type="COMMAND_ACK", condition="COMMAND_ACK.command==400", blocking=True, timeout=3)
            if ack is not None:
                return int(ack.result)
        raise AssertionError("no answer through the router")
    finally:
        ground.close()


async def test_mavproxy_as_a_router_in_between(field: Field, free_ports: Ports) -> None:
    """A station behind MAVProxy, which passes everything on, arms the vehicle behind the gateway."""
    await field.vehicle()
    (port,) = free_ports(1, udp=True)
    router = await mavproxy(field, f"tcp:127.0.0.1:{field.stations}", f"udpin:127.0.0.1:{port}")
    try:
        await until(lambda: "online system 1" in router.said)
        assert await asyncio.to_thread(_arm_through, f"udpout:127.0.0.1:{port}") == 0
        await until(lambda: field.infos[-1].armed)
    finally:
        await router.close()


def _mavp2p(_: Path, stations: int, port: int) -> list[str]:
    return [f"tcpc:127.0.0.1:{stations}", f"udps:127.0.0.1:{port}"]


def _mavrouter(folder: Path, stations: int, port: int) -> list[str]:
    ends = (("tcp", stations, "client"), ("udp", port, "server"))
    config = folder / "mavrouter.toml"
    config.write_text(
        f"[general]\nlog = {json.dumps(str(folder))}\nlog_telemetry = false\n"
        + "".join(
            f'[[endpoint]]\ntype = "{kind}"\naddress = "127.0.0.1:{number}"\nmode = "{mode}"\n'
            for kind, number, mode in ends
        )
    )
    return ["--config", str(config)]


@pytest.mark.parametrize(("name", "arguments"), [("mavp2p", _mavp2p), ("mavrouter", _mavrouter)])
async def test_another_router_in_between(
    field: Field, free_ports: Ports, tmp_path: Path, name: str, arguments: Callable[[Path, int, int], list[str]]
) -> None:
    """A station behind a router of others arms the vehicle behind the gateway."""
    try:
        ((router,), _) = others.find(name)
    except PrerequisiteError as missing:
        pytest.skip(f"{name} is not installed (PATH, build/bin, beside Python); to have it: {missing.remedy}")
    await field.vehicle()
    (port,) = free_ports(1, udp=True)
    quiet = {"stdout": asyncio.subprocess.DEVNULL, "stderr": asyncio.subprocess.DEVNULL}
    await field.start(router.path, *arguments(tmp_path, field.stations, port), **quiet)
    assert await asyncio.to_thread(_arm_through, f"udpout:127.0.0.1:{port}") == 0
    await until(lambda: field.infos[-1].armed)
