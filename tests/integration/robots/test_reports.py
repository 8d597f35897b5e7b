"""Public reports of other systems tried end to end: bytes in at a real gateway's sockets, and what its users see.

One gateway process serves all tests of the module: each has system ids and links of its own. The source of each is in
the table (`tests/reports/reports.toml`), which names the test.
"""

import asyncio
import json
import math
import random
import socket
from collections import Counter
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import pytest
import zenoh
from robots_process import BEAT, STATION, Process, gateway_process, open_zenoh, read_frames

from appliance.client import FleetClient
from appliance.errors import SwiftbotError
from appliance.model import RobotInfo
from appliance.model.robot_api import LinkRemove
from appliance.robots.mavlink.dialect import KINDS, Codec, checksum, make
from appliance.robots.settings import RobotsConfig, Template
from appliance.robots.zenoh_client import ZenohTaskClient, ZenohTaskRejected

pytestmark = [pytest.mark.anyio, pytest.mark.podman]
ACCEPTED, UNSUPPORTED, IN_PROGRESS = 0, 3, 5
ONBOARD, GENERIC, GIMBAL, GROUND, NO_AUTOPILOT = 18, 0, 26, 6, 8


@pytest.fixture(scope="module")
async def it(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[Process]:
    """Run the gateway of all these tests."""
    config = RobotsConfig(templates=(Template(id=1, instruction="go to dock 3"),))
    async with gateway_process(tmp_path_factory.mktemp("reports"), config) as process:
        yield process


class Wire:
    """Who is at the other end of a link: says and hears."""

    def __init__(self, end: socket.socket, system: int, component: int = 1) -> None:
        self.end = end
        self.codec = Codec(system, component)
        self.heard: list[Any] = []

    def say(self, name: str, **fields: Any) -> bytes:
        """Send a message; return its bytes."""
        raw = self.codec.pack(make(name, **fields))
        self.end.send(raw)
        return raw

    def beat(self, **changes: int) -> bytes:
        """Send a heartbeat, a vehicle's unless the test says otherwise."""
        return self.say("HEARTBEAT", **(BEAT | changes))

    def of(self, name: str, system: int | None = None) -> list[Any]:
        """Return the messages of a name that have come so far."""
        self.heard += read_frames(self.end)
        return [each for each in self.heard if each.name == name and system in (None, each.system)]


class Field:
    """Links of one test, which go with it."""

    def __init__(self, process: Process) -> None:
        self.process = process
        self.ports: list[tuple[str, int]] = []

    async def link(self, scheme: str = "udp") -> Callable[..., Wire]:
        """Open a link; return a maker of ends of it."""
        port = await self.process.link(scheme)
        self.ports.append((scheme, port))
        return lambda system, component=1: Wire(self.process.connect(scheme, port), system, component)

    async def remove(self, place: int) -> None:
        """Remove one of the links."""
        scheme, port = self.ports.pop(place)
        order = LinkRemove(url=f"{scheme}://127.0.0.1:{port}", by="a test")
        await self.process.client.robot_link_remove(self.process.gateway, order)

    async def online(self, robot: str, act: Callable[[], object]) -> RobotInfo:
        """Wait until a robot is in the list and online."""
        await self.process.until(lambda: robot in self.process.robots() and self.process.robots()[robot].online, act)
        return self.process.robots()[robot]


@asynccontextmanager
async def fielded(process: Process) -> AsyncIterator[Field]:
    """Open links for a test, and remove them."""
    made = Field(process)
    try:
        yield made
    finally:
        while made.ports:
            await made.remove(-1)


async def quiet(act: Callable[[], object] = lambda: None, turns: int = 10) -> None:
    """Let so many tenths of a second go by, in which something would have come that must not."""
    for _ in range(turns):
        act()
        await asyncio.sleep(0.1)


def read_request(target: int, component: int = 1) -> dict[str, Any]:
    """Return the fields of a question for a parameter."""
    return {"target_system": target, "target_component": component, "param_id": b"X", "param_index": -1}


VALUE: dict[str, Any] = {"param_id": b"X", "param_value": 1.0, "param_type": 9, "param_count": 1, "param_index": 0}


# --- routing -----------------------------------------------------------------------------------------------------


async def test_nothing_comes_back_to_its_sender(it: Process) -> None:
    """Not from an end with one component, nor with several (mavlink-router/mavlink-router#107)."""
    async with fielded(it) as field:
        vehicle = (await field.link())(11)
        await field.online("drone_11", vehicle.beat)
        await quiet(lambda: (vehicle.beat(), vehicle.say("PARAM_VALUE", **VALUE)))
        assert not vehicle.of("PARAM_VALUE", 11)
        assert not vehicle.of("HEARTBEAT", 11)


async def test_components_of_one_end_do_not_hear_each_other_by_the_gateway(it: Process) -> None:
    """They share a bus of their own; what is for one of them does not come back (mavlink-router/mavlink-router#118)."""
    async with fielded(it) as field:
        ends = await field.link()
        vehicle, ground = ends(12), ends(255, 190)
        gimbal = Codec(12, 154)
        await field.online("drone_12", lambda: (vehicle.beat(), ground.beat(**STATION)))

        def act() -> None:
            vehicle.beat()
            vehicle.end.send(gimbal.pack(make("HEARTBEAT", **(BEAT | {"type": GIMBAL, "autopilot": NO_AUTOPILOT}))))
            vehicle.say("PARAM_REQUEST_READ", **read_request(12, 154))
            vehicle.end.send(gimbal.pack(make("PARAM_VALUE", **VALUE)))

        await quiet(act)
        assert not vehicle.of("PARAM_REQUEST_READ")
        assert not vehicle.of("PARAM_VALUE")
        assert ground.of("PARAM_VALUE", 12), "others hear it"


async def test_a_vehicle_with_two_links_is_one_and_heard_once(it: Process) -> None:
    """The same frames by both, the other one first each time: the station gets each once, and the vehicle stays online.

    Reported as mavlink-router/mavlink-router#240.
    """
    async with fielded(it) as field:
        radio, wifi = (await field.link())(13), (await field.link())(13)
        ground = (await field.link("tcp"))(255, 190)
        await field.online("drone_13", lambda: (radio.beat(), ground.beat(**STATION)))
        sent: list[bytes] = []
        for _ in range(50):
            raw = radio.codec.pack(make("HEARTBEAT", **BEAT))
            wifi.end.send(raw)
            await asyncio.sleep(0.05)
            radio.end.send(raw)
            sent.append(raw)
            await asyncio.sleep(0.05)
            assert it.robots()["drone_13"].online
        await it.until(lambda: len({each.raw for each in ground.of("HEARTBEAT", 13)} & set(sent)) > 45)
        counts = Counter(each.raw for each in ground.of("HEARTBEAT", 13))
        assert max(counts.values()) == 1


async def test_a_vehicle_that_lost_one_link_is_served_by_the_other(it: Process) -> None:
    """Silent on the first, it comes back over the second, and what is for it goes there.

    Reported as mavlink-router/mavlink-router#110.
    """
    async with fielded(it) as field:
        first, second = (await field.link())(14), (await field.link("tcp"))(14)
        ground = (await field.link("tcp"))(255, 190)
        await field.online("drone_14", first.beat)
        await it.until(lambda: not it.robots()["drone_14"].online)
        await field.online("drone_14", second.beat)

        def ask() -> None:
            second.beat()
            ground.say("PARAM_REQUEST_READ", **read_request(14))

        await it.until(lambda: second.of("PARAM_REQUEST_READ"), ask)
        first.heard.clear()
        read_frames(first.end)
        await quiet(ask)
        assert not first.of("PARAM_REQUEST_READ")


async def test_frames_do_not_go_round_between_two_routers(it: Process) -> None:
    """Another router gives everything back that it gets: it ends at once (mavlink-router/mavlink-router#249)."""
    async with fielded(it) as field:
        vehicle, other = (await field.link())(15), (await field.link())(250, 191)
        other.beat(type=ONBOARD, autopilot=NO_AUTOPILOT)
        await field.online("drone_15", vehicle.beat)
        counts: Counter[bytes] = Counter()
        for turn in range(100):
            if turn % 10 == 0:
                vehicle.beat()
                other.beat(type=ONBOARD, autopilot=NO_AUTOPILOT)
            for each in read_frames(other.end):
                counts[each.raw] += each.system == 15
                other.end.send(each.raw)
            await asyncio.sleep(0.02)
        assert sum(counts.values()) >= 5
        assert max(counts.values()) == 1, counts
        assert not vehicle.of("HEARTBEAT", 15)


async def test_a_datagram_that_comes_twice_is_one(it: Process) -> None:
    """A station sees what a doubling network brings once (mavlink/qgroundcontrol#12754)."""
    async with fielded(it) as field:
        ends = await field.link()
        vehicle, ground = ends(16), ends(255, 190)
        await field.online("drone_16", lambda: (vehicle.beat(), ground.beat(**STATION)))
        sent: list[bytes] = []
        for _ in range(20):
            sent.append(vehicle.say("PARAM_VALUE", **VALUE))
            vehicle.end.send(sent[-1])
            await asyncio.sleep(0.02)
        await it.until(lambda: len(ground.of("PARAM_VALUE", 16)) >= 20)
        await quiet(turns=3)
        assert Counter(each.raw for each in ground.of("PARAM_VALUE", 16)) == Counter(sent)


async def test_what_is_for_an_unknown_system_waits_for_nobody(it: Process) -> None:
    """It goes nowhere, and the next one gets there once the system was heard (mavlink-router/mavlink-router#134)."""
    async with fielded(it) as field:
        ends = await field.link()
        vehicle, other, ground = ends(17), ends(18), ends(255, 190)
        await field.online("drone_18", lambda: (other.beat(), ground.beat(**STATION)))
        await quiet(lambda: ground.say("MISSION_COUNT", target_system=17, target_component=1, count=3), turns=5)
        assert not other.of("MISSION_COUNT")
        await it.until(
            lambda: vehicle.of("MISSION_COUNT"),
            lambda: (vehicle.beat(), ground.say("MISSION_COUNT", target_system=17, target_component=1, count=3)),
        )
        assert not other.of("MISSION_COUNT")


async def test_a_station_with_an_autopilots_component_is_served(it: Process) -> None:
    """APM Planner is 252/1: both ways for longer than anything is believed, and no robot.

    Reported as mavlink-router/mavlink-router#382.
    """
    async with fielded(it) as field:
        vehicle, ground = (await field.link())(19), (await field.link())(252, 1)

        def both() -> None:
            vehicle.beat()
            ground.beat(**STATION)

        await field.online("drone_19", both)
        for _ in range(12):
            both()
            before = len(ground.of("HEARTBEAT", 19)), len(vehicle.of("HEARTBEAT", 252))
            await asyncio.sleep(0.5)
        assert len(ground.of("HEARTBEAT", 19)) > before[0] - 1 > 5
        assert len(vehicle.of("HEARTBEAT", 252)) > before[1] - 1 > 5
        assert "drone_252" not in it.robots()


async def test_a_listener_that_said_one_thing_hears_the_vehicle(it: Process) -> None:
    """One frame of any kind tells where it is (mavlink-router/mavlink-router#95)."""
    async with fielded(it) as field:
        vehicle, listener = (await field.link())(20), (await field.link())(240, 195)
        await field.online("drone_20", vehicle.beat)
        listener.say("SYSTEM_TIME", time_unix_usec=1, time_boot_ms=1)
        await it.until(lambda: len(listener.of("HEARTBEAT", 20)) > 2, vehicle.beat)


async def test_links_come_and_go_while_others_are_served(it: Process) -> None:
    """One that is added is routed to at once; one that is removed takes nothing of the others with it.

    Reported as mavlink-router/mavlink-router#413.
    """
    async with fielded(it) as field:
        vehicle = (await field.link())(21)
        await field.online("drone_21", vehicle.beat)
        for scheme in ("udp", "tcp"):
            ground = (await field.link(scheme))(254, 190)
            await it.until(
                lambda ground=ground: ground.of("HEARTBEAT", 21),
                lambda ground=ground: (ground.beat(**STATION), vehicle.beat()),
            )
            await field.remove(1)
            vehicle.beat()
            await quiet(vehicle.beat, turns=3)
            assert it.robots()["drone_21"].online


async def test_a_vehicle_is_not_mixed_up_with_another_of_its_number(it: Process) -> None:
    """On another link: it is refused and counted, and neither the list nor the map jumps between the two.

    Reported as mavlink/qgroundcontrol#14808.
    """
    async with fielded(it) as field:
        await _second_of_a_number(it, field, 22, await field.link(), await field.link("tcp"))


async def test_a_vehicle_is_not_mixed_up_on_one_port(it: Process) -> None:
    """Two that send to the same UDP port (mavlink/qgroundcontrol#3321)."""
    async with fielded(it) as field:
        ends = await field.link()
        await _second_of_a_number(it, field, 23, ends, ends)


async def _second_of_a_number(
    it: Process, field: Field, number: int, one: Callable[..., Wire], two: Callable[..., Wire]
) -> None:
    first, second = one(number), two(number)
    second.codec._mav.seq = 100  # so that what they say is not the same by chance
    place = {"lat": 473977420, "lon": 85455940, "alt": 500_000, "relative_alt": 5_000, "vx": 0, "vy": 0, "vz": 0}
    name = f"drone_{number}"

    def act() -> None:
        first.beat()
        first.say("GLOBAL_POSITION_INT", time_boot_ms=1, hdg=9000, **place)

    await field.online(name, act)
    await it.until(lambda: it.robots()[name].pose is not None, act)
    before = it.refused()
    poses: set[float] = set()
    for turn in range(20):
        act()
        second.beat()
        second.say("GLOBAL_POSITION_INT", time_boot_ms=turn, hdg=1000, **(place | {"lat": 473990000}))
        await asyncio.sleep(0.1)
        pose = it.robots()[name].pose
        assert pose is not None
        poses.add(pose.y)
    assert len(poses) == 1
    kinds = ("address_conflict", "name_conflict")
    await it.until(lambda: sum(it.refused().get(each, 0) - before.get(each, 0) for each in kinds) > 0, act)


async def test_a_vehicle_that_changes_its_number_is_the_last_one(it: Process) -> None:
    """While it boots it says another: that row goes offline, the right one stays (ArduPilot/ardupilot#4912)."""
    async with fielded(it) as field:
        boot = (await field.link())(24)
        await field.online("drone_24", boot.beat)
        boot.codec = Codec(25, 1)
        await field.online("drone_25", boot.beat)
        await it.until(lambda: not it.robots()["drone_24"].online, boot.beat)
        assert it.robots()["drone_25"].online


async def test_a_radios_heartbeats_make_no_vehicle(it: Process) -> None:
    """A Herelink's two components, neither with an autopilot (ArduPilot/pymavlink#769)."""
    async with fielded(it) as field:
        link = await field.link()
        radio, vehicle = link(42, 250), link(26)
        other = Codec(42, 100)
        generic = make("HEARTBEAT", **(BEAT | {"type": GENERIC, "autopilot": NO_AUTOPILOT}))

        def act() -> None:
            radio.beat(type=ONBOARD, autopilot=NO_AUTOPILOT, base_mode=255)
            radio.end.send(other.pack(generic))
            vehicle.beat()

        await field.online("drone_26", act)
        await quiet(act)
        assert "drone_42" not in it.robots()


async def test_a_companions_heartbeat_changes_no_mode(it: Process) -> None:
    """A component of the vehicle's system with another mode, by the same way and by its own.

    Reported as ArduPilot/pymavlink#87.
    """
    async with fielded(it) as field:
        link = await field.link()
        vehicle, aside = link(27), link(27, 191)
        companion = Codec(27, 191)
        other = make("HEARTBEAT", **(BEAT | {"type": ONBOARD, "autopilot": NO_AUTOPILOT, "custom_mode": 0}))

        def act() -> None:
            vehicle.beat()
            vehicle.end.send(companion.pack(other))
            aside.beat(type=ONBOARD, autopilot=NO_AUTOPILOT, custom_mode=0, base_mode=192)

        assert (await field.online("drone_27", act)).mode == "GUIDED"
        modes: set[tuple[str, bool]] = set()
        for _ in range(15):
            act()
            await asyncio.sleep(0.1)
            modes.add((it.robots()["drone_27"].mode, it.robots()["drone_27"].armed))
        assert modes == {("GUIDED", False)}


async def test_a_gimbal_at_an_address_of_its_own_is_reached(it: Process) -> None:
    """It has the vehicle's system id: it is no vehicle, and gets what is for it (ArduPilot/ardupilot#20946)."""
    async with fielded(it) as field:
        link = await field.link()
        vehicle, gimbal, ground = link(28), link(28, 154), link(255, 190)

        def act() -> None:
            vehicle.beat()
            gimbal.beat(type=GIMBAL, autopilot=NO_AUTOPILOT)
            ground.say("PARAM_REQUEST_READ", **read_request(28, 154))

        await field.online("drone_28", vehicle.beat)
        await it.until(lambda: gimbal.of("PARAM_REQUEST_READ"), act)
        assert not vehicle.of("PARAM_REQUEST_READ")
        gimbal.say("PARAM_VALUE", **VALUE)
        await it.until(lambda: ground.of("PARAM_VALUE", 28))


async def test_a_station_with_a_vehicles_number_is_served(it: Process) -> None:
    """Both have system 29: the vehicle stays online, and the station hears it (PX4/PX4-Autopilot#11998)."""
    async with fielded(it) as field:
        link = await field.link()
        vehicle, ground = link(29), link(29, 190)

        def act() -> None:
            vehicle.beat()
            ground.beat(**STATION)

        await field.online("drone_29", vehicle.beat)
        await it.until(lambda: ground.of("HEARTBEAT", 29) and vehicle.of("HEARTBEAT", 29), act)
        assert it.robots()["drone_29"].online


async def test_a_vehicle_with_a_stations_number_is_served(it: Process) -> None:
    """A vehicle 255/1 and a station 255/190: each gets what is for it (mavlink/qgroundcontrol#4523)."""
    async with fielded(it) as field:
        vehicle, ground = (await field.link())(255), (await field.link("tcp"))(255, 190)

        def act() -> None:
            vehicle.beat()
            ground.beat(**STATION)
            ground.say("PARAM_REQUEST_READ", **read_request(255))

        await field.online("drone_255", act)
        await it.until(lambda: vehicle.of("PARAM_REQUEST_READ"), act)
        vehicle.say("PARAM_VALUE", **VALUE)
        await it.until(lambda: ground.of("PARAM_VALUE", 255))


async def test_the_gateways_own_heartbeat_is_no_autopilots(it: Process) -> None:
    """Component 191, an onboard computer without an autopilot (bluenviron/mavp2p#46)."""
    async with fielded(it) as field:
        vehicle = (await field.link())(33)
        await it.until(lambda: vehicle.of("HEARTBEAT", 242), vehicle.beat)
        own = {(each.component, each.message.type, each.message.autopilot) for each in vehicle.of("HEARTBEAT", 242)}
        assert own == {(191, ONBOARD, NO_AUTOPILOT)}


# --- streams -----------------------------------------------------------------------------------------------------


async def test_a_stream_that_begins_within_a_frame_is_understood(it: Process) -> None:
    """Connected in mid-frame, with a marker among what is left of it: no restart is needed.

    Reported as mavlink-router/mavlink-router#463.
    """
    async with fielded(it) as field:
        vehicle = (await field.link("tcp"))(30)
        rest = Codec(30, 1).pack(make("FILE_TRANSFER_PROTOCOL", target_network=0, target_system=1, target_component=1,
                                      payload=[0xFD, 200, 0, 0, 1] * 50 + [0xFD]))[9:]  # fmt: skip
        vehicle.end.send(rest)
        await field.online("drone_30", vehicle.beat)


def framed(number: int, payload: bytes, system: int) -> bytes:
    """Return a frame with a right checksum and any payload at all."""
    head = bytes((len(payload), 0, 0, 1, system, 1, number & 255, number >> 8 & 255, number >> 16))
    return b"\xfd" + head + payload + checksum(head + payload + KINDS[number].extra).to_bytes(2, "little")


async def _crafted(it: Process, field: Field, system: int, payloads: Callable[[random.Random, int], bytes]) -> None:
    """Send a crafted frame of each message there is; a vehicle elsewhere and the gateway's users do not notice."""
    chance = random.Random(system)  # noqa: S311 - no secret
    vehicle, outside = (await field.link())(system), (await field.link())(system + 100)
    await field.online(f"drone_{system}", vehicle.beat)
    for place, number in enumerate(sorted(KINDS)):
        outside.end.send(framed(number, payloads(chance, number), system + 100))
        if place % 20 == 0:
            vehicle.beat()
            await asyncio.sleep(0.02)
            assert it.robots()[f"drone_{system}"].online
    ground = (await field.link("tcp"))(254, 190)
    await it.until(lambda: ground.of("HEARTBEAT", system), lambda: (vehicle.beat(), ground.beat(**STATION)))
    await it.client.gateway()


async def test_crafted_payloads_of_every_message(it: Process) -> None:
    """Any bytes behind a right checksum: nothing hangs (ArduPilot/ardupilot#32120)."""
    async with fielded(it) as field:
        await _crafted(it, field, 31, lambda chance, _: chance.randbytes(chance.randint(1, 255)))


async def test_payloads_of_one_byte_of_every_message(it: Process) -> None:
    """Shorter than every field but the first: nothing reads behind their end (ArduPilot/ardupilot#32121)."""
    async with fielded(it) as field:
        await _crafted(it, field, 32, lambda chance, _: bytes((chance.randint(1, 255),)))


# --- commands ----------------------------------------------------------------------------------------------------


async def _tasks(it: Process) -> set[str]:
    return {each.id for each in (await it.client.tasks(200)).tasks}


async def test_a_command_of_nothing_but_nan(it: Process) -> None:
    """It is answered as what it is, and the next one becomes a task (ArduPilot/ardupilot#17288)."""
    async with fielded(it) as field:
        ground = (await field.link())(253, 190)
        unset = {f"param{number}": math.nan for number in range(1, 8)}
        common = {"target_system": 242, "target_component": 191, "confirmation": 0}
        before = await _tasks(it)
        ground.beat(**STATION)
        for command, result in ((520, UNSUPPORTED), (31010, 2)):
            await it.until(
                lambda command=command, result=result: any(
                    (each.message.command, each.message.result) == (command, result)
                    for each in ground.of("COMMAND_ACK")
                ),
                lambda command=command: ground.say("COMMAND_LONG", command=command, **common, **unset),
            )
        assert await _tasks(it) == before
        order = unset | {"param1": 1.0, "command": 31010} | common
        ground.heard.clear()
        for confirmation in range(4):
            ground.say("COMMAND_LONG", **(order | {"confirmation": confirmation}))
        await it.until(lambda: any(each.message.result == ACCEPTED for each in ground.of("COMMAND_ACK")))
        assert len(await _tasks(it)) == len(before) + 1


async def test_a_command_int_that_is_repeated_is_one(it: Process) -> None:
    """It has no confirmation, and its answer may be lost (mavlink/mavlink#1756)."""
    async with fielded(it) as field:
        ground = (await field.link())(252, 190)
        before = await _tasks(it)
        order: dict[str, Any] = {
            "target_system": 242, "target_component": 191, "command": 31010, "frame": 0, "current": 0,
            "autocontinue": 0, "param1": 1.0, "param2": math.nan, "param3": math.nan, "param4": math.nan,
            "x": 0, "y": 0, "z": math.nan,
        }  # fmt: skip
        ground.beat(**STATION)
        for _ in range(3):
            ground.say("COMMAND_INT", **order)
            await asyncio.sleep(0.5)
        await it.until(lambda: sum(each.message.result == ACCEPTED for each in ground.of("COMMAND_ACK")) >= 1)
        assert len(await _tasks(it)) == len(before) + 1
        named = {each.message.result_param2 for each in ground.of("COMMAND_ACK") if each.message.result == ACCEPTED}
        assert len(named) == 1


# --- Zenoh -------------------------------------------------------------------------------------------------------


class Cart:
    """A robot that others wrote."""

    def __init__(self, it: Process, name: str) -> None:
        self.name = name
        self.root = f"swiftbot/{it.fleet.fleet}/robot"
        self.session = open_zenoh(it.fleet)
        self.token = self.session.liveliness().declare_token(f"{self.root}/{name}/alive")

    def tell(self, **fields: Any) -> None:
        """Put its state."""
        state = {"id": self.name, "kind": "zenoh", "uses": ["base"], "verbs": ["state", "goto", "stop"]} | fields
        self.put(f"{self.name}/state", json.dumps(state).encode())

    def put(self, key: str, payload: bytes) -> None:
        """Put anything under the robots' keys."""
        self.session.put(f"{self.root}/{key}", payload, encoding="application/json")

    def close(self) -> None:
        """Leave."""
        self.session.close()


@asynccontextmanager
async def cart(it: Process, name: str) -> AsyncIterator[Cart]:
    """A robot with its own session."""
    made = await asyncio.to_thread(Cart, it, name)
    try:
        yield made
    finally:
        await asyncio.to_thread(made.close)


def shown(it: Process, name: str) -> bool:
    """Whether a robot is in the list and online."""
    return name in it.robots() and it.robots()[name].online


async def test_a_robot_with_two_tokens_is_gone_with_the_last(it: Process) -> None:
    """Declared twice on one key and undeclared twice: it goes offline (eclipse-zenoh/zenoh#1617)."""
    async with cart(it, "cart_1") as robot:
        second = robot.session.liveliness().declare_token(f"{robot.root}/cart_1/alive")
        await it.until(lambda: shown(it, "cart_1"), robot.tell)
        robot.token.undeclare()
        second.undeclare()
        await it.until(lambda: not shown(it, "cart_1"))


async def test_a_robot_that_does_not_answer_fails_its_command(it: Process) -> None:
    """The caller hears so at the deadline, and not later (eclipse-zenoh/zenoh#1409)."""
    async with cart(it, "cart_2") as robot:
        held: list[zenoh.Query] = []
        served = robot.session.declare_queryable(f"{robot.root}/cart_2/command", held.append)
        await it.until(lambda: shown(it, "cart_2"), robot.tell)
        lease = await it.client.take_over("cart_2", lease_s=60.0)
        async with asyncio.timeout(60):
            with pytest.raises(SwiftbotError):
                await it.client.drive(lease, "goto", timeout_s=3.0, waypoints=[{"x": 5.0, "y": 4.0}])
        held.clear()
        served.undeclare()


async def test_a_put_to_all_robots_is_of_none(it: Process) -> None:
    """A key with a wildcard reaches all that listen to one of its robots: nothing is shown by it, nothing removed.

    Reported as eclipse-zenoh/zenoh#671.
    """
    async with cart(it, "cart_3") as robot:
        await it.until(lambda: shown(it, "cart_3"), lambda: robot.tell(note="mine"))
        before = set(it.robots())
        for name in ("*", "cart_3"):
            robot.put("*/state", json.dumps({"id": name, "kind": "zenoh", "note": "forged"}).encode())
        robot.put("**", json.dumps({"id": "**", "kind": "zenoh"}).encode())
        robot.session.delete(f"{robot.root}/*/state")
        await it.until(lambda: it.refused().get("misnamed robot/*/state", 0) > 0)
        assert set(it.robots()) == before
        assert it.robots()["cart_3"].note == "mine"


async def test_a_state_of_megabytes_is_not_shown(it: Process) -> None:
    """Two texts of half a megabyte are left out, a state of 20 MB is dropped; both are counted, and the robot is shown.

    Reported as eclipse-zenoh/zenoh#1835.
    """
    async with cart(it, "cart_4") as robot:
        await it.until(lambda: shown(it, "cart_4"), robot.tell)
        for size, counted in ((2**19, "implausible robot/*/state"), (10 * 2**20, "oversize robot/*/state")):
            before = it.refused().get(counted, 0)
            # Again where it does not come: the robot's own Zenoh may drop what is so large.
            await it.until(
                lambda before=before, counted=counted: it.refused().get(counted, 0) > before,
                lambda size=size: robot.tell(note="x" * size, mode="AUTO", verbs=["v" * size]),
            )
        await it.until(lambda: it.robots()["cart_4"].mode == "AUTO")
        assert (it.robots()["cart_4"].note, it.robots()["cart_4"].verbs) == ("", ())


async def test_a_request_that_comes_again_is_one_task(it: Process) -> None:
    """A bridge that was restarted brings everything twice, thrice (eclipse-zenoh/zenoh-plugin-ros2dds#570)."""
    async with cart(it, "cart_5") as robot:
        await it.until(lambda: shown(it, "cart_5"), robot.tell)
        before = await _tasks(it)
        payload = json.dumps({"instruction": "go to dock 3", "id": "cart-5-1"}).encode()
        for _ in range(4):
            robot.put("cart_5/task", payload)
        async with asyncio.timeout(30):
            while "cart-5-1" not in await _tasks(it):
                await asyncio.sleep(0.1)
        for _ in range(4):
            robot.put("cart_5/task", payload)
        await quiet()
        assert await _tasks(it) == before | {"cart-5-1"}


async def test_whoever_comes_later_sees_the_robots(it: Process) -> None:
    """A client that joins now, and one that joins again, know who is there (eclipse-zenoh/zenoh#1470)."""
    async with cart(it, "cart_6") as robot:
        await it.until(lambda: shown(it, "cart_6"), robot.tell)
        for _ in range(2):
            async with FleetClient(it.fleet.endpoint) as client:
                await client.gateway()
                async with asyncio.timeout(30):
                    while "cart_6" not in client.plane.registry.robots:
                        await asyncio.sleep(0.1)
                assert client.plane.registry.robots["cart_6"].online


async def test_many_questions_at_once_are_all_answered(it: Process) -> None:
    """A hundred requests in flight: each gets its own answer (eclipse-zenoh/zenoh-python#277)."""
    async with cart(it, "cart_7") as robot:
        client = ZenohTaskClient(robot.session, fleet=it.fleet.fleet, robot="cart_7")

        def ask(number: int) -> str:
            try:
                return client.submit("", task=f"cart-7-{number}", timeout_s=30.0)
            except ZenohTaskRejected as error:
                return str(error)

        answers = await asyncio.gather(*(asyncio.to_thread(ask, number) for number in range(100)))
        assert len(answers) == 100
        assert all("instruction" in each for each in answers), answers[:3]


async def test_a_robot_that_comes_back_is_online_again(it: Process) -> None:
    """Cut off and back with a new session, three times (eclipse-zenoh/zenoh-pico#767)."""
    for _ in range(3):
        async with cart(it, "cart_8") as robot:
            await it.until(lambda: shown(it, "cart_8"), robot.tell)
        await it.until(lambda: not shown(it, "cart_8"))


async def test_a_request_that_is_too_large_is_refused_aloud(it: Process) -> None:
    """The asker learns that it was not taken, and why (eclipse-zenoh/zenoh-pico#1200)."""
    async with cart(it, "cart_9") as robot:
        client = ZenohTaskClient(robot.session, fleet=it.fleet.fleet, robot="cart_9")
        with pytest.raises(ZenohTaskRejected, match="bytes"):
            await asyncio.to_thread(client.submit, "x" * 2**20, timeout_s=30.0)
