"""From a put in one process to a file of another: how many messages a second, what is lost, what a kill leaves."""

import asyncio
import contextlib
import random
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import AsyncGenerator, Callable
from pathlib import Path
from typing import Any

import msgspec
from mcap.writer import Writer

from appliance.errors import DeadlineError, SwiftbotError
from appliance.model import Pose, RobotInfo, encode, keyspace
from appliance.model.keys import Keys
from appliance.ports import free_port
from appliance.record.edit import recover
from appliance.record.models import LoggedMessage
from appliance.record.reader import info, read
from appliance.record.segments import LogWriter
from appliance.record.settings import RecordConfig
from workshop.bench.recording.processes import FLEET, Job

_KEYS = 50
_TICK_EVERY = 64
"""Messages between two ticks: about what the writer thread takes at once under load."""


async def written(*, messages: int = 50_000, rounds: int = 3, directory: str = "") -> dict[str, Any]:
    """Measure messages/s of writing and reading.

    Args:
        messages: Messages a round.
        rounds: Rounds of each writer; the median counts.
        directory: Where to write; a temporary folder when empty.

    Returns:
        Messages/s of `recorder` (with fsync), `recorder_no_fsync`, `mcap` (bare library) and `reader`, bytes a
        message, and the recorder's share of the library's rate.
    """
    return await asyncio.to_thread(_run, messages, rounds, directory)


def _run(messages: int, rounds: int, directory: str) -> dict[str, Any]:
    rates: dict[str, list[float]] = {"mcap": [], "recorder_no_fsync": [], "recorder": [], "reader": []}
    size = 0
    load = _load(messages)
    with tempfile.TemporaryDirectory(dir=directory or None, prefix="swiftbot-bench-") as folder:
        for number in range(rounds):
            bare = Path(folder) / f"bare-{number}.mcap"
            rates["mcap"].append(messages / _timed(lambda path=bare: _write_bare(path, load)))
            for name, fsync in (("recorder_no_fsync", False), ("recorder", True)):
                config = RecordConfig(directory=f"{folder}/{name}-{number}", free_bytes=0, fsync=fsync)
                writer = LogWriter(config, fleet="bench")
                writer.prepare()
                rates[name].append(messages / _timed(lambda writer=writer: _write(writer, load)))
                size = info(writer.files[0]).size_bytes
            last = writer.files[0]
            rates["reader"].append(messages / _timed(lambda path=last: sum(1 for _ in read(path))))
    medians = {name: round(statistics.median(found)) for name, found in rates.items()}
    return {
        "messages": messages,
        "rounds": rounds,
        "payload_bytes": len(load[0].payload),
        "file_bytes_per_message": round(size / messages, 1),
        "messages_per_s": medians,
        "recorder_to_mcap": round(medians["recorder"] / medians["mcap"], 3),
    }


def _load(count: int) -> list[LoggedMessage]:
    """Make robot states as a fleet of 50 robots puts them."""
    keys = Keys("bench")
    made: list[LoggedMessage] = []
    for number in range(count):
        robot = f"r{number % _KEYS}"
        pose = Pose(x=number * 0.013, y=-number * 0.007, heading_deg=float(number % 360))
        state = RobotInfo(id=robot, kind="zenoh", pose=pose, battery_percent=80.0)
        made.append(
            LoggedMessage(keys(keyspace.ROBOT, robot), 10**18 + number * 10**6, encode(state), "application/json")
        )
    return made


def _timed(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def _write(writer: LogWriter, load: list[LoggedMessage]) -> None:
    for number, message in enumerate(load):
        writer.write(message)
        if number % _TICK_EVERY == 0:
            writer.tick()
    writer.close()


def _write_bare(path: Path, load: list[LoggedMessage]) -> None:
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=64 * 1024)
        writer.start()
        channels: dict[str, int] = {}
        for message in load:
            channel = channels.get(message.key)
            if channel is None:
                channel = channels[message.key] = writer.register_channel(message.key, "json", 0)
            writer.add_message(channel, message.at_ns, message.payload, message.at_ns)
        writer.finish()


READY_S = 60.0
STILL_S = 10.0
"""A recorder that writes nothing more for so long has all that it will have."""
OWN = 500
"""Fewer in that time are the recorder's own: it records what it says of itself."""
LAST_S = 1.0
"""What a kill may take."""


class _Process:
    """One of the processes of `processes`."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self.process = process
        self.last: dict[str, Any] = {}

    async def hear(self, timeout_s: float = READY_S) -> dict[str, Any]:
        """Return what it says next."""
        assert self.process.stdout is not None  # noqa: S101 - it was started with a pipe
        line = b""
        try:
            async with asyncio.timeout(timeout_s):
                while not line.startswith(b"{"):  # what it logs is for people
                    line = await self.process.stdout.readline()
                    if not line:
                        raise SwiftbotError("a process of the measurement has ended early")
        except TimeoutError:
            raise DeadlineError("a process of the measurement says nothing", remedy="look at what it wrote") from None
        self.last = msgspec.json.decode(line, type=dict[str, Any])
        return self.last

    def go(self) -> None:
        """Let it begin, or end."""
        assert self.process.stdin is not None  # noqa: S101 - it was started with a pipe
        self.process.stdin.write(b"\n")


@contextlib.asynccontextmanager
async def _process(role: str, job: Job) -> AsyncGenerator[_Process]:
    command = (sys.executable, "-m", "workshop.bench.recording.processes", role, msgspec.json.encode(job).decode())
    pipe = asyncio.subprocess.PIPE
    process = await asyncio.create_subprocess_exec(*command, stdin=pipe, stdout=pipe)
    try:
        yield _Process(process)
    finally:
        if process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                process.terminate()
            try:
                async with asyncio.timeout(20.0):
                    await process.communicate()
            except TimeoutError:
                process.kill()
                await process.wait()


async def run(
    *, messages: int = 50_000, rounds: int = 3, flow: int = 300_000, kills: int = 0, seed: int = 1
) -> dict[str, Any]:
    """Measure the writer alone, then from put to file beside the bare alternative, then kills.

    Args:
        messages: messages a round of the writer alone; 0: leave it out.
        rounds: rounds of each; the median counts.
        flow: messages a round from put to file; 0: leave it out.
        kills: times that the recorder is killed while it records.
        seed: of the moments of the kills.

    Returns:
        `writer` (see `written`); `flow` with messages/s of `recorder` and `bare`, and what was lost; `kills` with
        what was left each time.
    """
    result: dict[str, Any] = {}
    if messages:
        result["writer"] = await written(messages=messages, rounds=rounds)
    if flow:
        result["flow"] = await _flows(flow, rounds)
    if kills:
        result["kills"] = await _kills(kills, random.Random(seed))  # noqa: S311 - a measurement that can be repeated
    return result


# --- from put to file ------------------------------------------------------------------------------------------


async def _flows(messages: int, rounds: int) -> dict[str, Any]:
    rates: dict[str, list[float]] = {"recorder": [], "bare": []}
    found: dict[str, list[dict[str, Any]]] = {"recorder": [], "bare": []}
    for _ in range(rounds):
        for role in ("record", "bare"):
            one = await _flow(role, messages)
            name = "recorder" if role == "record" else "bare"
            rates[name].append(one["per_s"])
            found[name].append(one)
    medians = {name: round(statistics.median(some)) for name, some in rates.items()}
    return {
        "messages": messages,
        "payload_bytes": Job(endpoint="").payload_bytes,
        "messages_per_s": medians,
        "recorder_to_bare": round(medians["recorder"] / max(1, medians["bare"]), 3),
        "rounds": found,
        "unaccounted": sum(each["unaccounted"] for each in found["recorder"]),
    }


async def _flow(role: str, messages: int) -> dict[str, Any]:
    folder = tempfile.mkdtemp(prefix="swiftbot-bench-")
    job = Job(endpoint=f"tcp/127.0.0.1:{free_port()}", folder=folder, messages=messages)
    try:
        async with _process("send", job) as sender:
            await sender.hear()
            async with _process(role, job) as recorder:
                before = (await recorder.hear()).get("messages", 0)
                await asyncio.sleep(1.0)  # until its subscription has reached the sender
                sender.go()
                sent = await sender.hear(600.0)
                ended_ns, done = await _until_written(recorder, before + messages)
                sender.go()
        per_s = messages / ((ended_ns - sent["began_ns"]) / 1e9)
        counted = await asyncio.to_thread(_counted, folder, messages)
        return {
            "per_s": round(per_s),
            "put_per_s": round(messages / ((sent["ended_ns"] - sent["began_ns"]) / 1e9)),
            "written": done - before,
            **counted,
        }
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _counted(folder: str, messages: int) -> dict[str, int]:
    """Return which of the messages are in the files of a folder, and what these say was dropped."""
    files = sorted(Path(folder).glob("*.mcap"))
    numbers = [0] * messages
    for path in files:
        for message in read(path, keys=f"swiftbot/{FLEET}/flow/*"):
            numbers[msgspec.json.decode(message.payload)["n"]] += 1
    told = sum(info(path).dropped for path in files)
    missing = numbers.count(0)
    return {
        "missing": missing,
        "told_as_dropped": told,
        "unaccounted": missing - told,
        "doubled": sum(each > 1 for each in numbers),
    }


async def _until_written(recorder: _Process, messages: int) -> tuple[int, int]:
    """Return when so many were written, or no more were, and how many."""
    last, at_ns, mark, since = 0, 0, 0, time.monotonic()
    while last < messages and time.monotonic() - since < STILL_S:
        told = await recorder.hear()
        if told["messages"] > last:
            last, at_ns = told["messages"], told["at_ns"]
        if last > mark + OWN:
            mark, since = last, time.monotonic()
    return at_ns, last


# --- kills -----------------------------------------------------------------------------------------------------


async def _kills(kills: int, chance: random.Random) -> dict[str, Any]:
    rounds = [await kill(chance.uniform(0.8, 2.5)) for _ in range(kills)]
    lost = [each["lost_s"] for each in rounds]
    return {
        "kills": kills,
        "lost_s": {"median": round(statistics.median(lost), 3), "most": round(max(lost), 3)},
        "beyond_last_second": sum(each["lost_s"] > LAST_S for each in rounds),
        "damaged": sum(bool(each["problems"]) for each in rounds),
        "holes": sum(each["holes"] for each in rounds),
        "rounds": rounds,
    }


async def kill(after_s: float, *, per_s: float = 2000.0) -> dict[str, Any]:
    """Kill a recorder with SIGKILL so long after it began to hear, recover its file, and say what is in it.

    Returns:
        `lost_s`: age, at the kill, of the oldest message that is not in the file; `holes`: messages missing before the
        last one that is there; `problems`: what is damaged in the recovered file.
    """
    folder = tempfile.mkdtemp(prefix="swiftbot-bench-")
    job = Job(
        endpoint=f"tcp/127.0.0.1:{free_port()}", folder=folder, messages=round(per_s * (after_s + 60)), per_s=per_s
    )
    try:
        async with _process("send", job) as sender, _process("record", job) as recorder:
            await sender.hear()
            await recorder.hear()
            await asyncio.sleep(0.5)
            sender.go()
            sent: list[tuple[int, int]] = []

            async def listen() -> None:
                while True:
                    told = await sender.hear()
                    sent.append((told["sent"], told["at_ns"]))

            listening = asyncio.create_task(listen())
            await asyncio.sleep(after_s)
            recorder.process.kill()
            killed_ns = time.monotonic_ns()
            await recorder.process.wait()
            listening.cancel()
            await asyncio.gather(listening, return_exceptions=True)
            sender.process.kill()
        numbers, problems = await asyncio.to_thread(_recovered, folder)
        last = numbers[-1] if numbers else -1
        # The sender says how many it has sent, and when: the first of these that is not there tells the loss.
        missing_ns = next((at_ns for number, at_ns in sent if number > last + 1), killed_ns)
        return {
            "after_s": round(after_s, 3),
            "messages": len(numbers),
            "lost_s": round(max(0.0, (killed_ns - missing_ns) / 1e9), 3),
            "holes": last + 1 - len(numbers) if numbers else 0,
            "problems": problems,
        }
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _recovered(folder: str) -> tuple[list[int], list[str]]:
    """Recover the one file of a folder; return the numbers of its messages, and what is damaged in it."""
    (path,) = Path(folder).glob("*.mcap")
    whole = Path(folder, "whole.mcap")
    problems = list(recover(path, whole).problems)
    found = read(whole, keys=f"swiftbot/{FLEET}/flow/*", problems=problems)
    return [msgspec.json.decode(message.payload)["n"] for message in found], problems
