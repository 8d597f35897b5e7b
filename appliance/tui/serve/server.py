"""Serves the terminal UI to browsers on this machine: a page, its files, and a WebSocket to a terminal UI of its own.

What `textual-serve` has for it is used: the script of the page, and the service that runs a Textual program without a
terminal. Its own server is not, since it lets everybody in and has the page load a font from elsewhere.
"""

import asyncio
import contextlib
import json
import shlex
import socket
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path
from typing import Any, cast

import structlog
import textual_serve
from aiohttp import WSCloseCode, WSMsgType, web
from textual_serve.app_service import AppService
from textual_serve.download_manager import DownloadManager

from appliance.errors import ConfigError
from appliance.tui.serve.guard import Guard
from appliance.tui.serve.page import POLICY, SCRIPT, STYLE, page

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
