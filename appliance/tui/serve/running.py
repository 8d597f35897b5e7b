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


def session_command(fleet: str, connect: Sequence[str], options: Sequence[str]) -> list[str]:
    """Return the command of one browser's terminal UI."""
    words = [word for each in connect for word in ("--connect", each)]
    return [sys.executable, "-m", "appliance.cli", "tui", "--fleet", fleet, *words, *options]


async def serve(
    fleet: str,
    connect: Sequence[str],
    *,
    port: int,
    options: Sequence[str],
    stop: asyncio.Event,
    tell: Callable[[str], object],
) -> None:
    """Serve the terminal UI of a fleet to browsers on this machine until `stop` is set.

    Args:
        fleet: its name.
        connect: endpoints of its gateways or routers.
        port: where to listen; 0: any that is free.
        options: of `swiftbot tui` for each session, such as `--write`: without it sessions start locked.
        stop: ends it.
        tell: takes the address, which has the token in it.

    Raises:
        ConfigError: the port is in use, or the token given will not do.
    """
    # Taken out of the environment: the terminal UIs that are started have no use for it.
    token = os.environ.pop(TOKEN, "") or make_token()
    listening = listen(port)
    port = listening.getsockname()[1]
    command = session_command(fleet, connect, options)
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
