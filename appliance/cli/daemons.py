"""Daemons, which run until a signal ends them: `swiftbot gateway`, `router`, `record`, `foxglove`."""

import asyncio
import os
import signal
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import uvloop
from cyclopts import App, Parameter

from appliance import logs, process
from appliance.cli.common import DAEMONS, HERE, Where


def add_to(app: App) -> None:
    """Add these commands."""
    for command in (gateway, router, record, foxglove):
        app.command(command, group=DAEMONS)


def gateway(*, config: Path) -> int:
    """Run a gateway until SIGTERM, which drains it.

    Args:
        config: TOML file; see docs/configuration.md.
    """
    from appliance import config as configuration
    from appliance import gateway as daemon
    from appliance.process import gentle_collector

    loaded = configuration.load(config)
    logs.configure(level=loaded.log_level, style=loaded.log_format)
    # Nothing is collected first: a gateway that is started again is wanted at once.
    with gentle_collector(collect=False):
        uvloop.run(daemon.run(loaded))
    return 0


def router(
    *,
    listen: tuple[str, ...] = (),
    connect: tuple[str, ...] = (),
    keys: Path | None = None,
    lease_ms: int = 1000,
    log_format: Literal["json", "text"] = "json",
) -> int:
    """Run a router until SIGTERM or Ctrl-C: for fleets too large for links from each gateway to each.

    Gateways become its clients by `mode = "client"` and `connect` in their [plane] section; it needs no place in the
    fleet and routes for all fleets.

    Args:
        listen: Endpoint to accept links on; repeatable. By default tls/[::]:7447 with --keys, and without
            tcp/127.0.0.1:7447: links from other machines need keys.
        connect: Endpoint of another router to keep linked to; repeatable. A line or star of three to
            five routers is enough.
        keys: File with the keys of this router, issued for a gateway: it routes for the fleet of these keys only.
        lease_ms: A link silent for so long is dead; as the gateways have it in `plane.lease_ms`.
        log_format: json for journald and machines, text for a terminal.
    """
    from appliance.plane.node import run_router
    from appliance.plane.settings import PlaneConfig

    logs.configure(style=log_format)

    async def go() -> None:
        accept = listen or (("tls/[::]:7447",) if keys else ("tcp/127.0.0.1:7447",))
        plane = PlaneConfig(mode="router", listen=accept, connect=connect, keys=str(keys or ""), lease_ms=lease_ms)
        await run_router(plane, stop=until_signalled(), ready=lambda _: process.ready(), alive=process.alive)

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
    from appliance.record.recorder import run_recorder
    from appliance.record.segments import about
    from appliance.record.settings import RecordConfig
    from appliance.skills.sites import load_site

    about_log = about({}, os.environ)
    if config is not None:
        loaded = configuration.load(config)
        about_log = about(msgspec.to_builtins(loaded), os.environ, site=load_site(loaded.site))
        logs.configure(level=loaded.log_level, style=loaded.log_format)
        fleet, settings = loaded.fleet, loaded.record
        plane = loaded.dialling(settings.keys)
    else:
        endpoint = where.endpoint()
        fleet, settings = endpoint.fleet, RecordConfig(directory=str(Path.cwd()))
        plane = endpoint.plane("peer")
        logs.configure(style="text")
    if out is not None:
        settings = msgspec.structs.replace(settings, directory=str(out))

    async def go() -> None:
        # A peer linked to every gateway: a client hangs on one, and would miss what happens while that one is gone.
        await run_recorder(settings, plane, fleet, until_signalled(), alive=_notify_systemd, about=about_log)

    uvloop.run(go())
    return 0


def foxglove(
    *,
    config: Path | None = None,
    host: str = "127.0.0.1",
    port: int = 8765,
    keys: Annotated[tuple[str, ...], Parameter(name="--key", help="Only keys that match.")] = (),
    origins: Annotated[
        tuple[str, ...],
        Parameter(
            name="--origin",
            help="Serve pages of this origin too, such as https://app.foxglove.dev; repeatable. By default programs"
            " and pages of this machine are served.",
        ),
    ] = (),
    where: Where = HERE,
) -> int:
    """Show the running fleet in Foxglove: open ws://127.0.0.1:8765 there. Until SIGTERM or Ctrl-C.

    The same channels and schemas as in a log. Needs the extra `foxglove`.

    Args:
        config: A gateway's TOML file: its fleet and endpoints, its site for the map.
        host: Loopback only: anyone who connects sees everything.
        port: Port to listen on; 0: any.
        where: The fleet, when no configuration is given.
    """
    from appliance import config as configuration
    from appliance.record.foxglove_bridge import LiveOptions, serve
    from appliance.record.segments import about
    from appliance.skills.sites import load_site

    about_log = about({}, os.environ)
    if config is not None:
        loaded = configuration.load(config)
        logs.configure(level=loaded.log_level, style=loaded.log_format)
        about_log = about(msgspec.to_builtins(loaded), os.environ, site=load_site(loaded.site))
        fleet, plane = loaded.fleet, loaded.dialling(loaded.record.keys)
    else:
        endpoint = where.endpoint()
        fleet, plane = endpoint.fleet, endpoint.plane("peer")
        logs.configure(style="text")

    async def go() -> None:
        options = LiveOptions(host=host, port=port, keys=keys, origins=origins)
        await serve(options, plane, fleet, until_signalled(), about=about_log, told=_notify_systemd)

    uvloop.run(go())
    return 0


def _notify_systemd(_: object) -> None:
    process.ready()
    process.alive()


def until_signalled() -> asyncio.Event:
    """Return an event that SIGINT and SIGTERM set."""
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    return stop
