"""How much the recorder can write, beside the bare MCAP library in the same run.

The difference is what channels, schemas, gap accounting and flushing cost a message; both write the same
messages with the same chunk size and compression to the same folder, in alternating rounds.
"""

import asyncio
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mcap.writer import Writer

from appliance.model import Pose, RobotInfo, encode
from appliance.plane.keys import Keys
from appliance.record.models import LoggedMessage
from appliance.record.reader import info, read
from appliance.record.segments import LogWriter
from appliance.record.settings import RecordConfig

_KEYS = 50
_TICK_EVERY = 64
"""Messages between two ticks: about what the writer thread takes at once under load."""


async def run(*, messages: int = 50_000, rounds: int = 3, directory: str = "") -> dict[str, Any]:
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
        made.append(LoggedMessage(keys.robot(robot), 10**18 + number * 10**6, encode(state), "application/json"))
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
