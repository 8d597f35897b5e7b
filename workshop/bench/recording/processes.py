"""The processes of these measurements: a sender, a recorder, and the bare alternative to it.

Run as `python -m workshop.bench.recording.processes ROLE JSON`. Each prints JSON lines: `{"ready": true}` when it can
begin, and what it has seen.
"""
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false, reportUnknownVariableType=false

import asyncio
import signal
import sys
import threading
import time
from pathlib import Path
from typing import Any

import msgspec
import zenoh
from mcap.writer import Writer

from appliance.plane import link
from appliance.plane.settings import PlaneConfig
from appliance.record.recorder import run_recorder
from appliance.record.settings import RecordConfig

KEYS = 50
FLEET = "bench"


class Job(msgspec.Struct, kw_only=True):
    """What a process shall do."""

    endpoint: str
    folder: str = ""
    messages: int = 0
    payload_bytes: int = 200
    per_s: float = 0.0
    """Messages a second of the sender; 0: as fast as they are taken."""


def say(**told: Any) -> None:
    """Print a line for the parent process."""
    sys.stdout.write(msgspec.json.encode(told).decode() + "\n")
    sys.stdout.flush()


def payload(number: int, size: int) -> bytes:
    """Return a JSON message of that many bytes that holds its number."""
    head = b'{"n":%d,"x":"' % number
    return head + b"x" * max(0, size - len(head) - 2) + b'"}'


def send(job: Job) -> None:
    """Put messages with Zenoh alone, without waiting for anybody but Zenoh, and say when the first and last was."""
    with link.open_raw(PlaneConfig(mode="peer", listen=(job.endpoint,))) as session:
        publishers = [
            session.declare_publisher(
                f"swiftbot/{FLEET}/flow/k{number}",
                congestion_control=zenoh.CongestionControl.BLOCK,
                encoding=zenoh.Encoding.APPLICATION_JSON,
            )
            for number in range(KEYS)
        ]
        say(ready=True)
        sys.stdin.readline()
        began = time.monotonic_ns()
        for number in range(job.messages):
            if job.per_s and (ahead_s := number / job.per_s - (time.monotonic_ns() - began) / 1e9) > 0.002:
                say(sent=number, at_ns=time.monotonic_ns())
                time.sleep(ahead_s)
            publishers[number % KEYS].put(payload(number, job.payload_bytes))
        say(began_ns=began, ended_ns=time.monotonic_ns(), messages=job.messages)
        sys.stdin.readline()


def record(job: Job) -> None:
    """Record with the product's recorder until it is asked to end."""
    config = RecordConfig(directory=job.folder, free_bytes=0, total_bytes=0, status_s=0.1)

    async def go() -> None:
        stop = asyncio.Event()
        asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, stop.set)

        def told(status: Any) -> None:
            say(ready=True, messages=status.messages, dropped=status.dropped, at_ns=time.monotonic_ns())

        plane = PlaneConfig(mode="client", connect=(job.endpoint,))
        await run_recorder(config, plane, FLEET, stop, alive=told)

    asyncio.run(go())


def bare(job: Job) -> None:
    """Write what a subscription brings with the mcap library, as its documentation shows: no flush, no account."""
    done = threading.Event()

    def end(_number: int, _frame: object) -> None:
        done.set()

    signal.signal(signal.SIGTERM, end)
    count = 0
    with Path(job.folder, "bare.mcap").open("wb") as file:
        writer = Writer(file, chunk_size=64 * 1024)
        writer.start()
        channels: dict[str, int] = {}

        def take(sample: zenoh.Sample) -> None:
            nonlocal count
            key, stamp = str(sample.key_expr), sample.timestamp
            at_ns = stamp.get_time_as_ntp64().as_nanos() if stamp else time.time_ns()
            channel = channels.get(key)
            if channel is None:
                channel = channels[key] = writer.register_channel(key, "json", 0)
            writer.add_message(channel, at_ns, sample.payload.to_bytes(), at_ns)
            count += 1

        with link.open_raw(PlaneConfig(mode="client", connect=(job.endpoint,))) as session:
            session.declare_subscriber(f"swiftbot/{FLEET}/**", zenoh.handlers.Callback(take, indirect=False))
            while not done.wait(0.1):
                say(ready=True, messages=count, at_ns=time.monotonic_ns())
        writer.finish()


def main() -> None:
    """Do what the command line says."""
    role, text = sys.argv[1:]
    job = msgspec.json.decode(text, type=Job)
    {"send": send, "record": record, "bare": bare}[role](job)


if __name__ == "__main__":
    main()
