"""Faults of what is at the other ends of MAVLink links, as users of a real gateway process see them."""

import asyncio
import contextlib
import math
import socket
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import msgspec
import pytest
from robots_process import BEAT, STATION, beats, gateway_process, open_zenoh, read_frames, swiftbot

from appliance.connection import FleetState
from appliance.errors import ConflictError, Exit, RefusedError
from appliance.model import Notice, Pose, RobotCommand, RobotInfo, RobotReply, encode, keyspace
from appliance.robots.mavlink.dialect import Codec, frame_length, make
from appliance.robots.settings import RobotsConfig, Template
from appliance.robots.zenoh_client import AsyncZenohTaskClient, ZenohTaskRejected
from appliance.skills.sites import load_site
from workshop.robots.zenoh_robot import RobotSettings, Rover, run_robot

pytestmark = [pytest.mark.anyio, pytest.mark.podman]
FOREIGN = bytes.fromhex("fd06000000050161ea0001020304fdff2ab4")
FOREIGN_LAST = bytes.fromhex("fd03000000010161ea0001020387fd")


async def test_a_false_header_holds_no_vehicle_back(tmp_path: Path) -> None:
    """Behind foreign frames with markers in their bodies, a TCP vehicle at 1 Hz comes and stays online."""
    async with gateway_process(tmp_path) as it:
        port = await it.link("tcp")
        end, beat = it.connect("tcp", port), beats(7)
        end.send(FOREIGN_LAST + beat() + beat())
        await it.until(lambda: "drone_7" in it.robots() and it.robots()["drone_7"].online, limit_s=10)
        offline = 0
        for _ in range(8):
            # In two pieces, so that the gateway reads damage that is not whole.
            end.send(FOREIGN[:7])
            await asyncio.sleep(0.05)
            end.send(FOREIGN[7:])
            until = time.monotonic() + 1.0
            end.send(beat())
            while time.monotonic() < until:
                offline += not it.robots()["drone_7"].online
                await asyncio.sleep(0.1)
        facts = await it.facts(port)
        assert not offline
        assert facts.refused == {"unknown_message": 9}
        assert facts.frames_in == 10


async def test_a_repeated_command_is_one_task(tmp_path: Path) -> None:
    """Sent three times, 0.5 s apart, with NaN in unused parameters, as MAVSDK does: one task by either message.

    Each repetition waits for the answer to the one before: while a command is handed in all hear IN_PROGRESS.
    """
    templates = (Template(id=1, instruction="go to dock 3"),)
    async with gateway_process(tmp_path, RobotsConfig(templates=templates)) as it:
        end = it.connect("udp", await it.link("udp"))
        station = Codec(245, 190)
        unset: dict[str, Any] = {f"param{number}": math.nan for number in range(2, 5)}
        common: dict[str, Any] = {"target_system": 242, "target_component": 191, "command": 31010, "param1": 1.0}
        heard: list[Any] = []

        async def acks(count: int) -> list[Any]:
            async with asyncio.timeout(30):
                while True:
                    heard.extend(each.message for each in read_frames(end) if each.name == "COMMAND_ACK")
                    done = [each for each in heard if each.result != 5]
                    if len(done) >= count:
                        return done
                    await asyncio.sleep(0.1)

        first, both = list[Any](), list[Any]()
        end.send(station.pack(make("HEARTBEAT", **STATION)))
        for confirmation in range(3):
            more = {f"param{number}": math.nan for number in (5, 6, 7)}
            end.send(station.pack(make("COMMAND_LONG", confirmation=confirmation, **(common | unset | more))))
            await asyncio.sleep(0.5)
            first = await acks(confirmation + 1)
        for number in range(3):
            place = {"frame": 0, "current": 0, "autocontinue": 0, "x": 0, "y": 0, "z": math.nan}
            end.send(station.pack(make("COMMAND_INT", **(common | unset | place))))
            await asyncio.sleep(0.5)
            both = await acks(4 + number)
        assert [each.result for each in both] == [0] * 6
        assert len({each.result_param2 for each in first}) == 1
        assert len({each.result_param2 for each in both}) == 2
        assert len((await it.client.tasks(100)).tasks) == 2


@pytest.mark.long
async def test_no_robot_of_senders_that_are_no_vehicle(tmp_path: Path) -> None:
    """System 0, component 0 and a station that names an autopilot are not in the list; an old row can be removed."""
    async with gateway_process(tmp_path) as it:
        end = it.connect("udp", await it.link("udp"))
        senders = [beats(*each) for each in ((7, 1), (0, 1), (0, 0), (5, 0), (255, 190))]
        senders += [beats(40 + kind, type=kind) for kind in (0, 5, 26)]  # generic, antenna tracker, gimbal

        def act() -> None:
            for beat in senders:
                end.send(beat())

        await it.until(lambda: it.robots().get("drone_7") and it.refused().get("no_sender", 0) > 5, act)
        code, printed = await swiftbot(it.fleet, "robots", "list")
        assert code == 0
        assert "drone_7" in printed
        assert set(it.robots()) == {"drone_7"}

        async def beat() -> None:
            while True:
                act()
                await asyncio.sleep(0.3)

        beating = asyncio.create_task(beat())  # a command takes seconds where the machine is busy
        code, printed = await swiftbot(it.fleet, "robots", "forget", "drone_7")
        beating.cancel()
        assert code != 0
        assert "drone_7 is online" in printed
        await it.until(lambda: not it.robots()["drone_7"].online)
        code, printed = await swiftbot(it.fleet, "robots", "forget", "drone_7")
        assert (code, "forgot drone_7" in printed) == (0, True), printed
        await it.until(lambda: "drone_7" not in it.robots())
        await asyncio.sleep(6.0)  # longer than rosters are reminded of vehicles that are offline
        assert "drone_7" not in it.robots()
        _, printed = await swiftbot(it.fleet, "robots", "list")
        assert "drone_7" not in printed
        assert (await swiftbot(it.fleet, "robots", "forget", "drone_7"))[0] != 0
        await it.until(lambda: "drone_7" in it.robots() and it.robots()["drone_7"].online, act)


async def test_a_storm_between_two_ends_is_damped_and_reported_once(tmp_path: Path) -> None:
    """Two programs answer each other's PARAM_VALUE through the gateway: it dies down, and users see a notice."""
    # Vehicles hear of each other what is shared: as they are this is the storm of any two that hear each other.
    async with gateway_process(tmp_path, RobotsConfig(vehicles_share=("PARAM_VALUE",))) as it:
        notices: asyncio.Queue[Notice] = asyncio.Queue()
        it.client.on_notice(notices)
        port = await it.link("udp")
        ends = {system: it.connect("udp", port) for system in (1, 2)}
        codecs = {system: Codec(system, 1) for system in ends}
        fields = {"param_id": b"X", "param_value": 1.0, "param_type": 9, "param_count": 1, "param_index": 0}
        value = make("PARAM_VALUE", **fields)
        counts: list[int] = []
        began, beat_at = time.monotonic(), 0.0
        ends[1].send(codecs[1].pack(value))
        while time.monotonic() - began < 12.0:
            for system, end in ends.items():
                if time.monotonic() - beat_at > 0.5:
                    end.send(codecs[system].pack(make("HEARTBEAT", **BEAT)))
                    end.send(codecs[system].pack(value))
                heard = [each for each in read_frames(end) if each.name == "PARAM_VALUE"]
                counts += [int(time.monotonic() - began)] * len(heard)
                for _ in range(2 * min(len(heard), 200)):  # each answer is answered twice
                    end.send(codecs[system].pack(value))
            beat_at = time.monotonic() if time.monotonic() - beat_at > 0.5 else beat_at
            await asyncio.sleep(0.002)
        each_second = Counter(counts)
        assert max(each_second.values()) > 200, each_second
        assert sum(each_second[second] for second in (8, 9, 10)) < 3 * 2 * 25, each_second
        facts = await it.facts(port)
        assert set(facts.damped) == {"PARAM_VALUE of 1/1", "PARAM_VALUE of 2/1"}
        assert facts.refused["damped"] > 0
        assert notices.qsize() == 2
        assert all("storm of PARAM_VALUE" in notices.get_nowait().text for _ in range(2))
        assert {name: each.online for name, each in it.robots().items()} == {"drone_1": True, "drone_2": True}
        _, printed = await swiftbot(it.fleet, "robots", "links")
        assert "damped" in printed


async def test_simulated_vehicles_on_one_gateway_answer_for_themselves(tmp_path: Path) -> None:
    """One PARAM_REQUEST_LIST to all of three simulated vehicles: each list once, and then silence."""
    async with gateway_process(tmp_path, mavlink=3) as it:
        await it.until(lambda: sum(each.online for each in it.robots().values()) == 3)
        end = it.connect("udp", await it.link("udp"))
        station = Codec(255, 190)
        end.send(station.pack(make("HEARTBEAT", **STATION)))
        end.send(station.pack(make("PARAM_REQUEST_LIST", target_system=0, target_component=0)))
        values: list[tuple[int, str]] = []
        for _ in range(60):
            values += [(each.system, each.message.param_id) for each in read_frames(end) if each.name == "PARAM_VALUE"]
            await asyncio.sleep(0.1)
        assert {system for system, _ in values} == {1, 2, 3}
        assert len(values) == len(set(values))
        assert "damped" not in it.refused()


async def test_a_station_that_sends_no_heartbeat_is_served(tmp_path: Path) -> None:
    """Its requests reach the vehicle on another link, the vehicle's words reach it, and its command becomes a task."""
    templates = (Template(id=1, instruction="go to dock 3"),)
    async with gateway_process(tmp_path, RobotsConfig(templates=templates)) as it:
        vehicle, ground = it.connect("udp", await it.link("udp")), it.connect("tcp", await it.link("tcp"))
        beat, station = beats(1), Codec(255, 190)
        await it.until(lambda: "drone_1" in it.robots(), lambda: vehicle.send(beat()))
        heard: list[Any] = []
        asked = make("PARAM_REQUEST_LIST", target_system=1, target_component=1)
        await it.until(
            lambda: any(each.name == "PARAM_REQUEST_LIST" for each in read_frames(vehicle)),
            lambda: ground.send(station.pack(asked)),
        )

        def messages(name: str) -> list[Any]:
            heard.extend(read_frames(ground))
            return [each.message for each in heard if each.name == name]

        await it.until(
            lambda: any(each.get_srcSystem() == 1 for each in messages("HEARTBEAT")), lambda: vehicle.send(beat())
        )
        numbers = {f"param{number}": 0.0 for number in range(2, 8)}
        order = {"target_system": 242, "target_component": 191, "command": 31010, "confirmation": 0, "param1": 1.0}
        ground.send(station.pack(make("COMMAND_LONG", **order, **numbers)))
        await it.until(lambda: any(each.result == 0 for each in messages("COMMAND_ACK")))
        assert len((await it.client.tasks(100)).tasks) == 1
        assert set(it.robots()) == {"drone_1"}
        lists, _ = await it.client.robot_links(it.gateway)
        assert "255/190" in lists[it.gateway].routes


async def test_absurd_numbers_are_left_out_and_counted(tmp_path: Path) -> None:
    """A vehicle's and a Zenoh robot's: neither the list nor its JSON shows them, and what can be is shown."""
    async with gateway_process(tmp_path) as it:
        end = it.connect("udp", await it.link("udp"))
        codec, beat = Codec(1, 1), beats(1)
        place = {"lat": 473977420, "lon": 85455940, "alt": 500_000, "relative_alt": 5_000, "vx": 300, "vy": 0, "vz": 0}
        absurd = place | {"lat": 2_000_000_000, "alt": -(2**31)}
        session = await asyncio.to_thread(open_zenoh, it.fleet)
        key = f"swiftbot/{it.fleet.fleet}/robot/cart_1"
        token = session.liveliness().declare_token(f"{key}/alive")
        verbs = ", ".join(f'"v{number}"' for number in range(20_000))
        state = (
            '{"id": "cart_1", "kind": "zenoh", "battery_percent": -500, "speed_mps": -1e30, "mode": "AUTO", '
            f'"pose": {{"x": NaN}}, "home": {{"x": 3.0}}, "verbs": [{verbs}]}}'
        )

        def act() -> None:
            end.send(beat())
            for number, fields in enumerate((place, absurd)):
                position = make("GLOBAL_POSITION_INT", time_boot_ms=number, hdg=9000 + 50_000 * number, **fields)
                end.send(codec.pack(position))
            session.put(f"{key}/state", state.encode(), encoding="application/json")

        try:
            await it.until(
                lambda: (
                    {"drone_1", "cart_1"} <= set(it.robots())
                    and it.robots()["drone_1"].pose is not None
                    and it.refused().get("implausible", 0) > 1
                    and it.refused().get("implausible robot/*/state", 0) > 1
                ),
                act,
            )
            cart, drone = it.robots()["cart_1"], it.robots()["drone_1"]
            assert (cart.battery_percent, cart.speed_mps, cart.pose, cart.verbs) == (None, None, None, ())
            assert cart.home is not None
            assert (cart.mode, cart.home.x, cart.online) == ("AUTO", 3.0, True)
            assert drone.pose is not None
            assert (drone.speed_mps, drone.pose.heading_deg) == (3.0, 90.0)
            code, printed = await swiftbot(it.fleet, "robots", "list", "--json")
            assert code == 0
            assert not [each for each in ("NaN", "e+30", "-500", "v19999") if each in printed]
        finally:
            token.undeclare()
            await asyncio.to_thread(session.close)


@pytest.mark.long
async def test_a_second_robot_of_a_name_is_refused_and_reported(tmp_path: Path) -> None:
    """A second `swiftbot sim zenoh` of one name: users see it, its row not flipped, and it takes no command."""
    async with gateway_process(tmp_path, zenoh=1) as it:
        await it.until(lambda: "rover_1" in it.robots() and it.robots()["rover_1"].online)
        notices: asyncio.Queue[Notice] = asyncio.Queue()
        it.client.on_notice(notices)
        first = it.robots()["rover_1"].speaker
        second = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "appliance.cli", "sim", "zenoh", "--name", "rover_1", "--fleet", it.fleet.fleet,
            "--connect", it.fleet.endpoints[0], stdout=asyncio.subprocess.DEVNULL, stderr=asyncio.subprocess.DEVNULL,
        )  # fmt: skip
        try:
            await it.until(lambda: "another robot calls itself rover_1" in it.robots()["rover_1"].note)
            async with asyncio.timeout(10):
                while "a second robot that calls itself rover_1 is refused" not in (await notices.get()).text:
                    pass
            order: dict[str, Any] = {"waypoints": [{"x": 10.0, "y": 4.0}], "speed_mps": 2.0}
            states: list[RobotInfo] = []
            session = it.client.plane.session
            session.subscribe_typed(keyspace.ROBOT, lambda _, each: each and states.append(each), "rover_1")
            lease = await it.client.take_over("rover_1", lease_s=60.0)
            await it.client.drive(lease, "goto", timeout_s=60.0, **order)
            await it.client.give_back(lease)
            await asyncio.sleep(6.0)  # it shows itself again meanwhile
            moved = {each.speaker for each in states if each.pose is not None and each.pose.x > 9.0}
            assert moved == {first}
            assert it.robots()["rover_1"].speaker == first
            assert it.robots()["rover_1"].pose is not None
        finally:
            with contextlib.suppress(ProcessLookupError):  # it waits for the name, or has ended with the conflict
                second.terminate()
            assert await second.wait() in (0, Exit.REFUSED)


async def test_no_command_is_carried_out_by_two_that_others_wrote(tmp_path: Path) -> None:
    """They say nothing of which they are and look at nothing: neither is ordered while both answer."""
    async with gateway_process(tmp_path) as it:
        carts = [await asyncio.to_thread(Cart, it.fleet) for _ in range(2)]
        try:
            await it.until(lambda: "cart_1" in it.robots(), lambda: [each.tell() for each in carts])
            lease = await it.client.take_over("cart_1", lease_s=60.0)
            with pytest.raises(RefusedError, match="2 robots answer to the name cart_1"):
                await it.client.drive(lease, "goto", waypoints=[{"x": 5.0, "y": 4.0}], speed_mps=1.0)
            assert not [each for cart in carts for each in cart.ordered if each.verb == "goto"]
            await asyncio.to_thread(carts.pop().close)
            await it.client.drive(lease, "goto", waypoints=[{"x": 5.0, "y": 4.0}], speed_mps=1.0)
            assert len([each for each in carts[0].ordered if each.verb == "goto"]) == 1
        finally:
            for cart in carts:
                await asyncio.to_thread(cart.close)


async def test_a_client_library_is_refused_a_name_that_is_taken(tmp_path: Path) -> None:
    """`register` raises, the list says that there was another, and the name is free when the first one is gone."""
    async with gateway_process(tmp_path) as it:
        sessions = [await asyncio.to_thread(open_zenoh, it.fleet) for _ in range(2)]
        one, two = (AsyncZenohTaskClient(each, fleet=it.fleet.fleet, robot="cart_1") for each in sessions)
        try:
            mine = await one.register(uses=("base",), verbs=("state", "goto"))
            with pytest.raises(ZenohTaskRejected, match="there is a robot that calls itself cart_1"):
                await two.register(wait_s=0.5)
            await it.until(lambda: "another robot" in it.robots()["cart_1"].note, mine.update)
            await asyncio.to_thread(mine.close)
            await two.register(uses=("base",), verbs=("state",), wait_s=20.0)
        finally:
            for each in sessions:
                await asyncio.to_thread(each.close)


class Cart:
    """A robot that others wrote: it does all that it is ordered."""

    def __init__(self, fleet: FleetState) -> None:
        self.ordered: list[RobotCommand] = []
        self._session = open_zenoh(fleet)
        self._key = f"swiftbot/{fleet.fleet}/robot/cart_1"
        self._token = self._session.liveliness().declare_token(f"{self._key}/alive")
        self._served = self._session.declare_queryable(f"{self._key}/command", self._do)

    def _do(self, query: Any) -> None:
        command = msgspec.json.decode(query.payload.to_bytes(), type=RobotCommand)
        self.ordered.append(command)
        query.reply(str(query.key_expr), encode(RobotReply(id=command.id)))

    def tell(self) -> None:
        """Put its state."""
        info = RobotInfo(
            id="cart_1", kind="zenoh", uses=("base",), verbs=("goto", "state", "stop"), pose=Pose(x=4.0, y=4.0)
        )
        self._session.put(f"{self._key}/state", encode(info), encoding="application/json")

    def close(self) -> None:
        """Leave."""
        self._token.undeclare()
        self._served.undeclare()
        self._session.close()


async def test_of_two_robots_that_start_at_once_the_older_has_the_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither sees the other when it looks: the younger ends with the reason, and orders reach the older."""

    async def sees_nobody(*_: Any) -> bool:
        return True

    monkeypatch.setattr(Rover, "_until_free", sees_nobody)
    async with gateway_process(tmp_path) as it:
        for turn in range(3):
            name, stop = f"rover_{turn}", asyncio.Event()
            settings = RobotSettings(
                name=name, fleet=it.fleet.fleet, connect=tuple(it.fleet.endpoints), site=load_site("warehouse")
            )
            both = [asyncio.create_task(run_robot(settings, stop=stop)) for _ in range(2)]
            try:
                (ended,), (going,) = await asyncio.wait(both, timeout=20.0, return_when=asyncio.FIRST_COMPLETED)
                with pytest.raises(ConflictError, match=f"another robot is called {name}, and started earlier"):
                    ended.result()
                await it.until(lambda name=name: name in it.robots() and it.robots()[name].online)
                lease = await it.client.take_over(name, lease_s=10.0)
                await it.client.drive(lease, "goto", timeout_s=30.0, waypoints=[{"x": 3.0, "y": 8.0}], speed_mps=1.0)
                await it.client.give_back(lease)
                assert not going.done()
            finally:
                stop.set()
                await asyncio.gather(*both, return_exceptions=True)


async def test_of_two_client_libraries_that_register_at_once_one_has_the_name(tmp_path: Path) -> None:
    """The other one raises, and the list shows the one that has it."""
    async with gateway_process(tmp_path) as it:
        sessions = [await asyncio.to_thread(open_zenoh, it.fleet) for _ in range(2)]
        try:
            clients = [AsyncZenohTaskClient(each, fleet=it.fleet.fleet, robot="cart_9") for each in sessions]
            got = await asyncio.gather(*(each.register(wait_s=2.0) for each in clients), return_exceptions=True)
            (refused,) = [each for each in got if isinstance(each, ZenohTaskRejected)]
            assert refused.code == "conflict"
            await it.until(lambda: "cart_9" in it.robots() and it.robots()["cart_9"].online)
        finally:
            for each in sessions:
                await asyncio.to_thread(each.close)


@pytest.mark.long
async def test_what_a_ground_station_says_in_a_real_flight_makes_no_robot(tmp_path: Path, data: Path) -> None:
    """A submarine's log, played from one end, then all else that system 255 may say: the list has the submarine."""
    log = (data / "mavlink/ardusub-4.1.1-small.tlog").read_bytes()
    frames: list[bytes] = []
    at = 0
    while at < len(log) and len(frames) < 6000:
        length = frame_length(log, at + 8) or 0
        frames.append(log[at + 8 : at + 8 + length])
        at += 8 + length
    assert any(each[0] == 0xFD and each[5] == 255 for each in frames)
    station, zeros = Codec(255, 190), {f"param{number}": 0.0 for number in range(1, 8)}
    target = {"target_system": 1, "target_component": 1}
    said = [
        make("HEARTBEAT", **STATION),
        make("PARAM_REQUEST_LIST", **target),
        make("COMMAND_LONG", command=512, confirmation=0, **target, **zeros),
        make("MANUAL_CONTROL", target=1, x=0, y=0, z=500, r=0, buttons=0),
        make("SYSTEM_TIME", time_unix_usec=1, time_boot_ms=1),
        make("MISSION_REQUEST_LIST", mission_type=0, **target),
        make("TIMESYNC", tc1=0, ts1=1),
        make("STATUSTEXT", severity=6, text=b"hello", id=0, chunk_seq=0),
        make("GLOBAL_POSITION_INT", time_boot_ms=1, lat=1, lon=1, alt=0, relative_alt=0, vx=0, vy=0, vz=0, hdg=0),
    ]
    for route in (True, False):
        (tmp_path / str(route)).mkdir()
        async with gateway_process(tmp_path / str(route), RobotsConfig(route=route)) as it:
            end = it.connect("udp", await it.link("udp"))
            for number in range(0, len(frames), 50):
                for each in frames[number : number + 50]:
                    end.send(each)
                await asyncio.sleep(0.02)  # a datagram socket's buffer holds no more
            codecs = [station, *(Codec(255, component) for component in (1, 0, 25, 191, 240))]
            beats_of = [Codec(255, component).pack(make("HEARTBEAT", **STATION)) for component in (1, 0, 25, 191, 240)]

            def act(codecs: list[Codec] = codecs, beats_of: list[bytes] = beats_of, end: socket.socket = end) -> None:
                for each in (*(codec.pack(message) for codec in codecs for message in said), *beats_of):
                    end.send(each)

            until = time.monotonic() + 3.0
            await it.until(lambda until=until: "drone_1" in it.robots() and time.monotonic() > until, act)
            code, printed = await swiftbot(it.fleet, "robots", "list")
            assert code == 0
            assert "255" not in printed
            assert set(it.robots()) == {"drone_1"}
