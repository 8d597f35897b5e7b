"""The live view, as a WebSocket client that speaks Foxglove's protocol sees it."""

import asyncio
import base64
import json
import struct
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import aiohttp
import msgspec
import pytest

from appliance.errors import ConfigError
from appliance.model import GatewayStatus, LogLine, Pose, RobotInfo, Site, encode, keyspace
from appliance.plane.session import Session
from appliance.plane.settings import PlaneConfig
from appliance.ports import free_port
from appliance.record import foxglove_bridge
from appliance.record.channels import topic_of_kind
from appliance.record.foxglove_bridge import NAME, LiveOptions, LiveView, viewing
from appliance.record.models import LoggedMessage
from appliance.record.reader import info
from appliance.record.recorder import Recorder
from appliance.record.segments import About
from appliance.record.settings import RecordConfig

pytestmark = pytest.mark.anyio
PROTOCOL = "foxglove.sdk.v1"
MESSAGE_DATA = 1
"""Opcode of a message: subscription id (uint32), log time (uint64), payload, little endian."""


@pytest.fixture
async def sessions() -> AsyncIterator[tuple[Session, Session]]:
    """Return a session that speaks as the fleet, and one for the view."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    speaker = await Session.open(PlaneConfig(mode="peer", listen=(endpoint,)), "fox1")
    viewer = await Session.open(PlaneConfig(mode="client", connect=(endpoint,)), "fox1")
    try:
        yield speaker, viewer
    finally:
        await viewer.close()
        await speaker.close()


class Client:
    """A client of the protocol, as far as panels need it."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self._socket = socket
        self.channels: dict[str, dict[str, Any]] = {}
        self.heard: dict[str, list[tuple[int, bytes]]] = {}
        self._subscribed: dict[int, str] = {}

    async def turn(self) -> None:
        """Take one message of the server; subscribe to each channel as it is advertised."""
        async with asyncio.timeout(30):
            message = await self._socket.receive()
        if message.type is aiohttp.WSMsgType.BINARY:
            opcode, subscription, at_ns = struct.unpack_from("<BIQ", message.data)
            if opcode == MESSAGE_DATA:
                self.heard.setdefault(self._subscribed[subscription], []).append((at_ns, message.data[13:]))
            return
        assert message.type is aiohttp.WSMsgType.TEXT, message
        told = json.loads(message.data)
        if told["op"] == "advertise":
            wanted: list[dict[str, int]] = []
            for channel in told["channels"]:
                self.channels[channel["topic"]] = channel
                self._subscribed[channel["id"]] = channel["topic"]
                wanted.append({"id": channel["id"], "channelId": channel["id"]})
            await self._socket.send_str(json.dumps({"op": "subscribe", "subscriptions": wanted}))


async def test_the_fleet_is_seen_as_in_a_log(sessions: tuple[Session, Session], tmp_path: Path) -> None:
    """A client is offered the recorder's channels with its schemas, and gets what is put, derived messages too."""
    speaker, viewer = sessions
    keys = speaker.keys
    about = About(site=Site(), secrets=("planted-7d1c",))
    recorder = Recorder(
        viewer, RecordConfig(directory=str(tmp_path), free_bytes=0, name=NAME), about=About(site=Site())
    )
    await recorder.start()
    robot = encode(RobotInfo(id="r1", kind="zenoh", pose=Pose(x=1.0, y=2.0)))
    line = encode(LogLine(at_ns=5, level="info", source="g", event="said planted-7d1c", fields={"password": "x1y2z3"}))

    async def speak() -> None:
        while True:
            speaker.put(keys(keyspace.ROBOT, "r1"), robot)
            speaker.put(keys(keyspace.STATUS, "g1"), encode(GatewayStatus(id="g1", fleet="fox1")))
            speaker.put(keys(keyspace.LOG, "g1"), line)
            speaker.put(keys(keyspace.MAVLINK, "r1", "rx"), b"\xfd\x00\x01", encoding="application/octet-stream")
            await asyncio.sleep(0.05)

    speaking = asyncio.create_task(speak())
    states = topic_of_kind(keys.fleet, keyspace.ROBOT)
    wanted = {
        states,
        keys(keyspace.STATUS, "g1"),
        keys(keyspace.LOG, "g1"),
        keys(keyspace.MAVLINK, "r1", "rx"),
        keys(keyspace.RECORDER_LOG, NAME),
    }
    wanted |= {keys(keyspace.RECORDER_VIEW, NAME, what) for what in ("transform", "location")}
    try:
        async with (
            viewing(viewer, LiveOptions(port=0), about=about) as (_, _, port),
            aiohttp.ClientSession() as http,
            http.ws_connect(f"ws://127.0.0.1:{port}", protocols=[PROTOCOL]) as socket,
        ):
            assert socket.protocol == PROTOCOL
            client = Client(socket)
            while not wanted <= client.heard.keys():
                await client.turn()
    finally:
        speaking.cancel()
        await asyncio.gather(speaking, return_exceptions=True)
        await recorder.stop()
    assert client.heard[keys(keyspace.MAVLINK, "r1", "rx")][0][1] == b"\xfd\x00\x01"
    assert client.heard[states][0][1] == robot
    frame = msgspec.json.decode(client.heard[keys(keyspace.RECORDER_VIEW, NAME, "transform")][0][1])
    assert (frame["child_frame_id"], frame["translation"]) == ("r1", {"x": 1.0, "y": 2.0, "z": 0.0})
    said = b"".join(payload for _, payload in client.heard[keys(keyspace.LOG, "g1")])
    assert b"planted-7d1c" not in said
    assert b"x1y2z3" not in said
    (path,) = tmp_path.glob("*.mcap")
    logged = {channel.key: channel for channel in info(path).channels}
    for topic in wanted:
        offered = client.channels[topic]
        assert (offered["encoding"], offered["schemaName"]) == (logged[topic].encoding, logged[topic].schema)
        if offered["schemaName"]:
            schema = offered["schema"]
            text = base64.b64decode(schema) if offered.get("schemaEncoding") == "protobuf" else schema
            assert json.loads(text)["type"] == "object"


async def test_keys_without_end_cost_no_memory(
    sessions: tuple[Session, Session], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Channels are bounded, wanted or not: those that were silent for longest go, one that goes on speaking stays."""
    monkeypatch.setattr(foxglove_bridge, "MOST_CHANNELS", 20)
    speaker, viewer = sessions
    keys = speaker.keys
    for wanted in ((), (keys(keyspace.LOG, "g1"),)):
        view = LiveView(viewer, LiveOptions(port=0, keys=wanted))
        try:
            messages = [
                LoggedMessage(key, 5, b"{}", "application/json")
                for number in range(200)
                for key in (keys(keyspace.LOG, "g1"), keys(keyspace.TASK_UPDATE, f"t{number}"))
            ]
            view._take(messages)
            assert len(view._channels) <= 20
            assert (keys(keyspace.LOG, "g1"), "application/json") in view._channels
            assert view.channels == (1 if wanted else len(view._channels))
        finally:
            view.stop()


def test_it_listens_on_loopback_only() -> None:
    """Another address is refused with the way to reach it from elsewhere; so is a port that cannot be."""
    with pytest.raises(ConfigError, match="without a password") as refused:
        LiveOptions(host="0.0.0.0").check()  # noqa: S104 - that is what is refused
    assert "ssh -L" in str(refused.value.remedy)
    with pytest.raises(ConfigError, match="--port"):
        LiveOptions(port=70_000).check()


async def test_a_port_in_use_is_told(sessions: tuple[Session, Session]) -> None:
    """Two views on one port: the second ends with an error that names it."""
    _, viewer = sessions
    async with viewing(viewer, LiveOptions(port=0)) as (_, _, port):
        with pytest.raises(ConfigError, match=f":{port}"):
            async with viewing(viewer, LiveOptions(port=port)):
                pytest.fail("it listens")
