"""`swiftbot mcp`: the fleet for assistants that speak the Model Context Protocol, over stdio or HTTP on the loopback.

Over HTTP a request needs the token, so that another user of the machine does nothing in this one's name, and a web page
does not either: `Host` has to be the loopback and `Origin`, where there is one, this server (DNS rebinding).
"""

import os
import secrets
import socket
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter
from cyclopts.validators import Number

from appliance import console
from appliance.cli.common import DAEMONS, HERE, Where
from appliance.errors import ConfigError, NotFoundError
from appliance.model import Approval

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Receive, Scope, Send

MOST_BYTES = 256 * 1024
"""Of one HTTP request: an instruction has 2,000 characters."""
MOST_SESSIONS = 64
IDLE_S = 3600.0
"""After which a session that asks nothing is forgotten."""


def add_to(app: App) -> None:
    """Add this command."""
    app.command(mcp, group=DAEMONS)


async def mcp(
    *,
    http: Annotated[bool, Parameter(help="Serve HTTP on the loopback instead of stdio.")] = False,
    port: Annotated[
        int, Parameter(help="Port for --http; 0: any.", validator=Number(gte=0, lte=65535))
    ] = 8775,
    token: Annotated[
        Path | None, Parameter(help="File with the token that HTTP requests carry; made if it does not exist.")
    ] = None,
    approval: Annotated[
        Approval, Parameter(help="Which plans of what assistants submit wait for an operator.")
    ] = Approval.ALWAYS,
    logs: Annotated[
        Path | None, Parameter(help="Folder of MCAP logs to show figures of; by default the local fleet's.")
    ] = None,
    where: Where = HERE,
) -> int:  # fmt: skip
    """Serve the fleet to assistants over the Model Context Protocol, on stdio or, with --http, on the loopback.

    They look (robots, places, tasks and why, alerts, logs), plan without running, submit, cancel, and give the soft
    stop. What they submit waits for `swiftbot task approve`. They command no robot, and cannot approve or resume.
    """
    endpoint = where.endpoint()
    # Only now: `swiftbot --help` must not load the protocol's package.
    from appliance.cli.mcp_tools import Tools, server_of
    from appliance.record.segments import VERSION

    tools = Tools(where.client(), approval=approval, logs=logs or _recorded(where))
    server = server_of(tools, version=VERSION)
    try:
        if not http:
            await server.run_stdio_async()
            return 0
        from mcp.server.transport_security import TransportSecuritySettings
        from uvicorn import Config, Server

        secret, file = token_in(token or where.folder() / f"mcp-{endpoint.fleet}.token")
        with _listen(port) as listening:
            port = listening.getsockname()[1]
            names = [f"{host}:{port}" for host in ("127.0.0.1", "localhost")]
            allowed = TransportSecuritySettings(
                allowed_hosts=names, allowed_origins=[f"http://{name}" for name in names]
            )
            app = server.streamable_http_app(
                transport_security=allowed, max_request_body_size=MOST_BYTES, max_sessions=MOST_SESSIONS,
                session_idle_timeout=IDLE_S,
            )  # fmt: skip
            console.err.print(f"http://{names[0]}/mcp, token in {file}", markup=False, soft_wrap=True)
            await Server(Config(with_token(app, secret), log_config=None, access_log=False)).serve([listening])
        return 0
    finally:
        await tools.close()


def _recorded(where: Where) -> Path | None:
    """Return the folder of a local fleet's recorder."""
    from appliance.connection import read_state

    try:
        return Path(read_state(where.folder()).record_dir) if not where.connect else None
    except NotFoundError:
        return None


def _listen(port: int) -> socket.socket:
    try:
        return socket.create_server(("127.0.0.1", port))
    except OSError as error:
        raise ConfigError(f"port {port} on 127.0.0.1: {error.strerror}", remedy="give another --port") from error


def token_in(file: Path) -> tuple[str, Path]:
    """Return the token in a file and the file, which is made with a new one where there is none.

    Raises:
        ConfigError: it cannot be read or made, others may read it, or it holds less than 32 characters.
    """
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        try:
            with os.fdopen(os.open(file, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600), "w") as made:
                made.write(secrets.token_urlsafe(32) + "\n")
        except FileExistsError:
            if file.stat().st_mode & 0o077:
                raise ConfigError(f"{file}: others may read it", remedy=f"chmod 600 {file}") from None
        secret = file.read_text("ascii").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: {error}", remedy="give a --token file that can be written") from error
    if len(secret) < 32:
        raise ConfigError(f"{file} holds no token of 32 characters or more", remedy="remove it: a new one is made")
    return secret, file


def with_token(app: "ASGIApp", secret: str) -> "ASGIApp":
    """Return an application that answers 401 to requests without `Authorization: Bearer TOKEN`."""
    wanted = f"Bearer {secret}".encode()

    async def serve(scope: "Scope", receive: "Receive", send: "Send") -> None:
        given = next((value for name, value in scope.get("headers", ()) if name == b"authorization"), b"")
        if scope["type"] != "http" or secrets.compare_digest(given, wanted):
            await app(scope, receive, send)
            return
        headers = [(b"www-authenticate", b"Bearer"), (b"content-type", b"text/plain")]
        await send({"type": "http.response.start", "status": 401, "headers": headers})
        await send({"type": "http.response.body", "body": b"the token of `swiftbot mcp --http` is missing or wrong\n"})

    return serve
