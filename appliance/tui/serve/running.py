"""`swiftbot tui --serve`: the server with its token, until it is told to stop."""

import asyncio
import os
import sys
from collections.abc import Callable, Sequence

from appliance.errors import ConfigError
from appliance.tui.serve.guard import Guard, make_token
from appliance.tui.serve.server import BrowserServer, listen

TOKEN = "SWIFTBOT_TUI_TOKEN"  # noqa: S105 - the name of a variable
"""Environment variable of a token of one's own."""


async def serve(
    fleet: str,
    connect: Sequence[str],
    *,
    port: int,
    write: bool,
    stop: asyncio.Event,
    tell: Callable[[str], object],
) -> None:
    """Serve the terminal UI of a fleet to browsers on this machine until `stop` is set.

    Args:
        fleet: its name.
        connect: endpoints of its gateways or routers.
        port: where to listen; 0: any that is free.
        write: whether sessions start unlocked.
        stop: ends it.
        tell: takes the address, which has the token in it.

    Raises:
        ConfigError: the port is in use, or the token given will not do.
    """
    # Taken out of the environment: the terminal UIs that are started have no use for it.
    token = os.environ.pop(TOKEN, "") or make_token()
    listening = listen(port)
    port = listening.getsockname()[1]
    command = [sys.executable, "-m", "appliance.cli", "tui", "--fleet", fleet]
    command += [word for each in connect for word in ("--connect", each)]
    if write:
        command.append("--write")
    try:
        server = BrowserServer(command, Guard(token, port), title=f"SwiftBot · {fleet}")
    except ConfigError:
        listening.close()
        raise
    await server.start(listening)
    try:
        tell(f"http://127.0.0.1:{port}/?token={token}")
        await stop.wait()
    finally:
        await server.close()
