"""Replays onto a real plane, heard by another session."""

import asyncio
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import msgspec
import pytest
from mcap.writer import Writer
from msgspec.structs import replace

from appliance.errors import RefusedError
from appliance.model import GatewayStatus, encode, keyspace
from appliance.model.keys import Keys
from appliance.model.recorder_api import Clock
from appliance.plane.session import Message, Session
from appliance.plane.settings import PlaneConfig
from appliance.ports import free_port
from appliance.record.edit import Select
from appliance.record.models import LoggedMessage
from appliance.record.player import Player, PlayOptions
from appliance.record.remote_control import replay, steer
from appliance.record.segments import LogWriter
from appliance.record.settings import RecordConfig

pytestmark = pytest.mark.anyio
LOGGED = Keys("then")
SECOND = 10**9


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """Return a log of ten seconds: statuses, a request for a task, a deletion, a raw frame."""
    config = RecordConfig(directory=str(tmp_path), free_bytes=0, fsync=False)
    writer = LogWriter(config, fleet="then")
    writer.prepare()
    for number in range(11):
        at_ns = (100 + number) * SECOND
        status = encode(GatewayStatus(id="g1", fleet="then", load=number / 10))
        writer.write(LoggedMessage(LOGGED(keyspace.STATUS, "g1"), at_ns, status, "application/json"))
        if number == 5:
            writer.write(
                LoggedMessage(LOGGED(keyspace.INTAKE, "r1"), at_ns, b'{"instruction":"x"}', "application/json")
            )
            writer.write(LoggedMessage(LOGGED(keyspace.CONTAINER, "g1", "c1"), at_ns, b"", "", deleted=True))
            writer.write(
                LoggedMessage(LOGGED(keyspace.MAVLINK, "r1", "rx"), at_ns, b"\xfd\x00", "application/octet-stream")
            )
    writer.close()
    return writer.files[0]


class Ear:
    """What another session hears of a replay."""

    def __init__(self) -> None:
        self.messages: list[Message] = []
        self.clocks: list[Clock] = []
        self.alive: dict[str, bool] = {}

    def loads(self) -> list[float]:
        """Return the loads that gateways told, in order."""
        return [
            msgspec.json.decode(each.payload, type=GatewayStatus).load
            for each in self.messages
            if each.key.endswith("/status")
        ]


@pytest.fixture
async def stage() -> AsyncIterator[tuple[Session, Ear]]:
    """Return the session that plays, and the ear at the other end."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    player = await Session.open(PlaneConfig(mode="peer", listen=(endpoint,)), "replay")
    listener = await Session.open(PlaneConfig(mode="client", connect=(endpoint,)), "replay")
    ear = Ear()
    listener.subscribe("swiftbot/replay/**", ear.messages.append)
    listener.subscribe("elsewhere/**", ear.messages.append)
    listener.subscribe_typed(keyspace.REPLAY_CLOCK, lambda _, clock: ear.clocks.append(clock) if clock else None)
    listener.watch_alive(listener.keys(keyspace.GATEWAY_ALIVE), ear.alive.__setitem__)
    try:
        while not ear.messages:  # its subscription has reached the player when a put comes back
            player.put("swiftbot/replay/probe", b"{}")
            await asyncio.sleep(0.05)
        ear.messages.clear()
        yield player, ear
    finally:
        await listener.close()
        await player.close()


async def _until(condition: Callable[[], object]) -> None:
    async with asyncio.timeout(60):
        while not condition():
            await asyncio.sleep(0.02)


async def test_what_was_said_is_said_again(stage: tuple[Session, Ear], log: Path) -> None:
    """Keys of another fleet, payloads byte for byte, deletions; requests for tasks are left out; gateways are there."""
    session, ear = stage
    played = await Player(session, [log], PlayOptions(rate=0.0)).play()
    assert (played.messages, played.left_out, played.ended, played.rounds) == (13, 1, True, 1)
    await _until(lambda: ear.clocks and ear.clocks[-1].ended)
    keys = session.keys
    assert ear.loads() == [number / 10 for number in range(11)]
    assert [each.payload for each in ear.messages if each.key == keys(keyspace.MAVLINK, "r1", "rx")] == [b"\xfd\x00"]
    assert [each.deleted for each in ear.messages if each.key == keys(keyspace.CONTAINER, "g1", "c1")] == [True]
    assert not any(each.key == keys(keyspace.INTAKE, "r1") for each in ear.messages)
    await _until(lambda: keys(keyspace.GATEWAY_ALIVE, "g1") in ear.alive)


async def test_a_part_on_other_keys_in_a_loop(stage: tuple[Session, Ear], log: Path) -> None:
    """Selected by time and key, put elsewhere, again and again until it is stopped; orders only when asked for."""
    session, ear = stage
    select = Select(keys=("**/status", "**/task"), since_ns=104 * SECOND, until_ns=107 * SECOND)
    options = PlayOptions(
        select=select, rate=0.0, loop=True, orders=True, remap=(("swiftbot/then/gw/g1", "elsewhere/g9"),)
    )
    player = Player(session, [log], options)
    playing = asyncio.create_task(player.play())
    await _until(lambda: len(ear.loads()) >= 7)
    player.stop()
    played = await playing
    assert not played.ended
    assert played.rounds >= 2
    assert ear.loads()[:7] == [0.4, 0.5, 0.6, 0.4, 0.5, 0.6, 0.4]
    assert {each.key for each in ear.messages if each.key.endswith("status")} == {"elsewhere/g9/status"}
    assert any(each.key == session.keys(keyspace.INTAKE, "r1") for each in ear.messages)


async def test_what_is_left_out_and_without_a_clock(stage: tuple[Session, Ear], log: Path) -> None:
    """Keys that are excluded are not played whatever is included, nor the log's time where nobody wants it."""
    session, ear = stage
    select = Select(keys=("swiftbot/**",), without=("**/status", "**/mavlink/**"))
    played = await Player(session, [log], PlayOptions(select=select, rate=0.0, clock=False, presence=False)).play()
    assert (played.messages, played.left_out, played.ended) == (1, 1, True)
    await _until(lambda: ear.messages)
    session.put(session.keys(keyspace.LOG, "end"), b"{}")
    await _until(lambda: ear.messages[-1].key == session.keys(keyspace.LOG, "end"))
    keys = session.keys
    assert [each.key for each in ear.messages] == [keys(keyspace.CONTAINER, "g1", "c1"), keys(keyspace.LOG, "end")]
    assert ear.clocks == []
    assert keys(keyspace.GATEWAY_ALIVE, "g1") not in ear.alive


async def test_by_hand(stage: tuple[Session, Ear], log: Path) -> None:
    """Begun standing: a step plays one message; a jump leaves out what lies between; back plays it again; q ends."""
    session, ear = stage
    player = Player(session, [log], PlayOptions(paused=True))
    playing = asyncio.create_task(player.play())
    await _until(lambda: ear.clocks and ear.clocks[-1].paused)
    assert ear.loads() == []
    steer(player, b".")
    await _until(lambda: ear.loads() == [0.0])
    player.seek(108 * SECOND)
    steer(player, b".")
    await _until(lambda: ear.loads() == [0.0, 0.8])
    steer(player, b"\x1b[D")  # five seconds back
    steer(player, b".")
    await _until(lambda: ear.loads() == [0.0, 0.8, 0.3])
    steer(player, b"++")
    assert player.head.rate == 4.0
    steer(player, b"q")
    assert not (await playing).ended
    await _until(lambda: ear.clocks[-1].ended)


async def test_at_its_pace(stage: tuple[Session, Ear], log: Path) -> None:
    """At twenty times the speed its ten seconds take half a second at least, and it ends by itself."""
    session, _ = stage
    played = await Player(session, [log], PlayOptions(rate=20.0)).play()
    assert played.ended
    assert played.took_s >= 0.5


async def test_damage_is_passed_over_and_told(stage: tuple[Session, Ear], tmp_path: Path) -> None:
    """A damaged chunk costs its own messages; the rest is played, and the result says what is missing."""
    session, _ = stage
    path = tmp_path / "damaged.mcap"
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=100)
        writer.start()
        channel = writer.register_channel("swiftbot/then/notice/ops", "json", 0)
        for number in range(30):
            writer.add_message(channel, number + 1, b'{"n":%d}' % number, number + 1)
        writer.finish()
    data = bytearray(path.read_bytes())
    data[len(data) // 4] ^= 0xFF
    path.write_bytes(data)
    played = await Player(session, [path], PlayOptions(rate=0.0)).play()
    assert played.ended
    assert 0 < played.messages < 30
    assert played.problems


@pytest.mark.parametrize("options", [PlayOptions(), PlayOptions(remap=(("swiftbot/then", "swiftbot/ship"),))])
async def test_a_replay_onto_a_fleet_at_work_is_refused(log: Path, options: PlayOptions) -> None:
    """Its name, and that of keys put in place of others: nothing is played, and the remedy says where it may be."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    fleet = "other" if options.remap else "ship"
    ship = await Session.open(PlaneConfig(mode="peer", listen=(endpoint,)), "ship")
    heard: list[Message] = []
    token = ship.declare_alive(ship.keys(keyspace.GATEWAY_ALIVE, "gw-1"))
    ship.subscribe("swiftbot/*/gw/**", heard.append)
    try:
        with pytest.raises(RefusedError, match=r"fleet ship is at work \(1 gateways\)") as caught:
            await replay([log], options, fleet=fleet, connect=(endpoint,))
        assert "--as" in caught.value.remedy
        assert heard == []
        token.close()
        fast = replace(options, rate=0.0)
        async with asyncio.timeout(60):
            while (await replay([log], fast, fleet=fleet, connect=(endpoint,))).messages == 0:
                await asyncio.sleep(0.1)
            while not any("/ship/" in each.key for each in heard):
                await asyncio.sleep(0.05)
    finally:
        await ship.close()
