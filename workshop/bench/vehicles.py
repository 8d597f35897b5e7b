"""Many MAVLink vehicles at one gateway: what it costs, what is lost, and how soon commands and a stop arrive.

The vehicles are simulated in one process, most on a link of their own and some behind one, each with 50 frames a
second; three ground stations hear all of them, and one gives commands. The one that is commanded has a process of its
own: what a simulator of sixty takes to answer is not the gateway's. Then the same beside one vehicle that sends
thousands of frames a second and one that comes and goes. Stations are TCP, so that nothing but the gateway can lose a
frame of theirs.
"""

import asyncio
import contextlib
import os
import socket
import sys
import threading
import time
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, cast

import psutil
from msgspec import Struct

from appliance.client import FleetClient
from appliance.config import GatewayConfig
from appliance.errors import DeadlineError
from appliance.llm.settings import LlmConfig
from appliance.model.robot_api import MavlinkLink
from appliance.pool.settings import PoolConfig
from appliance.ports import free_port
from appliance.robots.mavlink.dialect import Codec, constant, make
from appliance.robots.settings import RobotsConfig
from workshop import local_fleet
from workshop.bench.chaos.arena import Arena, Progress, loopback
from workshop.bench.figures import summary
from workshop.bench.pooled import fleet_name, workspace

STREAMS = 1.92
"""Times as often as usual: 50 frames a second and vehicle."""
COMMAND_EVERY_S = 0.05
ANSWER_S = 2.0
READY_S = 60.0
STORM, FLAPPING = 200, 201
"""Systems of the two that misbehave."""
CORES, LOG_MB, ACK_MS, STOP_MS = 0.6, 6.0, 50.0, 300.0
"""Promised for 64 vehicles: cores of the gateway, log a minute, p99 of a command's acknowledgement, a stop of all."""
_HEAD = 10
_ACK = 77


class Options(Struct, frozen=True, kw_only=True):
    """What is measured."""

    vehicles: int = 64
    behind: int = 8
    """Of these, behind one link."""
    stations: int = 3
    seconds: float = 15.0
    """For how long, with and without the storm."""
    storm: int = 20_000
    """Frames a second of the vehicle that sends too many."""


class Station(asyncio.Protocol):
    """A ground station: counts what it hears and what is missing by the numbers of frames, and waits for answers."""

    def __init__(self, number: int) -> None:
        self.codec = Codec(255 - number, 190)
        self.frames = self.missing = 0
        """Frames for everybody, and numbers that are missing: of those that were for another, too."""
        self.waiting: dict[tuple[int, int], asyncio.Future[float]] = {}
        """System and command -> when the acknowledgement came."""
        self._last: dict[tuple[int, int], int] = {}
        self._data = bytearray()
        self._transport: asyncio.Transport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Greet."""
        self._transport = cast("asyncio.Transport", transport)
        self.beat()

    def beat(self) -> None:
        """Send a heartbeat, as stations do each second."""
        fields = {"autopilot": 8, "base_mode": 0, "custom_mode": 0, "system_status": 4, "mavlink_version": 3}
        self.send(self.codec.pack(make("HEARTBEAT", type=constant("MAV_TYPE_GCS"), **fields)))

    def send(self, raw: bytes) -> None:
        """Send a frame."""
        if self._transport is not None:
            self._transport.write(raw)

    def data_received(self, data: bytes) -> None:
        """Take frames out of the stream; the gateway sends nothing else."""
        buffer, at = self._data, 0
        buffer += data
        while len(buffer) - at >= _HEAD:
            size = 12 + buffer[at + 1] + (13 if buffer[at + 2] & 1 else 0) if buffer[at] == 0xFD else 8 + buffer[at + 1]
            if len(buffer) - at < size:
                break
            if buffer[at] == 0xFD:
                self._heard(buffer[at + 4], buffer[at + 5], buffer[at + 6], buffer[at + 7], buffer, at)
            at += size
        del buffer[:at]

    def _heard(self, number: int, system: int, component: int, kind: int, buffer: bytearray, at: int) -> None:
        self.frames += 1
        if system < STORM:
            last = self._last.get((system, component))
            self._last[system, component] = number
            if last is not None:
                self.missing += (number - last - 1) % 256
        if kind == _ACK:
            command = int.from_bytes(buffer[at + _HEAD : at + _HEAD + 2], "little")
            waiting = self.waiting.get((system, command))
            if waiting is not None and not waiting.done():
                waiting.set_result(time.monotonic())

    async def ask(self, system: int) -> float | None:
        """Command a vehicle to say something; returns how long its acknowledgement took, ms; None when none came."""
        command = constant("MAV_CMD_REQUEST_MESSAGE")
        waiting: asyncio.Future[float] = asyncio.get_running_loop().create_future()
        self.waiting[system, command] = waiting
        fields = {f"param{number}": 0.0 for number in range(2, 8)}
        asked = make(
            "COMMAND_LONG", target_system=system, target_component=1, command=command, confirmation=0,
            param1=float(constant("MAVLINK_MSG_ID_AUTOPILOT_VERSION")), **fields,
        )  # fmt: skip
        began = time.monotonic()
        self.send(self.codec.pack(asked))
        try:
            async with asyncio.timeout(ANSWER_S):
                return (await waiting - began) * 1e3
        except TimeoutError:
            return None
        finally:
            self.waiting.pop((system, command), None)


class Trouble:
    """A vehicle that sends thousands of frames a second, and one that comes and goes, from a thread of their own."""

    def __init__(self, storm: int, flapping: int, *, rate: int) -> None:
        self.sent = 0
        self._ports = (storm, flapping)
        self._rate = rate
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """End."""
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        fields = {"type": 2, "autopilot": 3, "base_mode": 0, "custom_mode": 0, "system_status": 3}
        attitude = dict.fromkeys(("roll", "pitch", "yaw", "rollspeed", "pitchspeed", "yawspeed"), 0.0)
        codecs = [Codec(system, 1) for system in (STORM, FLAPPING)]
        beats = [codec.pack(make("HEARTBEAT", mavlink_version=3, **fields)) for codec in codecs]
        many = [codecs[0].pack(make("ATTITUDE", time_boot_ms=each, **attitude)) for each in range(1000)]
        began, each_turn, turn = time.monotonic(), max(1, self._rate // 100), 0
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            while not self._ended.is_set():
                if turn % 100 == 0:
                    out.sendto(beats[0], ("127.0.0.1", self._ports[0]))
                if turn % 10 == 0 and turn // 100 % 5 == 0:  # one second of five
                    out.sendto(beats[1], ("127.0.0.1", self._ports[1]))
                for number in range(each_turn):
                    out.sendto(many[(turn * each_turn + number) % 1000], ("127.0.0.1", self._ports[0]))
                self.sent += each_turn
                turn += 1
                time.sleep(max(0.0, began + turn / 100 - time.monotonic()))


async def run(options: Options, *, progress: Progress) -> dict[str, Any]:
    """Measure; see the module.

    Returns:
        `calm` and `storm`: frames a second in and out, `lost` at the gateway and at stations, commands' `ack` (ms) and
        those `unanswered`, `stop_ms` of a soft stop of all, `cores` of the gateway, `log_mb_per_minute`; the `load`
        of the machine before; `targets`.

    Raises:
        DeadlineError: the vehicles are not seen.
        SwiftbotError: the gateway does not come up.
    """
    load = os.getloadavg()[0]
    with workspace("swiftbot-vehicles-") as folder:
        async with _fleet(options, folder, progress=progress) as (arena, client, stations, trouble):
            progress(f"{options.vehicles} vehicles for {options.seconds:g} s")
            calm = await _phase(options, arena, client, stations)
            progress(f"the same beside {options.storm:,} frames a second of another, and one that comes and goes")
            trouble.start()
            storm = await _phase(options, arena, client, stations)
            trouble.stop()
            storm["stormed_per_s"] = round(trouble.sent / options.seconds)
    found: dict[str, Any] = {"vehicles": options.vehicles, "stations": options.stations, "load": round(load, 1)}
    found |= {"calm": calm, "storm": storm}
    return found | {"targets": targets(found)}


@asynccontextmanager
async def _fleet(
    options: Options, folder: Path, *, progress: Progress
) -> AsyncGenerator[tuple[Arena, FleetClient, list[Station], Trouble]]:
    own = options.vehicles - options.behind
    udp = [free_port(socket.SOCK_DGRAM) for _ in range(own + 3)]
    tcp = [free_port() for _ in range(options.stations)]
    links = [MavlinkLink(listen=f"udp://127.0.0.1:{port}", prefix="drone_") for port in udp]
    links += [MavlinkLink(listen=f"tcp://127.0.0.1:{port}", prefix="drone_") for port in tcp]
    arena = Arena(
        fleet=fleet_name(),
        directory=folder,
        sites=loopback(1),
        pool=PoolConfig(mode="cold"),
        base=GatewayConfig(
            id="gw-1", llm=LlmConfig(tiers=("rules",)), robots=RobotsConfig(mavlink=tuple(links), timesync_s=0.0)
        ),
    )
    to = [f"udp://127.0.0.1:{port}" for port in (*udp[:own], *[udp[own]] * options.behind)]
    command = (sys.executable, "-m", "appliance.cli", "sim", "mavlink", "--streams", str(STREAMS))
    drones: list[local_fleet.Process] = []
    stations = [Station(number) for number in range(options.stations)]
    async with contextlib.AsyncExitStack() as stack:
        stack.push_async_callback(arena.stop, progress=progress)
        await arena.start_all(progress=progress, ready=0)
        alone = options.vehicles - options.behind - 1  # the last one with a link of its own
        groups = {"before": (0, alone), "alone": (alone, alone + 1), "after": (alone + 1, options.vehicles)}
        for name, (first, end) in groups.items():
            arguments = [each for url in to[first:end] for each in ("--to", url)]
            if arguments:
                ordered = (*command, "--system", str(first + 1), *arguments)
                drones.append(local_fleet.spawn(name, ordered, folder / "logs" / f"{name}.log"))
        stack.push_async_callback(local_fleet.end, drones, grace_s=5.0)
        client = await stack.enter_async_context(await arena.client())
        for port, station in zip(tcp, stations, strict=True):
            transport, _ = await asyncio.get_running_loop().create_connection(
                lambda station=station: station, "127.0.0.1", port
            )
            stack.callback(transport.close)
        beating = asyncio.create_task(_beat(stations))
        stack.callback(beating.cancel)
        until = time.monotonic() + READY_S
        while (seen := sum(each.online for each in client.plane.registry.robots.values())) < options.vehicles:
            if time.monotonic() > until:
                raise DeadlineError(f"{seen} of {options.vehicles} vehicles are online", remedy=f"see {folder}/logs")
            await asyncio.sleep(0.2)
        await asyncio.sleep(3.0)  # what is asked of new vehicles has been answered
        yield arena, client, stations, Trouble(udp[own + 1], udp[own + 2], rate=options.storm)


async def _beat(stations: list[Station]) -> None:
    while True:
        for station in stations:
            station.beat()
        await asyncio.sleep(1.0)


async def _phase(options: Options, arena: Arena, client: FleetClient, stations: list[Station]) -> dict[str, Any]:
    process = psutil.Process(arena.processes["gw-1"].pid)
    before, used, logged = await _counts(client), _cpu_s(process), _log_bytes(arena)
    heard = [(each.frames, each.missing) for each in stations]
    began = time.monotonic()
    acks: list[float | None] = []
    while (now := time.monotonic()) - began < options.seconds:
        acks.append(await stations[0].ask(options.vehicles - options.behind))
        await asyncio.sleep(max(0.0, now + COMMAND_EVERY_S - time.monotonic()))
    seconds = time.monotonic() - began
    cores = (_cpu_s(process) - used) / seconds
    after, log_bytes = await _counts(client), _log_bytes(arena) - logged
    told = [
        (each.frames - frames, each.missing - missing) for each, (frames, missing) in zip(stations, heard, strict=True)
    ]
    stopping = time.monotonic()
    # By name: those that misbehave answer nothing, and would be waited for.
    answer = await client.stop([f"drone_{number + 1}" for number in range(options.vehicles)], why="bench")
    stop_ms = (time.monotonic() - stopping) * 1e3
    await client.resume_robots((), why="bench")
    return {
        "frames_in_per_s": round((after[0] - before[0]) / seconds),
        "frames_out_per_s": round((after[1] - before[1]) / seconds),
        "lost": {"gateway": after[2] - before[2], "stations": _lost(told, len(acks))},
        "station_frames_per_s": [round(frames / seconds) for frames, _ in told],
        "ack": summary([each for each in acks if each is not None]),
        "unanswered": sum(each is None for each in acks),
        "stop_ms": round(stop_ms, 1),
        "stop_problems": len(answer.problems) + len(answer.silent),
        "cores": round(cores, 3),
        "log_mb_per_minute": round(log_bytes / 1e6 / seconds * 60, 1),
    }


def _lost(told: list[tuple[int, int]], acknowledged: int) -> int:
    """Return the frames that stations should have heard and have not: acknowledgements are for the first alone."""
    first, *others = (missing for _, missing in told)
    return first + sum(max(0, missing - acknowledged) for missing in others)


async def _counts(client: FleetClient) -> tuple[int, int, int]:
    """Return frames in, frames out, and those of good vehicles that were lost on the way in."""
    (facts,) = (await client.robot_links("gw-1"))[0].values()
    lost = sum(each.lost for link in facts.links for each in link.senders if each.system < STORM)
    return sum(link.frames_in for link in facts.links), sum(link.frames_out for link in facts.links), lost


def _cpu_s(process: psutil.Process) -> float:
    times = process.cpu_times()
    return times.user + times.system


def _log_bytes(arena: Arena) -> int:
    return sum(path.stat().st_size for path in arena.record_dir.glob("*.mcap*"))


def targets(found: dict[str, Any]) -> dict[str, Any]:
    """Return the promises beside what was reached."""
    calm, storm = found["calm"], found["storm"]

    def at_most(promised: float, reached: float | None) -> dict[str, Any]:
        return {"promised": promised, "reached": reached, "kept": reached is not None and reached <= promised}

    return {
        "cores": at_most(CORES, calm["cores"]),
        "log_mb_per_minute": at_most(LOG_MB, calm["log_mb_per_minute"]),
        "ack_p99_ms": at_most(ACK_MS, calm["ack"].get("p99")),
        "stop_ms": at_most(STOP_MS, calm["stop_ms"]),
        "lost": at_most(0, sum(calm["lost"].values()) + calm["unanswered"]),
        "lost_beside_a_storm": at_most(0, storm["lost"]["stations"] + storm["unanswered"]),
        "ack_p99_ms_beside_a_storm": at_most(ACK_MS, storm["ack"].get("p99")),
    }
