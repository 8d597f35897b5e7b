"""`swiftbot tui`: the terminal UI, here or served to browsers."""

import asyncio
import signal
from pathlib import Path
from typing import Annotated

import msgspec
from cyclopts import App, Parameter

from appliance import console
from appliance.cli.common import HERE, WORK, Where
from appliance.client import Endpoint
from appliance.errors import ConfigError


def add_to(app: App) -> None:
    """Add this command."""
    app.command(tui, group=WORK)


async def tui(
    *,
    write: Annotated[bool, Parameter(help="Start unlocked; without it, `:write` unlocks.")] = False,
    theme: Annotated[
        str, Parameter(help="dark, light, blind-dark, blind-light, contrast-dark or contrast-light.")
    ] = "",
    config: Annotated[
        Path | None, Parameter(help="Own settings and keys, TOML; else ~/.config/swiftbot/tui.toml, if present.")
    ] = None,
    replay: Annotated[
        Path | None, Parameter(help="Show this recorded log (MCAP) instead of a fleet: play, pause, seek.")
    ] = None,
    serve: Annotated[
        bool, Parameter(help="Serve it to browsers on this machine; prints an address with a token.")
    ] = False,
    port: Annotated[int, Parameter(help="Port of --serve on 127.0.0.1; 0: any free one.")] = 0,
    where: Where = HERE,
) -> int:
    """Open the terminal UI on a fleet or on a recorded log, here or in a browser."""
    from appliance.tui import settings
    from appliance.tui.app import run_tui

    own = settings.load(config)
    own = msgspec.structs.replace(own, write=own.write or write, theme=theme or own.theme)
    if replay is not None and serve:
        raise ConfigError(
            "--serve shows a fleet", remedy="open the log in the browser by `:open FILE`, or omit --serve"
        )
    endpoint = Endpoint(fleet=where.fleet, connect=()) if replay is not None else where.endpoint()
    if serve:
        # Each browser's terminal UI is a process of its own, with the same options.
        options = ["--theme", own.theme] + (["--write"] if own.write else [])
        options += ["--config", str(config)] if config is not None else []
        options += ["--keys", endpoint.keys] if endpoint.keys else []
        await _serve(endpoint, port=port, options=options)
        return 0
    plane = endpoint.plane()
    if where.directory is not None:
        own = msgspec.structs.replace(own, logs=(*own.logs, str(where.directory / "record")))
    await run_tui(plane, endpoint.fleet, own, replay=replay)
    return 0


async def _serve(endpoint: Endpoint, *, port: int, options: list[str]) -> None:
    """Serve the terminal UI until SIGTERM or Ctrl-C."""
    from appliance.tui.serve import serve

    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)

    def tell(address: str) -> None:
        # Flushed: a process that started it waits for the address.
        print(address, flush=True)
        console.err.print("anyone with this address may view, and unlock; Ctrl-C ends it")

    await serve(endpoint.fleet, endpoint.connect, port=port, options=options, stop=stop, tell=tell)
