"""What runs until it is told to stop: `swiftbot gateway`, `record`, `sim …`."""

import asyncio
import os
import signal
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import uvloop
from cyclopts import App, Parameter

from appliance import logs, service
from appliance.cli.common import DAEMONS, HERE, Where

sim_app = App(name="sim", help="Simulated robots.", group=DAEMONS)


def add_to(app: App) -> None:
    """Add these commands."""
    for command in (gateway, router, record, foxglove):
        app.command(command, group=DAEMONS)
    app.command(sim_app)


def gateway(*, config: Path) -> int:
    """Run a gateway until SIGTERM, which drains it.

    Args:
        config: TOML file, see docs/configuration.md.
    """
    from appliance import config as configuration
    from appliance import gateway as daemon
    from appliance.collector import gentle_collector

    loaded = configuration.load(config)
    logs.configure(level=loaded.log_level, style=loaded.log_format)
    # Nothing is collected first: a gateway that is started again is wanted at once.
    with gentle_collector(collect=False):
        uvloop.run(daemon.run(loaded))
    return 0


def router(
    *,
    listen: tuple[str, ...] = ("tcp/[::]:7447",),
    connect: tuple[str, ...] = (),
    lease_ms: int = 1000,
    log_format: Literal["json", "text"] = "json",
) -> int:
    """Run a router until SIGTERM or Ctrl-C: for fleets too large for links from each gateway to each.

    Gateways become its clients by `mode = "client"` and `connect` in their [plane] section; it needs no place in the
    fleet and routes for all fleets.

    Args:
        listen: Endpoint to accept links on; may be given several times.
        connect: Endpoint of another router to keep linked to; may be given several times. A line or star of three to
            five routers is enough.
        lease_ms: A link silent for so long is dead; as the gateways have it in `plane.lease_ms`.
        log_format: json for journald and machines, text for a terminal.
    """
    from appliance.plane.router import run_router
    from appliance.plane.settings import PlaneConfig

    logs.configure(style=log_format)

    async def go() -> None:
        plane = PlaneConfig(mode="router", listen=listen, connect=connect, lease_ms=lease_ms)
        await run_router(plane, stop=_until_signalled(), ready=lambda _: service.ready(), alive=service.alive)

    uvloop.run(go())
    return 0


def record(*, config: Path | None = None, out: Path | None = None, where: Where = HERE) -> int:
    """Record every message of a fleet into MCAP until SIGTERM or Ctrl-C.

    Args:
        config: A gateway's TOML file: its fleet, endpoints and [record] section.
        out: Directory for the log files, instead of the configured one.
        where: The fleet, when no configuration is given.
    """
    from appliance import config as configuration
    from appliance.plane.settings import PlaneConfig
    from appliance.record.about import about
    from appliance.record.recorder import run_recorder
    from appliance.record.settings import RecordConfig
    from appliance.skills.sites import load_site

    told = about({}, os.environ)
    if config is not None:
        loaded = configuration.load(config)
        told = about(msgspec.to_builtins(loaded), os.environ, site=load_site(loaded.site))
        logs.configure(level=loaded.log_level, style=loaded.log_format)
        fleet, settings = loaded.fleet, loaded.record
        connect = loaded.endpoints()
    else:
        endpoint = where.endpoint()
        fleet, connect, settings = endpoint.fleet, endpoint.connect, RecordConfig(directory=str(Path.cwd()))
        logs.configure(style="text")
    if out is not None:
        settings = msgspec.structs.replace(settings, directory=str(out))

    async def go() -> None:
        # A peer linked to every gateway: a client hangs on one, and would miss what happens while that one is gone.
        plane = PlaneConfig(mode="peer", connect=connect)
        await run_recorder(settings, plane, fleet, _until_signalled(), alive=_tell_systemd, about=told)

    uvloop.run(go())
    return 0


def foxglove(
    *,
    config: Path | None = None,
    host: str = "127.0.0.1",
    port: int = 8765,
    keys: Annotated[tuple[str, ...], Parameter(name="--key", negative="", help="Only keys that match.")] = (),
    where: Where = HERE,
) -> int:
    """Show the running fleet in Foxglove: open ws://127.0.0.1:8765 there. Until SIGTERM or Ctrl-C.

    The same channels and schemas as in a log. Needs the extra `foxglove`.

    Args:
        config: A gateway's TOML file: its fleet and endpoints, its site for the map.
        host: Loopback only, since whoever connects sees everything.
        port: Port to listen on; 0: any.
        where: The fleet, when no configuration is given.
    """
    from appliance import config as configuration
    from appliance.plane.settings import PlaneConfig
    from appliance.record.about import about
    from appliance.record.live import LiveOptions, serve
    from appliance.skills.sites import load_site

    told = about({}, os.environ)
    if config is not None:
        loaded = configuration.load(config)
        logs.configure(level=loaded.log_level, style=loaded.log_format)
        told = about(msgspec.to_builtins(loaded), os.environ, site=load_site(loaded.site))
        fleet, connect = loaded.fleet, loaded.endpoints()
    else:
        endpoint = where.endpoint()
        fleet, connect = endpoint.fleet, endpoint.connect
        logs.configure(style="text")

    async def go() -> None:
        options = LiveOptions(host=host, port=port, keys=keys)
        plane = PlaneConfig(mode="peer", connect=connect)
        await serve(options, plane, fleet, _until_signalled(), about=told, told=_tell_systemd)

    uvloop.run(go())
    return 0


def _tell_systemd(_: object) -> None:
    service.ready()
    service.alive()


def _until_signalled() -> asyncio.Event:
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    return stop


@sim_app.command
def mavlink(
    *,
    to: str,
    listen: Annotated[bool, Parameter(negative="")] = False,
    system: int = 1,
    site: str = "warehouse",
    rate: float = 1.0,
    start: str = "home",
    kind: Literal["copter", "rover"] = "copter",
    parameter: Annotated[tuple[str, ...], Parameter(consume_multiple=True, negative="")] = (),
    drop: float = 0.0,
    double: float = 0.0,
    mix: float = 0.0,
    delay_s: float = 0.0,
    seed: int = 1,
) -> int:
    """Simulate a MAVLink vehicle that sends to a gateway, or waits for one.

    Args:
        to: Where the gateway listens, udp://host:port or tcp://host:port.
        listen: Listen there (tcp), as SITL does, and let the gateway connect.
        system: MAVLink system id, 1 to 255.
        site: Built-in site or site file.
        rate: How many times faster than real it moves.
        start: Place it starts at.
        kind: A multirotor or a rover.
        parameter: NAME=VALUE of its autopilot that differ from the usual, such as SIM_WIND_SPD=6 or FENCE_ENABLE=1.
        drop: Share of frames that its link loses, each way.
        double: Share of frames that arrive twice.
        mix: Share of frames that arrive after later ones.
        delay_s: Time that frames are on their way.
        seed: Of the link's chances: the same one loses the same frames.
    """
    from appliance.robots.sim.mavlink import VehicleSettings, read_parameters, run_vehicle
    from appliance.skills.sites import load_site

    logs.configure(style="text")
    settings = VehicleSettings(
        to=to,
        listen=listen,
        system=system,
        site=load_site(site),
        rate=rate,
        start=start,
        kind=kind,
        parameters=read_parameters(parameter),
        drop=drop,
        double=double,
        mix=mix,
        delay_s=delay_s,
        seed=seed,
    )

    async def go() -> None:
        await run_vehicle(settings, stop=_until_signalled())

    asyncio.run(go())
    return 0


@sim_app.command
def zenoh(*, name: str, site: str = "warehouse", rate: float = 1.0, start: str = "charger", where: Where = HERE) -> int:
    """Simulate a mobile robot with arm and camera that speaks Zenoh.

    Args:
        name: Its name in the roster.
        site: Built-in site or site file.
        rate: How many times faster than real it moves.
        start: Place it starts at.
        where: The fleet.
    """
    from appliance.robots.sim.zenoh_robot import RobotSettings, run_robot
    from appliance.skills.sites import load_site

    logs.configure(style="text")
    endpoint = where.endpoint()
    settings = RobotSettings(
        name=name, fleet=endpoint.fleet, connect=endpoint.connect, site=load_site(site), rate=rate, start=start
    )

    async def go() -> None:
        await run_robot(settings, stop=_until_signalled())

    asyncio.run(go())
    return 0
