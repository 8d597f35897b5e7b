"""A gateway's robots alone, as a process of its own: what its router costs is not mixed with the measurement.

`python -m workshop.bench.mavlink.host FILE` with a Host as JSON in FILE. It prints a line when its links are open, and
a Told on SIGTERM.
"""

import asyncio
import cProfile
import io
import pstats
import signal
import sys
from pathlib import Path
from typing import Any, cast

import msgspec
import uvloop
from msgspec import Struct, field

from appliance import logs
from appliance.model import Site
from appliance.model.robot_api import LinkList, LinksAsk
from appliance.plane.session import Session
from appliance.plane.settings import PlaneConfig
from appliance.plane.store import Store
from appliance.robots.hub import RobotHub
from appliance.robots.settings import RobotsConfig

FLEET = "bench-mavlink"
GATEWAY = "gw-1"


class Host(Struct, frozen=True, kw_only=True):
    """What is run."""

    listen: str
    """Zenoh endpoint."""
    store: str
    robots: RobotsConfig
    profile: bool = False


class Told(Struct, frozen=True, kw_only=True):
    """What it counted, and where its time went."""

    links: LinkList
    refused: dict[str, int] = field(default_factory=dict[str, int])
    profile: tuple[str, ...] = ()


async def serve(host: Host) -> Told:
    """Run until SIGTERM."""
    stop = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, stop.set)
    session = await Session.open(PlaneConfig(listen=(host.listen,)), FLEET)
    store = await Store.open(Path(host.store))
    hub = RobotHub(host.robots, session=session, store=store, gateway=GATEWAY, site=Site())
    profiler = cProfile.Profile() if host.profile else None
    try:
        await hub.start()
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        if profiler is not None:
            profiler.enable()
        await stop.wait()
        if profiler is not None:
            profiler.disable()
        return Told(
            links=await hub.links(LinksAsk()),
            refused=hub.refused | session.refused,
            profile=() if profiler is None else _lines(profiler),
        )
    finally:
        await hub.stop()
        await store.close()
        await session.close()


def _lines(profiler: cProfile.Profile, most: int = 18) -> tuple[str, ...]:
    """Return where the time went, by own time: share, calls, function."""
    stats = pstats.Stats(profiler, stream=io.StringIO())
    table = cast("dict[tuple[str, int, str], tuple[int, int, float, float, object]]", cast("Any", stats).stats)
    total: float = sum(each[2] for each in table.values()) or 1.0
    ordered = sorted(table.items(), key=lambda each: -each[1][2])[:most]
    return tuple(
        f"{own / total:6.1%} {calls:>9,} {Path(file).name}:{line} {name}"
        for (file, line, name), (_, calls, own, _, _) in ordered
    )


if __name__ == "__main__":
    logs.configure(level="warning", style="text")
    told = uvloop.run(serve(msgspec.json.decode(Path(sys.argv[1]).read_bytes(), type=Host)))
    sys.stdout.write(msgspec.json.encode(told).decode() + "\n")
