"""The terminal UI in a browser: `swiftbot tui --serve`, on this machine's loopback, behind a token.

A page, its files, and a WebSocket to a terminal UI of its own for each browser. What `textual-serve` has for it is
used: the script of the page, and the service that runs a Textual program without a terminal. Its own server is not,
since it lets everybody in and has the page load a font from elsewhere; the page here speaks to this server and to
nobody else.

`Guard` decides who is let in: requests with the token, from a page of this very server. Loopback alone guards nothing:
every user of the machine reaches it, and so does any web page that a browser on it shows, by a request of its own (the
Origin tells) or by a name that it has made to point at 127.0.0.1 (the Host tells; "DNS rebinding"). All three are
checked for every request, files included.
"""

import asyncio
import contextlib
import hmac
import json
import os
import secrets
import shlex
import socket
import sys
from collections.abc import Awaitable, Callable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any, cast

import structlog
import textual_serve
from aiohttp import WSCloseCode, WSMsgType, web
from textual_serve.app_service import AppService
from textual_serve.download_manager import DownloadManager

from appliance.errors import ConfigError

SHORTEST = 16
"""Characters of a given token: 128 bits if it is drawn well."""


def make_token() -> str:
    """Return a token that cannot be guessed: 256 bits."""
    return secrets.token_urlsafe(32)


class Guard:
    """The door of one server.

    Args:
        token: what must be known.
        port: where it listens.

    Raises:
        ConfigError: the token is too short, or has characters that no cookie carries.
    """

    def __init__(self, token: str, port: int) -> None:
        if len(token) < SHORTEST or not token.isascii() or not token.replace("-", "").replace("_", "").isalnum():
            raise ConfigError(
                "the token of the browser version is too short or has other characters than letters, digits, - and _",
                remedy=f"give at least {SHORTEST} of them, or none: then one is made",
            )
        self._token = token.encode()
        self.cookie = f"swiftbot-{port}"
        """Name of the cookie; it has the port, since browsers share cookies between the ports of a host."""
        self.hosts = frozenset({f"127.0.0.1:{port}", f"localhost:{port}", f"[::1]:{port}"})
        self.refused: dict[str, int] = {}
        """Requests that were turned away, by reason."""

    def knows(self, given: str | None) -> bool:
        """Whether that is the token; takes as long for a wrong one."""
        return given is not None and hmac.compare_digest(given.encode(errors="replace"), self._token)

    def refusal(self, headers: Mapping[str, str], *, given: str | None, socket: bool) -> str:
        """Return why a request is turned away, empty when it is let in.

        Args:
            headers: its headers, by any case.
            given: the token it carries, in its cookie or its address.
            socket: whether it opens a WebSocket, which must tell where it comes from.
        """
        found = self._refusal({name.lower(): value for name, value in headers.items()}, given, socket=socket)
        if found:
            self.refused[found] = self.refused.get(found, 0) + 1
        return found

    def _refusal(self, headers: Mapping[str, str], given: str | None, *, socket: bool) -> str:
        host = headers.get("host", "").lower()
        if host not in self.hosts:
            return "it was not asked for by this machine's own name"
        origin = headers.get("origin")
        if origin is None:
            if socket:
                return "it does not tell which page it comes from"
        elif origin.lower() != f"http://{host}":
            return "it comes from another page"
        if headers.get("sec-fetch-site", "same-origin") not in ("same-origin", "none"):
            # The first opening is typed or clicked in a terminal ("none"); all else is asked for by our own page.
            return "it comes from another page"
        return "" if self.knows(given) else "it does not know the token"


POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; font-src 'self'; img-src 'self' data:; "
    "connect-src 'self' ws://{host}; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)
"""Content security policy: the terminal's script sets styles of its own."""

STYLE = """
@font-face { font-family: "Roboto Mono"; src: url("/static/fonts/RobotoMono-VariableFont_wght.ttf"); }
html, body { height: 100%; margin: 0; background: #0c181f; color: #e8eef0; font-family: "Roboto Mono", monospace; }
#terminal { height: 100vh; }
.told { display: none; position: absolute; inset: 0; align-items: center; justify-content: center; }
.told { background: #0c181f; }
.told a { color: inherit; }
body:not(.-first-byte) .opening, body.-closed .closed { display: flex; z-index: 10; }
body.-closed .opening { display: none; }
"""

SCRIPT = """
// The token has done its work: it is in the cookie now, and needs to be neither in the address bar nor in the history.
history.replaceState(null, "", location.pathname);
// Keys, that of the soft stop above all, must reach the terminal without a click first.
const seeking = setInterval(() => {
  const field = document.querySelector(".xterm-helper-textarea");
  if (field) { clearInterval(seeking); field.focus(); }
}, 100);
"""

_PAGE = """<!DOCTYPE html>
<html lang="en">
  <head>
    <meta charset="utf-8">
    <title>{title}</title>
    <link rel="icon" href="data:,">
    <link rel="stylesheet" href="/static/css/xterm.css">
    <link rel="stylesheet" href="/page.css">
    <script src="/page.js"></script>
    <script src="/static/js/textual.js"></script>
  </head>
  <body>
    <div class="told opening">opening {title} …</div>
    <div class="told closed"><p>The session has ended. <a href="/">Open it again</a></p></div>
    <div id="terminal" class="textual-terminal" data-session-websocket-url="ws://{host}/ws"
      data-font-size="{size}"></div>
  </body>
</html>
"""


def page(title: str, host: str, *, size: int = 16) -> str:
    """Return the page of a fleet's terminal UI, for a browser that asked this host for it."""
    return _PAGE.format(title=escape(title), host=escape(host), size=size)


log = structlog.get_logger(__name__)

SESSIONS = 8
"""Browsers at once: each has a process of its own, of some 100 MB."""
MOST_BYTES = 64 * 1024
"""Of one message of a browser: a large paste."""
STOP_S = 5.0
"""For so long a terminal UI may take to end; then it is killed."""
_FILES = Path(textual_serve.__file__).parent / "static"

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


def listen(port: int) -> socket.socket:
    """Return a socket that listens on loopback; port 0: any that is free.

    Raises:
        ConfigError: the port is in use.
    """
    made = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        made.bind(("127.0.0.1", port))
        made.listen(64)
    except (OSError, OverflowError) as error:
        made.close()
        raise ConfigError(f"127.0.0.1:{port} cannot be listened on: {error}", remedy="give another --port") from error
    return made


class _Session(AppService):
    """One terminal UI for one browser; the connection ends with it, and it with the connection."""

    async def run(self) -> None:
        """Run it to its end."""
        try:
            await super().run()
        finally:
            await self.remote_close()

    async def end(self) -> None:
        """Ask it to end, then have it end."""
        try:
            async with asyncio.timeout(STOP_S):
                await self.stop()
        except TimeoutError:
            log.warning("a terminal UI did not end and is killed", after_s=STOP_S)
        process = self._process
        if process is not None and process.returncode is None:
            # It may be on its way out; killed, it ends at once either way.
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await process.wait()


class BrowserServer:
    """The server.

    Args:
        command: what runs a terminal UI, as words.
        guard: who is let in; it knows the port.
        title: of the page.
    """

    def __init__(self, command: Sequence[str], guard: Guard, *, title: str) -> None:
        # `exec`: the shell that textual-serve starts becomes the program, so that killing it kills that.
        self._command = f"exec {shlex.join(command)}"
        self._guard = guard
        self._title = title
        self._sockets: set[web.WebSocketResponse] = set()
        self._runner: web.AppRunner | None = None

    @property
    def sessions(self) -> int:
        """Browsers that have it open."""
        return len(self._sockets)

    async def start(self, listening: socket.socket) -> None:
        """Answer on a socket that `listen` has made."""

        @web.middleware
        async def guarded(request: web.Request, handler: Handler) -> web.StreamResponse:
            return await self._guarded(request, handler)

        app = web.Application(middlewares=[guarded], client_max_size=MOST_BYTES)
        app.add_routes(
            [
                web.get("/", self._index),
                web.get("/page.css", self._style),
                web.get("/page.js", self._script),
                web.get("/ws", self._socket),
                web.static("/static", _FILES),
            ]
        )
        runner = web.AppRunner(app, access_log=None, shutdown_timeout=1.0)
        await runner.setup()
        self._runner = runner
        await web.SockSite(runner, listening).start()

    async def close(self) -> None:
        """End all sessions and listen no more."""
        for each in tuple(self._sockets):
            await each.close(code=WSCloseCode.GOING_AWAY, message=b"the server ends")
        if self._runner is not None:
            await self._runner.cleanup()
            self._runner = None

    # --- requests -------------------------------------------------------------------------------------------------

    async def _guarded(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        given = request.query.get("token")
        if not self._guard.knows(given):  # an old address may be opened again, and an old cookie be sent with a new one
            given = request.cookies.get(self._guard.cookie)
        refusal = self._guard.refusal(request.headers, given=given, socket=request.path == "/ws")
        if refusal:
            log.warning("a browser was turned away", path=request.path[:80], why=refusal)
            response: web.StreamResponse = web.Response(
                status=403, text=f"403: {refusal}. Open the address that `swiftbot tui --serve` has printed.\n"
            )
        else:
            try:
                response = await handler(request)
            except web.HTTPException as error:
                response = web.Response(status=error.status, text=f"{error.status}: {error.reason}\n")
        if not response.prepared:
            self._secure(request, response)
        return response

    def _secure(self, request: web.Request, response: web.StreamResponse) -> None:
        host = request.host if request.host.lower() in self._guard.hosts else "127.0.0.1"
        response.headers.update(
            {
                "Content-Security-Policy": POLICY.format(host=host),
                "Referrer-Policy": "no-referrer",
                "X-Content-Type-Options": "nosniff",
                "X-Frame-Options": "DENY",
                "Cache-Control": "no-store",
                "Cross-Origin-Opener-Policy": "same-origin",
                "Cross-Origin-Resource-Policy": "same-origin",
            }
        )

    async def _index(self, request: web.Request) -> web.Response:
        response = web.Response(text=page(self._title, request.host), content_type="text/html")
        if (given := request.query.get("token")) and self._guard.knows(given):
            response.set_cookie(self._guard.cookie, given, httponly=True, samesite="Strict", path="/")
        return response

    async def _style(self, _: web.Request) -> web.Response:
        return web.Response(text=STYLE, content_type="text/css")

    async def _script(self, _: web.Request) -> web.Response:
        return web.Response(text=SCRIPT, content_type="text/javascript")

    async def _socket(self, request: web.Request) -> web.StreamResponse:
        if len(self._sockets) >= SESSIONS:
            return web.Response(status=503, text=f"503: {SESSIONS} browsers have it open; close one\n")
        browser = web.WebSocketResponse(heartbeat=15.0, max_msg_size=MOST_BYTES)
        await browser.prepare(request)
        self._sockets.add(browser)
        session = _Session(
            self._command,
            write_bytes=browser.send_bytes,
            write_str=browser.send_str,
            close=cast("Callable[[], Awaitable[None]]", browser.close),
            download_manager=DownloadManager(),
        )
        try:
            width, height = _size(request.query.get("width"), request.query.get("height"))
            await session.start(width, height)
            async for message in browser:
                if message.type is WSMsgType.TEXT and not await _take(session, browser, message.data):
                    log.warning("a browser sent what is no message", bytes=len(message.data))
        finally:
            self._sockets.discard(browser)
            # The browser may be gone, and with it this task: the terminal UI is ended all the same.
            await asyncio.shield(session.end())
        return browser


def _size(width: Any, height: Any) -> tuple[int, int]:
    """Return columns and lines within what a screen can be; 80 and 24 for what is no number."""
    found: list[int] = []
    for value, plain, most in ((width, 80, 1000), (height, 24, 500)):
        try:
            found.append(min(max(int(value), 2), most))
        except (TypeError, ValueError, OverflowError):
            found.append(plain)
    return found[0], found[1]


async def _take(session: AppService, browser: web.WebSocketResponse, text: str) -> bool:
    """Carry one message of the browser out; whether it was one."""
    try:
        message: Any = json.loads(text)
    except (ValueError, RecursionError):
        return False
    match message:
        case ["stdin", str(typed)]:
            # Half a character is left out: in its place a "?" would be a key.
            await session.send_bytes(typed.encode(errors="ignore"))
        case ["resize", {"width": width, "height": height}]:
            await session.set_terminal_size(*_size(width, height))
        case ["ping", data]:
            await browser.send_json(["pong", data])
        case ["blur", *_]:
            await session.blur()
        case ["focus", *_]:
            await session.focus()
        case _:
            return False
    return True


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
