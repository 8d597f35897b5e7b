"""The registry on real sessions: facts spread, reach latecomers, and go with their owner."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest
import zenoh

from appliance.errors import UnreachableError
from appliance.model import ContainerInfo, ContainerState, GatewayStatus, RobotInfo, encode, keyspace
from appliance.plane import registry
from appliance.plane.client import PlaneClient
from appliance.plane.events import FactsChanged, FleetEvent, Stage
from appliance.plane.node import Plane
from appliance.plane.registry import Registry
from appliance.plane.rpc import Rpc
from appliance.plane.session import Message, Session
from appliance.plane.settings import PlaneConfig

pytestmark = pytest.mark.anyio


async def _until(condition: Callable[[], object]) -> None:
    """Wait until something is so; the test's own timeout bounds it."""
    while not condition():
        await asyncio.sleep(0.01)


@pytest.fixture
async def two(tmp_path: Path, free_ports: Callable[..., list[int]]) -> AsyncIterator[tuple[Plane, Plane]]:
    """Two gateways that see each other, and have asked each other for what was told before."""
    endpoints = [f"tcp/127.0.0.1:{port}" for port in free_ports(2)]
    one = await Plane.open(PlaneConfig(listen=(endpoints[0],)), fleet="f", gateway="g0", data_dir=tmp_path / "g0")
    config = PlaneConfig(listen=(endpoints[1],), connect=(endpoints[0],))
    other = await Plane.open(config, fleet="f", gateway="g1", data_dir=tmp_path / "g1")
    await _until(lambda: len(one.members()) == len(other.members()) == 2)
    for each in (one, other):
        await each.registry.wait_for_facts()
    yield one, other
    await one.close()
    await other.close()


def _client(plane: Plane) -> PlaneConfig:
    return PlaneConfig(mode="client", connect=plane.config.listen, connect_timeout_s=1)


def _container(gateway: str, name: str, state: ContainerState = ContainerState.READY) -> ContainerInfo:
    return ContainerInfo(id=name, gateway=gateway, image="base", state=state)


async def test_facts_spread_and_go(two: tuple[Plane, Plane]) -> None:
    """Status and containers of one are known to the other; a container left out is gone; listeners hear of it."""
    one, other = two
    told: list[FleetEvent] = []
    other.events.subscribe(Stage.WATCHERS, told.append)
    one.registry.publish_status(GatewayStatus(id="g0", fleet="f", load=0.5))
    one.registry.publish_containers((_container("g0", "a"), _container("g0", "b")))
    assert one.registry.gateways["g0"].load == 0.5
    await _until(lambda: "g0" in other.registry.gateways and len(other.registry.containers.get("g0", {})) == 2)
    one.registry.publish_containers((_container("g0", "b", ContainerState.BUSY),))
    await _until(lambda: list(other.registry.containers["g0"]) == ["b"])
    await _until(lambda: other.registry.containers["g0"]["b"].state is ContainerState.BUSY)
    assert {FactsChanged("gateway"), FactsChanged("container")} <= set(told)


async def test_a_burst_is_published_once(two: tuple[Plane, Plane]) -> None:
    """Changes within the coalescing time become one message, the last one; unchanged containers are not repeated."""
    one, other = two
    seen: list[Message] = []
    other.session.subscribe(other.keys(keyspace.STATUS), seen.append)
    other.session.subscribe(other.keys(keyspace.CONTAINER), seen.append)
    while not seen:
        one.registry.publish_status(GatewayStatus(id="g0", fleet="f"))
        await asyncio.sleep(0.05)
    await asyncio.sleep(0.2)
    seen.clear()
    for load in range(50):
        one.registry.publish_status(GatewayStatus(id="g0", fleet="f", load=load))
        one.registry.publish_containers((_container("g0", "a"),))
    await _until(lambda: len(seen) >= 2)
    one.registry.publish_containers((_container("g0", "a"), _container("g0", "b")))
    await _until(lambda: any(message.key.endswith("/b") for message in seen))
    assert [message.key.split("/")[-1] for message in seen if message.key.endswith("/a")] == ["a"]
    assert b'"load":49' in next(message.payload for message in seen if message.key.endswith("status"))


async def test_latecomers_get_the_facts(two: tuple[Plane, Plane], tmp_path: Path) -> None:
    """A gateway and a client that come later know at once what was put before, by asking every member."""
    one, other = two
    for plane in two:
        plane.registry.publish_status(GatewayStatus(id=plane.gateway, fleet="f"))
        plane.registry.publish_containers((_container(plane.gateway, f"c-{plane.gateway}"),))
    robot = RobotInfo(id="r1", kind="zenoh")
    while "r1" not in one.registry.robots:
        other.session.publish(keyspace.ROBOT, robot, "r1")
        await asyncio.sleep(0.02)
    client = await PlaneClient.open(_client(one), fleet="f")
    assert client.members() == {"g0", "g1"}
    assert set(client.registry.gateways) == {"g0", "g1"}
    assert {name: list(held) for name, held in client.registry.containers.items()} == {"g0": ["c-g0"], "g1": ["c-g1"]}
    assert client.registry.robots == {"r1": robot}
    chosen = await client.any_gateway()
    assert chosen in {"g0", "g1"}
    assert await client.any_gateway() == chosen
    await client.close()
    late = await Plane.open(PlaneConfig(connect=one.config.listen), fleet="f", gateway="g2", data_dir=tmp_path / "g2")
    await _until(lambda: set(late.registry.gateways) == {"g0", "g1"} and len(late.registry.containers) == 2)
    await late.close()


async def test_facts_of_a_lost_gateway_go(two: tuple[Plane, Plane]) -> None:
    """When a gateway goes, its status and containers go with it, for gateways and clients."""
    one, other = two
    client = await PlaneClient.open(_client(one), fleet="f")
    other.registry.publish_status(GatewayStatus(id="g1", fleet="f"))
    other.registry.publish_containers((_container("g1", "a"),))
    await _until(
        lambda: all("g1" in each.registry.containers and "g1" in each.registry.gateways for each in (one, client))
    )
    await other.close()
    await _until(lambda: all("g1" not in each.registry.gateways for each in (one, client)))
    assert "g1" not in one.registry.containers
    assert client.members() == {"g0"}
    await client.close()


async def test_robots_come_and_go(two: tuple[Plane, Plane]) -> None:
    """A robot's state is known everywhere; when its token goes it is offline, and online again when it speaks."""
    one, other = two
    robot = await Session.open(_client(one), "f")
    token = robot.declare_alive(robot.keys(keyspace.ROBOT_ALIVE, "r1"))
    info = RobotInfo(id="r1", kind="zenoh", battery_percent=80)
    while not all("r1" in plane.registry.robots for plane in two):
        robot.put(robot.keys(keyspace.ROBOT, "r1"), encode(info))
        await asyncio.sleep(0.02)
    assert other.registry.robots["r1"] == info
    await asyncio.sleep(0.1)
    token.close()
    await _until(lambda: all(not plane.registry.robots["r1"].online for plane in two))
    assert one.registry.robots["r1"].battery_percent == 80
    while not all(plane.registry.robots["r1"].online for plane in two):
        robot.put(robot.keys(keyspace.ROBOT, "r1"), encode(info))
        await asyncio.sleep(0.02)
    await robot.close()


async def test_malformed_and_oversize_facts(two: tuple[Plane, Plane]) -> None:
    """On every key the registry listens to: what is malformed, oversize or misplaced is counted and changes nothing."""
    one, other = two
    one.registry.publish_status(GatewayStatus(id="g0", fleet="f"))
    one.registry.publish_containers((_container("g0", "a"),))
    await _until(lambda: "g0" in other.registry.gateways and "g0" in other.registry.containers)
    foreign = await Session.open(_client(other), "f")
    keys = foreign.keys
    topics = {
        "gw/*/status": (keys(keyspace.STATUS, "g0"), encode(GatewayStatus(id="g9", fleet="f"))),
        "gw/*/pool/*": (keys(keyspace.CONTAINER, "g0", "a"), encode(_container("g9", "a"))),
        "robot/*/state": (keys(keyspace.ROBOT, "r1"), encode(RobotInfo(id="r9", kind="zenoh"))),
    }
    before = (dict(other.registry.gateways), dict(other.registry.containers))
    size = other.config.max_payload_bytes + 1
    for key, misplaced in topics.values():
        for payload in (b"", b"{", b"\xff", b"[]", b"[" * 50_000, misplaced, b"x" * size):
            foreign._wire.raw.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK)
    foreign.put(keys(keyspace.STATUS, "stranger"), encode(GatewayStatus(id="stranger", fleet="f")))
    bad_token = foreign._wire.raw.liveliness().declare_token(f"{keys.root}/gw/NOT A NAME/alive")
    await _until(
        lambda: all(
            other.session.refused.get(f"{how} {topic}", 0) == count
            for topic in topics
            for how, count in (("malformed", 5), ("misplaced", 1), ("oversize", 1))
        )
    )
    await _until(lambda: other.session.refused.get("malformed gw/*/alive") == 1)
    assert (dict(other.registry.gateways), dict(other.registry.containers)) == before
    assert other.registry.robots == {}
    assert other.members() == {"g0", "g1"}
    bad_token.undeclare()
    await foreign.close()


async def test_facts_have_an_age(two: tuple[Plane, Plane], monkeypatch: pytest.MonkeyPatch) -> None:
    """A fact's age is what its speaker said and the time since; who breaks its promise is stale, until asked again."""
    one, other = two
    assert one.registry.age_s("g0") == 0
    assert one.registry.age_s("stranger") == float("inf")
    other.registry.publish_containers((_container("g1", "a"),))
    other.registry.publish_status(GatewayStatus(id="g1", fleet="f", age_ms=5000))
    await _until(lambda: "g1" in one.registry.gateways and "a" in one.registry.containers.get("g1", {}))
    assert 5 <= one.registry.age_s("g1") < 60
    assert one.registry.age_s("g1", "a") < 5
    assert one.registry.gateways["g1"].again_ms == 2000
    assert one.registry.stale_s("g1") >= 2
    assert not one.registry.keeps_promise("g1")
    other.registry.publish_status(GatewayStatus(id="g1", fleet="f", load=0.5))
    await _until(lambda: one.registry.stale_s("g1") == 0)
    assert one.registry.keeps_promise("g1")
    # Its puts are lost from now on, so that only asking helps.
    monkeypatch.setattr(other.session, "put", lambda *_, **__: None)
    other.registry.publish_status(GatewayStatus(id="g1", fleet="f", load=0.9))
    await _until(lambda: one.registry.stale_s("g1") > 0)
    one.registry.doubt("g1")
    await _until(lambda: one.registry.gateways["g1"].load == 0.9)


async def test_a_newcomer_asks_one_for_all(
    tmp_path: Path, free_ports: Callable[..., list[int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a large fleet a newcomer has all facts from one member, with their ages; a client likewise."""
    monkeypatch.setattr(registry, "FEW_MEMBERS", 2)
    endpoints = [f"tcp/127.0.0.1:{port}" for port in free_ports(5)]
    async with contextlib.AsyncExitStack() as stack:
        planes: list[Plane] = []
        for number, endpoint in enumerate(endpoints[:4]):
            config = PlaneConfig(listen=(endpoint,), connect=tuple(endpoints[:number]))
            plane = await Plane.open(config, fleet="f", gateway=f"g{number}", data_dir=tmp_path / f"g{number}")
            stack.push_async_callback(plane.close)
            planes.append(plane)
        await _until(lambda: all(len(each.members()) == 4 for each in planes))
        for plane in planes:
            plane.registry.publish_containers((_container(plane.gateway, f"c-{plane.gateway}"),))
            plane.registry.publish_status(GatewayStatus(id=plane.gateway, fleet="f", age_ms=1000))
        await _until(lambda: all(len(each.registry.gateways) == len(each.registry.containers) == 4 for each in planes))
        asked: list[str] = []
        call = Rpc.call

        async def count(self: Rpc, gateway: str, verb: str, *rest: Any, **fields: Any) -> Any:
            if self._gateway == "g4":
                asked.append(verb)
            return await call(self, gateway, verb, *rest, **fields)

        monkeypatch.setattr(Rpc, "call", count)
        config = PlaneConfig(listen=(endpoints[4],), connect=tuple(endpoints[:4]))
        late = await Plane.open(config, fleet="f", gateway="g4", data_dir=tmp_path / "g4")
        stack.push_async_callback(late.close)
        await _until(lambda: len(late.registry.gateways) == 4)
        assert asked.count("facts") <= 2
        assert all(late.registry.age_s(f"g{number}") >= 1 for number in range(4))
        assert {name: list(held) for name, held in late.registry.containers.items()} == {
            f"g{number}": [f"c-g{number}"] for number in range(4)
        }
        late.registry.publish_status(GatewayStatus(id="g4", fleet="f"))
        await _until(lambda: all("g4" in each.registry.gateways for each in planes))
        client = await PlaneClient.open(_client(planes[0]), fleet="f")
        stack.push_async_callback(client.close)
        assert set(client.registry.gateways) == {f"g{number}" for number in range(5)}


async def test_containers_told_before_a_newcomer_listened_are_asked_for(
    tmp_path: Path, free_ports: Callable[..., list[int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A status that comes before the answer for all does not hide that its gateway has told its containers earlier."""
    monkeypatch.setattr(registry, "FEW_MEMBERS", 1)
    endpoints = [f"tcp/127.0.0.1:{port}" for port in free_ports(4)]
    async with contextlib.AsyncExitStack() as stack:
        planes: list[Plane] = []
        for number, endpoint in enumerate(endpoints[:3]):
            config = PlaneConfig(listen=(endpoint,), connect=tuple(endpoints[:number]))
            plane = await Plane.open(config, fleet="f", gateway=f"g{number}", data_dir=tmp_path / f"g{number}")
            stack.push_async_callback(plane.close)
            planes.append(plane)
        await _until(lambda: all(len(each.members()) == 3 for each in planes))
        status = GatewayStatus(id="g2", fleet="f", containers=2)
        planes[2].registry.publish_containers((_container("g2", "a"), _container("g2", "b")))
        planes[2].registry.publish_status(status)
        await _until(lambda: all(len(each.registry.containers.get("g2", {})) == 2 for each in planes))
        take = Registry._take_others

        def late_answer(self: Registry, others: Any) -> None:
            self._on_status("swiftbot/f/gw/g2/status", status)  # what was heard on the way is newer than the answer
            take(self, others)

        monkeypatch.setattr(Registry, "_take_others", late_answer)
        config = PlaneConfig(listen=(endpoints[3],), connect=tuple(endpoints[:3]))
        late = await Plane.open(config, fleet="f", gateway="g3", data_dir=tmp_path / "g3")
        stack.push_async_callback(late.close)
        await _until(lambda: set(late.registry.containers.get("g2", {})) == {"a", "b"})


async def test_a_client_of_an_empty_fleet_says_so(two: tuple[Plane, Plane]) -> None:
    """Asking for a gateway of a fleet that has none is an error that names the fleet."""
    client = await PlaneClient.open(_client(two[0]), fleet="nobody")
    with pytest.raises(UnreachableError, match="fleet nobody"):
        await client.any_gateway(timeout_s=0.1)
    await client.close()
