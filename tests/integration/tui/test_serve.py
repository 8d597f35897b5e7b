"""The terminal UI in a browser: who is let in, and that what comes over the WebSocket is the terminal UI itself."""

import asyncio
import contextlib
import os
import signal
import sys
from collections.abc import AsyncIterator
from pathlib import Path

import aiohttp
import psutil
import pytest
from fleets import INTERRUPTIBLE

from appliance.errors import ConfigError
from appliance.tui.serve import SESSIONS, BrowserServer, Guard, listen

pytestmark = pytest.mark.anyio

TOKEN = "token-of-this-test-alone"  # noqa: S105 - as its name says
NOWHERE = "tcp/127.0.0.1:1"


class Served:
    """A server with what a browser needs to know of it."""

    def __init__(self, server: BrowserServer, port: int) -> None:
        self.server = server
        self.port = port
        self.origin = f"http://127.0.0.1:{port}"
        self.cookie = {"Cookie": f"swiftbot-{port}={TOKEN}"}
        self.own = self.cookie | {"Origin": self.origin}

    async def get(self, path: str, **headers: str) -> tuple[int, str, dict[str, str]]:
        """Ask for a page; status, text and headers."""
        async with aiohttp.ClientSession() as session, session.get(self.origin + path, headers=headers) as answer:
            return answer.status, await answer.text(), dict(answer.headers)


@pytest.fixture
async def served(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Served]:
    """Serve a terminal UI that finds no fleet: what it shows then is enough here."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    listening = listen(0)
    port = listening.getsockname()[1]
    command = [sys.executable, "-m", "appliance.cli", "tui", "--fleet", "nobody", "--connect", NOWHERE]
    server = BrowserServer(command, Guard(TOKEN, port), title="SwiftBot · nobody")
    await server.start(listening)
    try:
        yield Served(server, port)
    finally:
        await server.close()


def children() -> list[psutil.Process]:
    """Return the terminal UIs that run for this process."""
    found: list[psutil.Process] = []
    for each in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.NoSuchProcess):  # also: a zombie, which is waited for a moment later
            if "appliance.cli" in " ".join(each.cmdline()):
                found.append(each)
    return found


async def shown(socket: aiohttp.ClientWebSocketResponse, *wanted: str) -> bytes:
    """Read what comes until all texts have come."""
    data = b""
    async with asyncio.timeout(60):
        while not all(each.encode() in data for each in wanted):
            message = await socket.receive()
            assert message.type in (aiohttp.WSMsgType.BINARY, aiohttp.WSMsgType.TEXT), message
            if message.type is aiohttp.WSMsgType.BINARY:
                data += message.data
    return data


async def no_children() -> None:
    """Wait until no terminal UI runs any more."""
    async with asyncio.timeout(30):
        while children():
            await asyncio.sleep(0.1)


async def test_nothing_without_the_token(served: Served) -> None:
    """Page, files and socket are refused without a token, or from elsewhere; nothing is started."""
    for path in ("/", "/static/js/textual.js", "/page.js", "/ws", "/nothing", "/?token=wrong-token-of-length"):
        status, text, headers = await served.get(path)
        assert status == 403, path
        assert TOKEN not in text
        assert headers["Cache-Control"] == "no-store"
    status, text, _ = await served.get("/", Host="evil.example", **served.cookie)
    assert status == 403
    assert "own name" in text
    async with aiohttp.ClientSession() as session:
        for headers in (served.cookie, served.cookie | {"Origin": "http://evil.example"}, {"Origin": served.origin}):
            with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
                await session.ws_connect(f"{served.origin}/ws", headers=headers)
            assert refused.value.status == 403
    assert children() == []


async def test_page_gives_the_cookie(served: Served) -> None:
    """The printed address opens the page, which loads from this server alone and gets the token as a cookie."""
    status, text, headers = await served.get(f"/?token={TOKEN}")
    assert status == 200
    assert TOKEN not in text
    assert f"ws://127.0.0.1:{served.port}/ws" in text
    for expected in ("HttpOnly", "SameSite=Strict", TOKEN):
        assert expected in headers["Set-Cookie"]
    assert headers["Content-Security-Policy"].startswith("default-src 'none'")
    assert headers["Referrer-Policy"] == "no-referrer"
    for path in ("/page.css", "/page.js", "/static/js/textual.js", "/static/css/xterm.css"):
        assert (await served.get(path, **served.cookie))[0] == 200
    # A browser sends the cookie of an earlier server on this port along; an address of that one is opened again.
    name = next(iter(served.cookie.values())).partition("=")[0]
    assert (await served.get(f"/?token={TOKEN}", Cookie=f"{name}=an-older-token-of-this-port"))[0] == 200
    status, _, headers = await served.get("/?token=an-older-token-of-this-port", **served.cookie)
    assert (status, headers.get("Set-Cookie")) == (200, None)
    for path in ("/static/", "/static/../server.py", "/static/%2e%2e/server.py", "/nothing"):
        assert (await served.get(path, **served.cookie))[0] in (403, 404), path


@pytest.mark.timeout(180)
async def test_keys_in_and_screen_out(served: Served) -> None:
    """What a browser gets is the terminal UI, which obeys keys and the window's size, and ends with the connection."""
    async with aiohttp.ClientSession() as session:
        url = f"{served.origin}/ws?width=100&height=30"
        async with session.ws_connect(url, headers=served.own) as socket:
            await shown(socket, "SwiftBot", "read-only")
            assert served.server.sessions == 1
            await socket.send_json(["resize", {"width": 120, "height": 40}])
            await socket.send_json(["stdin", "2"])
            await shown(socket, "no tasks yet")
            await socket.send_json(["ping", 7])
            async with asyncio.timeout(30):
                while (message := await socket.receive()).type is not aiohttp.WSMsgType.TEXT:
                    pass
            assert message.json() == ["pong", 7]
        await no_children()
        assert served.server.sessions == 0
        # Leaving by `q` ends the connection as well.
        async with session.ws_connect(url, headers=served.own) as socket:
            await shown(socket, "SwiftBot")
            await socket.send_json(["stdin", "q"])
            async with asyncio.timeout(30):
                while not socket.closed:
                    await socket.receive()
        await no_children()


@pytest.mark.timeout(180)
async def test_what_is_no_message_does_no_harm(served: Served) -> None:
    """Messages that are none are left out, one that is too large ends its connection; sizes are within bounds."""
    async with aiohttp.ClientSession() as session:
        async with session.ws_connect(f"{served.origin}/ws?width=x&height=-5", headers=served.own) as socket:
            await shown(socket, "wiftBot")
            for text in (
                "",
                "{",
                "[]",
                "null",
                '["stdin"]',
                '["stdin", 5]',
                '["resize", {}]',
                '["nothing", 1]',
                "[" * 9000,
            ):
                await socket.send_str(text)
            await socket.send_json(["resize", {"width": 10**9, "height": "x"}])
            await socket.send_bytes(b"\xff\xfe")
            await socket.send_json(["resize", {"width": 80, "height": 24}])
            await socket.send_json(["stdin", "\ud83d\x00"])
            await socket.send_json(["stdin", "2"])
            await shown(socket, "no tasks yet")
        async with session.ws_connect(f"{served.origin}/ws", headers=served.own) as socket:
            await shown(socket, "SwiftBot")
            await socket.send_json(["stdin", "x" * 200_000])
            async with asyncio.timeout(30):
                while not socket.closed:
                    await socket.receive()
        await no_children()


async def test_sessions_are_bounded(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    """When so many browsers have it open, the next one sees that."""
    monkeypatch.setattr("appliance.tui.serve.SESSIONS", 0)
    status, text, _ = await served.get("/ws", **served.own)
    assert (status, SESSIONS) == (503, 8)
    assert "close one" in text


async def test_port_in_use_is_told(served: Served) -> None:
    """A port that somebody listens on is refused with a remedy."""
    with pytest.raises(ConfigError, match="cannot be listened on") as caught:
        listen(served.port)
    assert "--port" in caught.value.remedy


@pytest.mark.timeout(120)
async def test_command_prints_the_address(tmp_path: Path) -> None:
    """`swiftbot tui --serve` prints an address that works, with a token of its own, and ends at Ctrl-C."""
    environment = os.environ | {"XDG_STATE_HOME": str(tmp_path), "XDG_CONFIG_HOME": str(tmp_path)}
    process = await asyncio.create_subprocess_exec(
        *INTERRUPTIBLE, sys.executable, "-m", "appliance.cli", "tui", "--serve", "--fleet", "nobody",
        "--connect", NOWHERE,
        stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE, env=environment,
    )  # fmt: skip
    assert process.stdout is not None
    try:
        async with asyncio.timeout(60):
            address = (await process.stdout.readline()).decode().strip()
        base, _, token = address.partition("/?token=")
        assert base.startswith("http://127.0.0.1:")
        assert len(token) >= 32
        async with aiohttp.ClientSession() as session:
            async with session.get(address) as answer:
                assert answer.status == 200
            async with session.get(base) as answer:
                assert answer.status == 403
    finally:
        process.send_signal(signal.SIGINT)
        async with asyncio.timeout(30):
            await process.communicate()
    assert process.returncode == 0
