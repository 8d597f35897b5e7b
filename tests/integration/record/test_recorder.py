"""The recorder on real Zenoh sessions, in this process and in one of its own that is killed."""

import asyncio
import contextlib
import os
import resource
import signal
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path

import msgspec
import pytest
from mcap.reader import make_reader

from appliance.errors import RecordError
from appliance.model import GatewayStatus, Notice, encode, keyspace
from appliance.model.recorder_api import Gap, RecorderStatus
from appliance.plane.session import Session
from appliance.plane.settings import PlaneConfig
from appliance.record.edit import recover
from appliance.record.models import LoggedMessage
from appliance.record.reader import info, read
from appliance.record.recorder import Recorder, run_recorder
from appliance.record.remote_control import trigger
from appliance.record.segments import LogWriter
from appliance.record.settings import RecordConfig

pytestmark = pytest.mark.anyio

PROCESS = """
import asyncio, signal, sys
from appliance.plane.settings import PlaneConfig
from appliance.record.recorder import run_recorder
from appliance.record.settings import RecordConfig
config = RecordConfig(directory=sys.argv[2], free_bytes=0, status_s=0.2)
async def go():
    stop = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, stop.set)
    await run_recorder(config, PlaneConfig(mode="peer", connect=(sys.argv[1],)), "f1", stop)
asyncio.run(go())
"""


@pytest.fixture
async def gateway(free_port: int) -> AsyncIterator[Session]:
    """Open a session that others connect to, as a gateway's."""
    session = await Session.open(PlaneConfig(listen=(f"tcp/127.0.0.1:{free_port}",)), "f1")
    yield session
    await session.close()


def _client(gateway: Session) -> PlaneConfig:
    return PlaneConfig(mode="client", connect=gateway.config.listen)


async def _until(condition: Callable[[], object]) -> None:
    """Wait until something is so, for a minute at most."""
    async with asyncio.timeout(60):
        while not condition():
            await asyncio.sleep(0.02)


@contextlib.asynccontextmanager
async def _recording(gateway: Session, config: RecordConfig) -> AsyncIterator[Recorder]:
    """Record with a session of its own, heard of by the gateway before the body runs."""
    session = await Session.open(_client(gateway), "f1")
    recorder = Recorder(session, config)
    heard = asyncio.Event()
    closer = gateway.subscribe(gateway.keys(keyspace.RECORDER_STATUS), lambda _: heard.set())
    try:
        await recorder.start()
        await asyncio.wait_for(heard.wait(), 60)
        while not recorder.stats.messages + recorder.stats.held:  # its subscription is there when a put comes back
            gateway.put(f"{gateway.keys.root}/probe", b"{}")
            await asyncio.sleep(0.05)
        yield recorder
    finally:
        await recorder.stop()
        closer.close()
        await session.close()


async def test_what_is_put_is_read_back(gateway: Session, tmp_path: Path) -> None:
    """Everything put and deleted over Zenoh is in a finished file, in order, with Zenoh's times and encodings."""
    keys = gateway.keys
    status = encode(GatewayStatus(id="g1", fleet="f1", load=0.5))
    notice = encode(Notice(id="n", to="ops", text="done", at_ns=5))
    before = time.time_ns()
    async with _recording(gateway, RecordConfig(directory=str(tmp_path), status_s=0.1)) as recorder:
        gateway.put(keys(keyspace.STATUS, "g1"), status)
        gateway.put(keys(keyspace.MAVLINK, "d1", "rx"), b"\xfd\x00\x01", encoding="application/octet-stream")
        gateway.put(keys(keyspace.NOTICE, "ops"), notice)
        for number in range(500):
            gateway.put(keys(keyspace.TRANSITION, "t1"), encode({"n": number}))
        gateway.delete(keys(keyspace.CONTAINER, "g1", "c1"))
        await _until(lambda: recorder.stats.messages >= 505)
    (path,) = tmp_path.glob("*.mcap")
    found = [message for message in read(path) if "/recorder/" not in message.key and not message.key.endswith("probe")]
    assert [(message.key, message.payload) for message in found[:3]] == [
        (keys(keyspace.STATUS, "g1"), status),
        (keys(keyspace.MAVLINK, "d1", "rx"), b"\xfd\x00\x01"),
        (keys(keyspace.NOTICE, "ops"), notice),
    ]
    assert [msgspec.json.decode(message.payload)["n"] for message in found[3:503]] == list(range(500))
    assert (found[503].key, found[503].deleted) == (keys(keyspace.CONTAINER, "g1", "c1"), True)
    assert found[0].encoding == "application/json"
    assert all(before <= message.at_ns <= time.time_ns() for message in found)
    told = info(path)
    assert not told.recovered
    assert told.metadata["fleet"] == "f1"
    with path.open("rb") as stream:
        summary = make_reader(stream, validate_crcs=True).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == told.messages
    assert "swiftbot.GatewayStatus" in {schema.name for schema in summary.schemas.values()}


async def test_what_somebody_asks_for_is_written_with_what_came_before(gateway: Session, tmp_path: Path) -> None:
    """`swiftbot log trigger` over the network: seconds before it are in the file, in order, and its reason is reported.

    Until then nothing is written; the recorder that confirms is the answer, and where there is none nobody is.
    """
    keys = gateway.keys
    assert await trigger("f1", gateway.config.listen, "odd noise", by="kim", wait_s=0.3) == []
    config = RecordConfig(directory=str(tmp_path), mode="incidents", before_s=60.0, after_s=60.0, status_s=0.1)
    async with _recording(gateway, config) as recorder:
        for number in range(300):
            gateway.put(keys(keyspace.TRANSITION, "t1"), encode({"n": number}))
        await _until(lambda: recorder.stats.held >= 300)
        assert not list(tmp_path.glob("*.mcap"))
        (told,) = await trigger("f1", gateway.config.listen, "odd noise", by="kim", wait_s=60.0)
        assert (told.id, told.incidents) == ("recorder", 1)
        assert "odd noise (by kim)" in told.last_incident
        for number in range(300, 400):
            gateway.put(keys(keyspace.TRANSITION, "t1"), encode({"n": number}))
        await _until(lambda: recorder.stats.messages >= 400)
    (path,) = tmp_path.glob("*.mcap")
    found = [msgspec.json.decode(each.payload)["n"] for each in read(path, keys=keys(keyspace.TRANSITION))]
    assert found == list(range(400))
    (incident,) = info(path).incidents
    assert (incident.reason, incident.detail) == ("asked", "odd noise (by kim)")
    assert incident.before_s > 0


async def test_status_is_put(gateway: Session, tmp_path: Path) -> None:
    """The recorder puts its account of itself, and a last one when it has stopped."""
    heard: list[RecorderStatus] = []
    gateway.subscribe_typed(keyspace.RECORDER_STATUS, lambda _, status: heard.append(status) if status else None)
    async with _recording(gateway, RecordConfig(directory=str(tmp_path), status_s=0.1, name="rec1")):
        await _until(lambda: any(status.messages for status in heard))
    await _until(lambda: heard[-1].state == "stopped")
    assert heard[-1].id == "rec1"
    assert {status.state for status in heard} <= {"starting", "recording", "stopped"}


async def test_oversize_payload_is_a_gap(gateway: Session, tmp_path: Path) -> None:
    """A payload over the recorder's bound is not in the log, and the log says that one is missing."""
    config = RecordConfig(directory=str(tmp_path), message_bytes=1000, status_s=0.1)
    async with _recording(gateway, config) as recorder:
        gateway.put(gateway.keys(keyspace.TRANSITION, "t1"), b"x" * 5000)
        await _until(lambda: recorder.stats.dropped.get("too large"))
    (path,) = tmp_path.glob("*.mcap")
    gaps = [msgspec.json.decode(message.payload, type=Gap) for message in read(path, keys="swiftbot/*/recorder/*/gap")]
    assert [(gap.reason, gap.dropped, gap.payload_bytes) for gap in gaps] == [("too large", 1, 5000)]


async def test_malformed_payloads_are_kept(gateway: Session, tmp_path: Path) -> None:
    """Garbage on a typed key is evidence: it is in the log byte for byte."""
    async with _recording(gateway, RecordConfig(directory=str(tmp_path), status_s=0.1)) as recorder:
        gateway.put(gateway.keys(keyspace.LOG, "g1"), b"\xff{not json")
        gateway.put(gateway.keys(keyspace.STATUS, "g1"), b"", encoding="text/plain")
        await _until(lambda: recorder.stats.messages >= 3)
    (path,) = tmp_path.glob("*.mcap")
    found = {message.key: message.payload for message in read(path)}
    assert found[gateway.keys(keyspace.LOG, "g1")] == b"\xff{not json"
    assert found[gateway.keys(keyspace.STATUS, "g1")] == b""


async def test_killed_recorder_loses_at_most_a_second(gateway: Session, tmp_path: Path, project_root: Path) -> None:
    """After SIGKILL at 500 messages/s all but the last second can be read, in order, and made a proper file.

    A second of the recorder's own: what it had by its account of itself a second before its last one.
    """
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        "-c",
        PROCESS,
        gateway.config.listen[0],
        str(tmp_path),
        env=os.environ | {"PYTHONPATH": str(project_root)},
    )
    sent = 0
    accounts: list[RecorderStatus] = []

    def take(_: str, status: RecorderStatus | None) -> None:
        # None is a status that was deleted.
        if status is not None:
            accounts.append(status)

    def a_second_ago() -> int:
        """How many messages it had by then."""
        return max((each.messages for each in accounts if accounts[-1].at_ns - each.at_ns >= 10**9), default=0)

    try:
        gateway.subscribe_typed(keyspace.RECORDER_STATUS, take)
        await _until(lambda: accounts)
        started = time.monotonic()
        while a_second_ago() < 500:
            while sent < (time.monotonic() - started) * 500:
                gateway.put(gateway.keys(keyspace.TRANSITION, "t1"), encode({"n": sent}))
                sent += 1
            await asyncio.sleep(0.01)
    finally:
        process.send_signal(signal.SIGKILL)
        await process.wait()
    (path,) = tmp_path.glob("*.mcap")
    told = info(path)
    assert told.recovered
    numbers = [
        msgspec.json.decode(message.payload)["n"] for message in read(path, keys=gateway.keys(keyspace.TRANSITION))
    ]
    assert numbers == list(range(numbers[0], numbers[-1] + 1))
    assert told.messages >= a_second_ago()
    assert numbers[0] <= 5  # those put before its subscription had reached us
    assert recover(path, tmp_path / "whole.mcap").messages == told.messages
    with (tmp_path / "whole.mcap").open("rb") as stream:
        again = [
            message
            for _, channel, message in make_reader(stream).iter_messages(gateway.keys(keyspace.TRANSITION, "t1"))
        ]
    assert len(again) == len(numbers)


def _numbers_in(folder: Path, keys: str) -> list[int]:
    """The numbers in all files of a folder, in the order of the files and as they stand there."""
    files = sorted(folder.glob("*.mcap"))
    found = (message for path in files for message in read(path, keys=keys, problems=[]))
    return [msgspec.json.decode(message.payload)["n"] for message in found]


@contextlib.asynccontextmanager
async def _recorder_process(
    gateway: Session, folder: Path, project_root: Path
) -> AsyncIterator[tuple[asyncio.subprocess.Process, list[RecorderStatus]]]:
    """Run a recorder in a process of its own, heard of before the body runs; killed if it still runs afterwards."""
    heard: list[RecorderStatus] = []
    closer = gateway.subscribe_typed(
        keyspace.RECORDER_STATUS, lambda _, status: heard.append(status) if status else None
    )
    environment = os.environ | {"PYTHONPATH": str(project_root)}
    arguments = ("-c", PROCESS, gateway.config.listen[0], str(folder))
    process = await asyncio.create_subprocess_exec(sys.executable, *arguments, env=environment)
    try:
        await _until(lambda: heard and heard[-1].messages)
        yield process, heard
    finally:
        closer.close()
        if process.returncode is None:
            process.send_signal(signal.SIGKILL)
            await process.wait()


async def _stand_still(gateway: Session, process: asyncio.subprocess.Process, put: Callable[[], None]) -> None:
    """Stop the recorder until the gateway has let go of its link, put meanwhile, and let it go on."""
    process.send_signal(signal.SIGSTOP)
    try:
        while gateway.linked:
            put()
            await asyncio.sleep(0.01)
        put()
    finally:
        process.send_signal(signal.SIGCONT)


@pytest.mark.parametrize("kept", [True, False])
async def test_what_is_put_while_the_recorder_stands_still(
    free_port: int, tmp_path: Path, project_root: Path, kept: bool
) -> None:
    """A recorder that stood still for longer than a lease fetches what it lacks, or says how much of which keys.

    It is in its place in the log: between what was before and what came after, each message once.
    """
    settings = PlaneConfig(listen=(f"tcp/127.0.0.1:{free_port}",), backlog_bytes=PlaneConfig().backlog_bytes * kept)
    gateway = await Session.open(settings, "f1")
    count = 0

    def put() -> None:
        nonlocal count
        gateway.put(gateway.keys(keyspace.TRANSITION, "t1"), encode({"n": count}))
        count += 1

    try:
        async with _recorder_process(gateway, tmp_path, project_root) as (process, heard):
            await _stand_still(gateway, process, put)
            await _until(lambda: gateway.linked)
            await _until(lambda: (put(), heard[-1].fetched or heard[-1].missed)[1])
            last = heard[-1]
            recorded = last.messages
            await _until(lambda: heard[-1].messages > recorded)
            process.send_signal(signal.SIGTERM)
            await process.wait()
    finally:
        await gateway.close()
    numbers = _numbers_in(tmp_path, gateway.keys(keyspace.TRANSITION))
    assert numbers == sorted(set(numbers))
    missing = numbers[-1] + 1 - len(numbers)
    if kept:
        assert (missing, last.missed) == (0, {})
    else:
        assert missing > 0
        assert set(last.missed) == {"task/*/transition"}
        assert last.missed["task/*/transition"] == missing
        (path,) = tmp_path.glob("*.mcap")
        assert info(path).missed == last.missed


async def test_what_is_put_while_the_recorder_is_restarted(
    gateway: Session, tmp_path: Path, project_root: Path
) -> None:
    """A recorder that is killed and started again has what was put between, each message once."""
    count = 0

    def put() -> None:
        nonlocal count
        gateway.put(gateway.keys(keyspace.TRANSITION, "t1"), encode({"n": count}))
        count += 1

    async with _recorder_process(gateway, tmp_path, project_root) as (process, heard):
        for _ in range(50):
            put()
        before = heard[-1].messages
        await _until(lambda: heard[-1].messages >= before + 50)
        process.send_signal(signal.SIGKILL)
        await process.wait()
    for _ in range(200):
        put()
        await asyncio.sleep(0.001)
    async with _recorder_process(gateway, tmp_path, project_root) as (process, heard):
        await _until(lambda: (put(), heard[-1].fetched)[1])
        process.send_signal(signal.SIGTERM)
        await process.wait()
    numbers = _numbers_in(tmp_path, gateway.keys(keyspace.TRANSITION))
    assert numbers == list(range(numbers[-1] + 1))
    assert len(numbers) > 250


async def test_file_size_limit_of_the_system(gateway: Session, tmp_path: Path) -> None:
    """When the system itself refuses to let the file grow, it is ended whole, and a new one tells of the gap."""
    # SIGXFSZ would kill the process: the recorder's process ignores it, as Python does by default.
    assert signal.getsignal(signal.SIGXFSZ) == signal.SIG_IGN
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    config = RecordConfig(directory=str(tmp_path), chunk_bytes=2000, compression="none", free_bytes=0, status_s=5.0)
    async with _recording(gateway, config) as recorder:
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))
        try:
            for number in range(300):
                gateway.put(gateway.keys(keyspace.TRANSITION, "t1"), encode({"n": number, "x": "y" * 100}))
            await _until(lambda: recorder.stats.problem)
            assert "the disk is full" in recorder.stats.problem
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        await _until(lambda: recorder.stats.state == "recording" and recorder.stats.files >= 2)
        gateway.put(gateway.keys(keyspace.TRANSITION, "t1"), encode({"n": 300}))
        expected = recorder.stats.messages + 1
        await _until(lambda: recorder.stats.messages >= expected)
    files = sorted(tmp_path.glob("*.mcap"))
    messages: list[LoggedMessage] = [message for path in files for message in read(path)]
    numbers = [
        msgspec.json.decode(message.payload)["n"]
        for message in messages
        if message.key == gateway.keys(keyspace.TRANSITION, "t1")
    ]
    assert numbers == sorted(set(numbers))
    assert numbers[-1] == 300
    dropped = sum(info(path).dropped for path in files)
    # What the recorder says of itself meanwhile may be among what was dropped.
    assert 301 <= len(numbers) + dropped <= 305


async def test_folder_that_cannot_be_written_is_told(gateway: Session, tmp_path: Path) -> None:
    """The recorder's process ends with the cause and the remedy when its folder cannot be made."""
    (tmp_path / "file").write_text("")
    config = RecordConfig(directory=str(tmp_path / "file" / "log"))
    with pytest.raises(RecordError, match=r"set record\.directory"):
        await run_recorder(config, _client(gateway), "f1", asyncio.Event())


class BrokenWriter(LogWriter):
    """A writer with a defect."""

    def write(self, message: LoggedMessage) -> bool:
        """Fail as no disk does."""
        raise ZeroDivisionError(message.key)


async def test_defect_of_the_writer_is_told(gateway: Session, tmp_path: Path) -> None:
    """A writer thread that fails says so in the status instead of recording nothing in silence."""
    heard: list[RecorderStatus] = []
    gateway.subscribe_typed(keyspace.RECORDER_STATUS, lambda _, status: heard.append(status) if status else None)
    session = await Session.open(_client(gateway), "f1")
    config = RecordConfig(directory=str(tmp_path), status_s=0.1)
    recorder = Recorder(session, config, writer=BrokenWriter(config, fleet="f1"))
    await recorder.start()
    await _until(lambda: any(status.state == "failed" for status in heard))
    assert "ZeroDivisionError" in recorder.failed
    await recorder.stop()
    await session.close()


async def test_stop_ends_the_process_with_a_finished_file(gateway: Session, tmp_path: Path) -> None:
    """Setting `stop` ends `run_recorder`, and what it leaves is a finished file."""
    stop = asyncio.Event()
    heard = asyncio.Event()
    alive: list[RecorderStatus] = []
    gateway.subscribe(gateway.keys(keyspace.RECORDER_STATUS), lambda _: heard.set())
    config = RecordConfig(directory=str(tmp_path), status_s=0.1)
    running: Awaitable[None] = asyncio.create_task(
        run_recorder(config, _client(gateway), "f1", stop, alive=alive.append)
    )
    await asyncio.wait_for(heard.wait(), 60)
    await _until(lambda: len(alive) >= 2)
    stop.set()
    await running
    (path,) = tmp_path.glob("*.mcap")
    assert not info(path).recovered
