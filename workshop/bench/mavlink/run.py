"""A real vehicle's log through the gateway's router, at real time and full speed, beside other routers in the same run.

Vehicle and ground station are two TCP connections, so that nothing but the router can lose a frame: every good frame
has to come out at the other side, byte for byte and in order, and stand in the recorder's file; damaged ones count.
"""

import asyncio
import contextlib
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import AsyncGenerator, Callable, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import msgspec
import psutil
from msgspec import Struct

from appliance.errors import PrerequisiteError
from appliance.model.keys import Keys
from appliance.model.robot_api import MavlinkLink
from appliance.ports import free_port
from appliance.record.reader import read
from appliance.robots.mavlink.dialect import Codec, Frame, check, make
from appliance.robots.settings import RobotsConfig
from workshop.bench.figures import ratio
from workshop.bench.mavlink import others, tlog
from workshop.bench.mavlink.host import FLEET, Host, Told
from workshop.bench.mavlink.player import Play, Played, save

Progress = Callable[[str], None]
OWN = RobotsConfig().system_id
"""The gateway, whose own frames are left out of the comparison."""
_PYTHON = sys.executable
_READY_S = 60.0
_LIMIT_S = 900.0
_RECORDER = """
import asyncio, signal, sys
import uvloop
from appliance.plane.settings import PlaneConfig
from appliance.record.recorder import run_recorder
from appliance.record.settings import RecordConfig
async def main():
    stop = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, stop.set)
    config = RecordConfig(directory=sys.argv[2], free_bytes=0, status_s=0.2)
    await run_recorder(config, PlaneConfig(mode="client", connect=(sys.argv[1],)), sys.argv[3], stop)
uvloop.run(main())
"""


class Options(Struct, frozen=True, kw_only=True):
    """What is measured."""

    log: str = ""
    """A .tlog; empty: generated frames."""
    frames: int = 30_000
    """How many are generated."""
    rounds: int = 3
    """How often the log is played at full speed in one measurement."""
    real_s: float = 20.0
    """Seconds of the log that are played at real time; 0: all of it."""
    record: bool = True
    profile: bool = True
    beside: str = others.AUTO
    """Routers of others that are measured too; see `others.find`."""


async def run(options: Options, *, progress: Progress) -> dict[str, Any]:
    """Measure; see the module."""
    found, missing = others.find(options.beside)
    records = tlog.read(Path(options.log)) if options.log else tlog.generate(options.frames)
    result: dict[str, Any] = {
        "log": Path(options.log).name or "generated",
        "frames": len(records),
        "damaged": sum(each.frame is None for each in records),
        "seconds": round(records[-1].at_s, 1),
        "commands": _commands(records),
    }
    with tempfile.TemporaryDirectory(prefix="swiftbot-bench-") as folder:
        bench = _Bench(Path(folder), progress)
        limit_s = options.real_s or records[-1].at_s
        part = [each for each in records if each.at_s <= limit_s]
        progress(f"{limit_s:g} s of the log at real time, recorded")
        result["real_time"] = await bench.gateway(part, speed=1.0, rounds=1, record=True)
        progress(f"{options.rounds} times the log at full speed")
        result["full_speed"] = await bench.gateway(records, speed=0.0, rounds=options.rounds, record=False)
        if options.record:
            progress("the same, recorded")
            result["full_speed_recorded"] = await bench.gateway(records, speed=0.0, rounds=options.rounds, record=True)
        result["beside"] = {
            name: {"missing": f"{name} is not installed", "remedy": how} for name, how in missing.items()
        }
        for each in found:
            progress(f"the same through {each.other.name}")
            its = await bench.other(each, records, rounds=options.rounds)
            its["ours_to_its"] = ratio(result["full_speed"]["frames_per_s"], its["frames_per_s"])
            result["beside"][each.other.name] = its
        if options.profile:
            progress("the same under the profiler")
            profiled = await bench.gateway(records, speed=0.0, rounds=1, record=False, profile=True)
            result["profile"] = profiled["profile"]
    return result


def _commands(records: Sequence[tlog.Record]) -> dict[str, int]:
    """Pair commands with acknowledgements: each answer belongs to the oldest unanswered command of its number."""
    waiting: dict[int, int] = {}
    paired = asked = 0
    for each in records:
        frame = each.frame
        if frame is None:
            continue
        if frame.name in ("COMMAND_LONG", "COMMAND_INT"):
            asked += 1
            waiting[frame.message.command] = waiting.get(frame.message.command, 0) + 1
        elif frame.name == "COMMAND_ACK" and waiting.get(frame.message.command, 0):
            waiting[frame.message.command] -= 1
            paired += 1
    return {"sent": asked, "acknowledged": paired}


class _Bench:
    """Measurements in one folder."""

    def __init__(self, folder: Path, progress: Progress) -> None:
        self._folder = folder
        self._progress = progress
        self._number = 0

    async def gateway(
        self, records: Sequence[tlog.Record], *, speed: float, rounds: int, record: bool, profile: bool = False
    ) -> dict[str, Any]:
        """Play through the gateway's robots, in a process of their own."""
        self._number += 1
        vehicle, ground, zenoh = free_port(), free_port(), free_port()
        folder = self._folder / f"run-{self._number}"
        folder.mkdir()
        links = tuple(MavlinkLink(listen=f"tcp://127.0.0.1:{port}", prefix="drone_") for port in (vehicle, ground))
        host = Host(
            listen=f"tcp/127.0.0.1:{zenoh}",
            store=str(folder / "store.sqlite"),
            # At full speed a second is some ten milliseconds, and so is the time within which frames are repetitions.
            robots=RobotsConfig(mavlink=links, sender_hz=0.0, message_hz=0.0, repeat_s=0.5 if speed else 0.005),
            profile=profile,
        )
        order = folder / "host.json"
        order.write_bytes(msgspec.json.encode(host))
        async with contextlib.AsyncExitStack() as stack:
            process = await stack.enter_async_context(_process("-m", "workshop.bench.mavlink.host", str(order)))
            assert process.stdout is not None  # noqa: S101 - it is a pipe
            async with asyncio.timeout(_READY_S):
                await process.stdout.readline()
            log, recorder = folder / "log", None
            if record:
                recorder = await stack.enter_async_context(_process("-c", _RECORDER, host.listen, str(log), FLEET))
                await asyncio.to_thread(_until_recording, log)
            busy = psutil.Process(process.pid)
            before = busy.cpu_times()
            played = await self._play(folder, records, (vehicle, ground), speed=speed, rounds=rounds)
            after = busy.cpu_times()
            process.send_signal(signal.SIGTERM)
            async with asyncio.timeout(_READY_S):
                told = msgspec.json.decode((await process.stdout.read()).splitlines()[-1], type=Told)
                await process.wait()
            if recorder is not None:
                recorder.send_signal(signal.SIGTERM)
                async with asyncio.timeout(_READY_S):
                    await recorder.wait()
        found = self._compare(folder, records, played, rounds=rounds)
        used_s = after.user + after.system - before.user - before.system
        found["cpu_us_per_frame"] = round(1e6 * used_s / max(1, found["frames"]), 1)
        found["refused"] = told.refused
        if record:
            found["recorded"] = await asyncio.to_thread(_recorded, log, records, rounds)
        if profile:
            found["profile"] = list(told.profile)
        return found

    async def other(self, found: others.Found, records: Sequence[tlog.Record], *, rounds: int) -> dict[str, Any]:
        """Play through another router."""
        vehicle, ground = free_port(), free_port()
        folder = self._folder / found.other.name
        folder.mkdir()
        arguments = found.other.arguments(folder, (vehicle, ground))
        async with _process(*arguments, program=found.path) as process:
            busy = psutil.Process(process.pid)
            played = await self._play(folder, records, (vehicle, ground), speed=0.0, rounds=rounds)
            used = busy.cpu_times()
        told = self._compare(folder, records, played, rounds=rounds)
        told["cpu_us_per_frame"] = round(1e6 * (used.user + used.system) / max(1, told["frames"]), 1)
        return told

    async def _play(
        self, folder: Path, records: Sequence[tlog.Record], ports: tuple[int, int], *, speed: float, rounds: int
    ) -> Played:
        sides = [[each for each in records if tlog.is_ground(each) is ground] for ground in (False, True)]
        wanted = [rounds * sum(map(len, tlog.crossing(records, ground=ground))) for ground in (True, False)]
        for name, side in zip("ab", sides, strict=True):
            save(folder / name, [(each.at_s, each.raw) for each in side])
        play = Play(
            ports=ports,
            records=(str(folder / "a"), str(folder / "b")),
            greetings=(_greeting(sides[0]), _greeting(sides[1])),
            outputs=(str(folder / "a.out"), str(folder / "b.out")),
            speed=speed,
            rounds=rounds,
            wanted=(wanted[0], wanted[1]),
        )
        order = folder / "play.json"
        order.write_bytes(msgspec.json.encode(play))
        async with _process("-m", "workshop.bench.mavlink.player", str(order)) as player:
            assert player.stdout is not None  # noqa: S101 - it is a pipe
            async with asyncio.timeout(_LIMIT_S):
                return msgspec.json.decode(await player.stdout.read(), type=Played)

    def _compare(self, folder: Path, records: Sequence[tlog.Record], played: Played, *, rounds: int) -> dict[str, Any]:
        """Say what came out: frames in order and byte for byte, per side, without the gateway's own."""
        wanted = arrived = repeated = 0
        wrong = Counter[str]()
        for name, ground in (("b", False), ("a", True)):
            expected = tlog.crossing(records, ground=ground) * rounds
            heard = _frames((folder / f"{name}.out").read_bytes())
            again, differences = _differences(expected, heard)
            wanted += len(expected)
            arrived += len(heard)
            repeated += again
            wrong.update(differences)
        frames = sum(each.frame is not None for each in records) * rounds
        return {
            "frames": frames,
            "to_be_delivered": wanted,
            "delivered": arrived,
            "repetitions_left_out": repeated,
            "byte_for_byte": not wrong,
            **({"wrong": dict(wrong)} if wrong else {}),
            "seconds": round(played.received_s, 2),
            "frames_per_s": round(frames / max(1e-3, played.received_s)),
        }


def _differences(expected: Sequence[bytes], heard: Sequence[bytes]) -> tuple[int, Counter[str]]:
    """Compare in order: how many were left out that had been there before, and the others by sender and message.

    At full speed what a sender said again after seconds comes within milliseconds, and is taken for a repetition.
    """
    again, wrong, seen, at = 0, Counter[str](), set[bytes](), 0
    for raw in expected:
        if at < len(heard) and heard[at] == raw:
            at += 1
        elif raw in seen:
            again += 1
        else:
            wrong[f"missing {_name(raw)}"] += 1
        seen.add(raw)
    for raw in heard[at:]:
        wrong[f"not expected {_name(raw)}"] += 1
    return again, wrong


def _name(raw: bytes) -> str:
    found = check(raw)
    return f"{found.system}/{found.component} {found.name}" if isinstance(found, Frame) else found.kind


def _until_recording(log: Path) -> None:
    """Wait until a recorder has heard something: what is put from then on is in its file."""
    until = time.monotonic() + _READY_S
    while not any(path.stat().st_size > 4096 for path in log.glob("*.mcap*")):
        if time.monotonic() > until:
            raise PrerequisiteError("the recorder does not begin", remedy="look at its messages above")
        time.sleep(0.05)


def _greeting(side: Sequence[tlog.Record]) -> bytes:
    """Return a heartbeat by which a router knows the end: one of the side's own with another sequence number."""
    codec = Codec(1, 1)
    for each in side:
        if each.frame is not None and each.frame.name == "HEARTBEAT" and each.frame.component in (1, 190):
            codec = Codec(each.frame.system, each.frame.component)
            told = each.frame.message
            fields = {name: getattr(told, name) for name in ("type", "autopilot", "base_mode", "custom_mode")}
            return codec.pack(make("HEARTBEAT", system_status=0, mavlink_version=3, **fields))
    return b""


def _frames(data: bytes) -> list[bytes]:
    """Return the good frames of a stream, but for the gateway's own."""
    return [each.raw for each in Codec(9, 9).read(data) if isinstance(each, Frame) and each.system != OWN]


def _recorded(log: Path, records: Sequence[tlog.Record], rounds: int) -> dict[str, Any]:
    """Say whether the log has every good frame that was heard, in order."""
    keys = Keys(FLEET)
    heard: dict[bool, list[bytes]] = {False: [], True: []}
    for path in sorted(log.glob("*.mcap*")):
        for message in read(path):
            if not message.key.endswith("/rx"):
                continue
            ground = not message.key.startswith(f"{keys.root}/robot/")
            heard[ground].append(message.payload)
    count = repeated = 0
    wrong = Counter[str]()
    for ground in (False, True):
        side = [each.raw for each in records if each.frame is not None and tlog.is_ground(each) is ground]
        found = heard[ground][1:]  # the greeting
        again, differences = _differences(side * rounds, found)
        count += len(found)
        repeated += again
        wrong.update(differences)
    told: dict[str, Any] = {"frames": count, "repetitions_left_out": repeated, "byte_for_byte": not wrong}
    return told | ({"wrong": dict(wrong)} if wrong else {})


@asynccontextmanager
async def _process(*arguments: str, program: str = _PYTHON) -> AsyncGenerator[asyncio.subprocess.Process]:
    """A process that is gone afterwards."""
    process = await asyncio.create_subprocess_exec(program, *arguments, stdout=asyncio.subprocess.PIPE, limit=2**24)
    try:
        yield process
    finally:
        if process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await process.wait()
