"""Who is who on links: signed frames played again, two with one system id, repetitions, ends of MAVLink 1 alone."""

import asyncio
import socket
from collections.abc import Callable
from typing import Any, cast

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.model import Site, keyspace
from appliance.model.robot_api import MavlinkLink
from appliance.ports import free_port
from appliance.robots.mavlink.dialect import Codec, Frame, make
from appliance.robots.mavlink.node import MavlinkNode
from appliance.robots.mavlink.signing import Signer
from appliance.robots.settings import RobotsConfig
from tests.unit.robots.conftest import FakeStore
from tests.unit.robots.links import BEAT, KEY, LINKS, STATION, Wire, beside, sender, states_told, station, until

pytestmark = pytest.mark.anyio


@pytest.mark.parametrize("kind", LINKS)
async def test_signed_frames_that_are_played_again(kind: str, tmp_path: Any) -> None:
    """On any link: each is refused as what it is, so are unsigned and wrongly signed ones, and the vehicle stays."""
    key = tmp_path / "key"
    key.write_text("hex:" + KEY.hex())
    key.chmod(0o600)
    async with beside(kind, signing=str(key), repeat_s=0.0) as (made, refused, outside, _):
        codec = Codec(1, 1, signer=Signer(KEY, link_id=1))
        recorded: list[bytes] = []

        def beat() -> None:
            recorded.append(codec.pack(make("HEARTBEAT", **BEAT)))
            outside.write(recorded[-1])

        await until(lambda: made.vehicles.attached == ("drone_1",), beat)
        assert "replayed" not in refused
        outside.write(*recorded)
        await until(lambda: refused.get("replayed", 0) == len(recorded), outside.write)
        forger = Codec(2, 1, signer=Signer(KEY[::-1], link_id=1))
        await until(lambda: refused.get("bad_signature"), lambda: outside.write(forger.pack(make("HEARTBEAT", **BEAT))))
        plain = Codec(2, 1)
        await until(lambda: refused.get("unsigned"), lambda: outside.write(plain.pack(make("HEARTBEAT", **BEAT))))
        assert made.vehicles.attached == ("drone_1",)


@pytest.mark.parametrize("kind", LINKS)
async def test_two_vehicles_with_one_system_id_on_two_links(kind: str) -> None:
    """The first one is believed; what says the same on another link is counted, and its place is not taken."""
    async with beside(kind) as (made, refused, outside, vehicle):
        one, two = Codec(1, 1), Codec(1, 1)
        await until(lambda: made.vehicles.attached, lambda: vehicle(one.pack(make("HEARTBEAT", **BEAT))))
        two._mav.seq = 100

        def both() -> None:
            vehicle(one.pack(make("HEARTBEAT", **BEAT)))
            outside.write(two.pack(make("HEARTBEAT", **(BEAT | {"custom_mode": 9, "base_mode": 128}))))

        await until(lambda: refused.get("name_conflict", 0) > 5, both)
        assert made.vehicles.attached == ("drone_1",)
        assert {(each.mode, each.armed) for each in states_told(made)} <= {("GUIDED", False)}


@settings(max_examples=5)
@given(st.lists(st.booleans(), min_size=10, max_size=60))
async def test_two_vehicles_with_one_system_id_in_any_order(order: list[bool]) -> None:
    """However their frames mix: what is published of the robot is what the first one says, and the other is counted."""
    port = free_port(socket.SOCK_DGRAM)
    async with station(port) as (made, refused), sender(port) as first, sender(port) as second:
        one, two = Codec(1, 1), Codec(1, 1)
        await until(lambda: made.vehicles.attached, lambda: first(one.pack(make("HEARTBEAT", **BEAT))))
        two._mav.seq = 100
        for mine in (*order, False):
            if mine:
                first(one.pack(make("HEARTBEAT", **BEAT)))
            else:
                second(two.pack(make("HEARTBEAT", **(BEAT | {"custom_mode": 9, "base_mode": 128}))))
        await until(lambda: refused.get("address_conflict", 0) >= 1, lambda: first(one.pack(make("HEARTBEAT", **BEAT))))
        await until(lambda: len(states_told(made)) > 3)
        assert {(each.mode, each.armed) for each in states_told(made)} == {("GUIDED", False)}


async def test_two_vehicles_with_one_system_id() -> None:
    """The first one is believed, the other's frames are counted and its place is not taken."""
    port = free_port(socket.SOCK_DGRAM)
    async with station(port) as (made, refused), sender(port) as first, sender(port) as second:
        one, two = Codec(1, 1), Codec(1, 1)
        await until(lambda: made.vehicles.attached, lambda: first(one.pack(make("HEARTBEAT", **BEAT))))
        two._mav.seq = 100

        def both() -> None:
            first(one.pack(make("HEARTBEAT", **BEAT)))
            second(two.pack(make("HEARTBEAT", **(BEAT | {"custom_mode": 9}))))

        await until(lambda: refused.get("address_conflict", 0) > 5, both)
        assert made.vehicles.attached == ("drone_1",)


@pytest.mark.parametrize(("signed", "followed"), [(False, True), (True, False)], ids=["unsigned", "signed"])
async def test_a_silent_vehicle_is_followed_to_another_link(signed: bool, followed: bool, tmp_path: Any) -> None:
    """But not from a link with a key to one without: one that jams the first would have its name."""
    key = tmp_path / "key"
    key.write_text("hex:" + KEY.hex())
    key.chmod(0o600)
    port, other = free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_DGRAM)
    link = MavlinkLink(listen=f"udp://127.0.0.1:{other}", signing=str(key) if signed else "")
    async with (
        station(port, link, heartbeat_lost_s=0.5) as (made, refused),
        sender(other) as radio,
        sender(port) as wifi,
    ):
        codec = Codec(1, 1, signer=Signer(KEY, link_id=1) if signed else None)
        plain = Codec(1, 1)
        plain._mav.seq = 100
        await until(lambda: made.vehicles.online("drone_1"), lambda: radio(codec.pack(make("HEARTBEAT", **BEAT))))
        await until(lambda: not made.vehicles.online("drone_1"))
        beat = lambda: wifi(plain.pack(make("HEARTBEAT", **BEAT)))  # noqa: E731 - said twice
        if followed:
            await until(lambda: made.vehicles.online("drone_1"), beat)
            assert "name_conflict" not in refused
        else:
            await until(lambda: refused.get("name_conflict", 0) > 3, beat)
            assert not made.vehicles.online("drone_1")
            await until(lambda: made.vehicles.online("drone_1"), lambda: radio(codec.pack(make("HEARTBEAT", **BEAT))))


async def test_an_end_that_understands_mavlink_1_alone() -> None:
    """It is a vehicle like others: what it is sent, by the gateway or from another link, is in MAVLink 1."""
    port, other = free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_DGRAM)
    heard: list[bytes] = []

    class Old(asyncio.DatagramProtocol):
        def datagram_received(self, data: bytes, _: Any) -> None:
            heard.append(data)

    async with (
        station(other, MavlinkLink(listen=f"udp://127.0.0.1:{port}", mavlink1=True)) as (made, refused),
        sender(other) as ground,
    ):
        transport, _ = await asyncio.get_running_loop().create_datagram_endpoint(Old, remote_addr=("127.0.0.1", port))
        try:
            codec, watching = Codec(5, 1, v1=True), Codec(255, 190)
            await until(lambda: made.vehicles.attached, lambda: transport.sendto(codec.pack(make("HEARTBEAT", **BEAT))))
            asked = make("COMMAND_INT", target_system=5, target_component=1, frame=3, command=192, current=0,
                         autocontinue=0, param1=0, param2=0, param3=0, param4=0, x=7, y=8, z=0)  # fmt: skip
            tunnel = {"payload_type": 1, "payload_length": 0, "payload": [0] * 128}
            unknown = make("TUNNEL", target_system=5, target_component=1, **tunnel)

            def act() -> None:
                transport.sendto(codec.pack(make("HEARTBEAT", **BEAT)))
                for message in (make("HEARTBEAT", **STATION), asked, unknown):
                    ground(watching.pack(message))

            def told() -> set[str]:
                frames = [frame for raw in heard for frame in Codec(9, 9).read(raw)]
                return {each.name for each in frames if isinstance(each, Frame)}

            await until(lambda: refused.get("no_mavlink_1") and {"HEARTBEAT", "COMMAND_INT"} <= told(), act)
            await until(lambda: "COMMAND_LONG" in told(), act)  # the gateway asks for its telemetry
            assert {raw[0] for raw in heard} == {0xFE}
            assert "TUNNEL" not in told()
            assert all(payload for key, payload in cast("Wire", made._session).puts if "/mavlink/" in key)
        finally:
            transport.close()


async def test_a_repetition_is_recorded_and_goes_no_further() -> None:
    """What comes twice stands in the log twice, under who said it; another end gets it once, which is counted there."""
    port, other = free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_DGRAM)
    async with (
        station(port, MavlinkLink(listen=f"udp://127.0.0.1:{other}"), repeat_s=600.0) as (made, refused),
        sender(port) as vehicle,
        sender(other) as ground,
    ):
        codec, watching = Codec(1, 1), Codec(255, 190)
        await until(lambda: made.vehicles.attached, lambda: vehicle(codec.pack(make("HEARTBEAT", **BEAT))))
        await until(lambda: made.link_list().routes.get("255/190"), lambda: ground(_watch(watching)))
        said, asked = codec.pack(make("HEARTBEAT", **(BEAT | {"custom_mode": 5}))), _watch(watching)
        session = cast("Wire", made._session)
        keys = session.keys

        def told(raw: bytes) -> int:
            return sum(payload == raw and key.endswith("/rx") for key, payload in session.puts)

        def passed() -> tuple[int, int]:
            links = made.link_list().links
            return links[0].passed.get("255/190", 0), links[1].passed.get("1/1", 0)

        before = passed()
        await until(lambda: told(said) > 2 and told(asked) > 2, lambda: (vehicle(said), ground(asked)))
        assert passed() == (before[0] + 1, before[1] + 1)
        assert refused["repeated"] == told(said) + told(asked) - 2
        heard = [key for key, payload in session.puts if payload == said and key.endswith("/rx")]
        assert set(heard) == {keys(keyspace.MAVLINK, "drone_1", "rx")}
        assert not any(key.endswith("/tx") for key, payload in session.puts if payload == said)
        heard = [key for key, payload in session.puts if payload == asked and key.endswith("/rx")]
        assert set(heard) == {keys(keyspace.LINK_FRAMES, "gw-1", "1", "rx")}
        assert not any(key.endswith("/tx") for key, payload in session.puts if payload == asked)


def _watch(codec: Codec) -> bytes:
    return codec.pack(make("HEARTBEAT", **STATION))


async def test_a_recorded_signed_link_played_again(tmp_path: Any) -> None:
    """Frames of a signed link that were recorded and are sent again are refused one by one, also after a restart."""
    key = tmp_path / "key"
    key.write_text("hex:" + KEY.hex())
    key.chmod(0o600)
    port, store = free_port(socket.SOCK_DGRAM), FakeStore()
    codec = Codec(1, 1, signer=Signer(KEY, link_id=1))
    recorded: list[bytes] = []
    for _ in range(2):
        refused: dict[str, int] = {}
        made = MavlinkNode(
            RobotsConfig(mavlink=(MavlinkLink(listen=f"udp://127.0.0.1:{port}", signing=str(key)),), repeat_s=0.0),
            session=cast("Any", Wire()), store=store, gateway="gw-1", site=Site(), refused=refused,
        )  # fmt: skip
        await made.start()
        async with sender(port) as attacker, sender(port) as vehicle:
            before = len(recorded)
            for raw in recorded:
                attacker(raw)
            await until(lambda refused=refused, before=before: refused.get("replayed", 0) == before)
            assert not made.vehicles.attached

            def beat(vehicle: Callable[[bytes], None] = vehicle) -> None:
                raw = codec.pack(make("HEARTBEAT", **BEAT))
                recorded.append(raw)
                vehicle(raw)

            await until(lambda made=made: made.vehicles.attached, beat)
        await made.stop()
    assert len(store.values[f"mavlink/signing/udp://127.0.0.1:{port}"]) < 2000
