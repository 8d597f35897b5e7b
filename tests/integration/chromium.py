"""A real browser for tests: Chromium without a window, driven by its DevTools protocol over a WebSocket.

Protocol: https://chromedevtools.github.io/devtools-protocol/, domains Page, Network, Runtime, Input.
"""

import asyncio
import base64
import itertools
import os
import shutil
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import aiohttp
import pytest

ANSWER_S = 60.0
"""The machine may be busy."""


def required() -> str:
    """Return the browser's path. Without one the test is skipped with the reason, and fails where CI should have it."""
    found = shutil.which(os.environ.get("SWIFTBOT_CHROMIUM", "chromium"))
    if found is None:
        reason = "no chromium here: scripts/setup.sh dev --with-browser, as in `make test`, brings it (300 MB)"
        if os.environ.get("CI"):
            pytest.fail(reason)
        pytest.skip(reason)
    return found


class Page:
    """A page of the browser.

    Args:
        socket: connected to the page's target.
    """

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self.received = b""
        """All that WebSockets of the page have got from their servers."""
        self.sent: list[str] = []
        """Texts that they have sent."""
        self._socket = socket
        self._numbers = itertools.count(1)
        self._waiting: dict[int, asyncio.Future[dict[str, Any]]] = {}
        self._reading = asyncio.create_task(self._read())

    async def _read(self) -> None:
        async for message in self._socket:
            said: dict[str, Any] = message.json()
            waiting = self._waiting.pop(said.get("id", 0), None)
            if waiting is not None and not waiting.done():
                waiting.set_result(said)
            if said.get("method") == "Network.webSocketFrameReceived":
                frame = said["params"]["response"]
                data: str = frame["payloadData"]
                self.received += data.encode() if frame["opcode"] == 1 else base64.b64decode(data)
            elif said.get("method") == "Network.webSocketFrameSent":
                self.sent.append(said["params"]["response"]["payloadData"])

    async def ask(self, method: str, **arguments: Any) -> dict[str, Any]:
        """Call a method of the protocol; its result. Fails with what the browser says against it."""
        number = next(self._numbers)
        answer = self._waiting[number] = asyncio.get_running_loop().create_future()
        await self._socket.send_json({"id": number, "method": method, "params": arguments})
        async with asyncio.timeout(ANSWER_S):
            said = await answer
        assert "error" not in said, (method, said["error"])
        return dict(said["result"])

    async def value(self, expression: str) -> Any:
        """Return what a JavaScript expression is."""
        said = await self.ask("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in said, said
        return said["result"].get("value")

    async def open(self, address: str) -> int:
        """Go to an address; its status, once the page has been read."""
        await self.ask("Page.navigate", url=address)
        await self.until(lambda: self.value(f"location.href.startsWith({address.partition('?')[0]!r})"))
        await self.until(lambda: self.value("document.readyState === 'complete'"))
        return int(await self.value("performance.getEntriesByType('navigation')[0].responseStatus"))

    async def until(self, holds: Callable[[], Any]) -> None:
        """Wait until something holds (a function, or one that is to be awaited)."""
        async with asyncio.timeout(ANSWER_S):
            while True:
                said = holds()
                if await said if asyncio.iscoroutine(said) else said:
                    return
                await asyncio.sleep(0.1)

    async def gets(self, *texts: str, after: int = 0) -> None:
        """Wait until its WebSocket has got all these texts, beyond so many bytes."""
        await self.until(lambda: all(each.encode() in self.received[after:] for each in texts))

    async def click(self, x: float, y: float) -> None:
        """Press and release the left button, in CSS pixels."""
        for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
            held = {} if kind == "mouseMoved" else {"button": "left", "clickCount": 1}
            await self.ask("Input.dispatchMouseEvent", type=kind, x=x, y=y, **held)

    async def key(self, name: str, code: int) -> None:
        """Press and release a key by its name, such as F8, and its code on Windows."""
        for kind in ("rawKeyDown", "keyUp"):
            await self.ask("Input.dispatchKeyEvent", type=kind, key=name, code=name, windowsVirtualKeyCode=code)

    async def picture(self) -> bytes:
        """Return the page as PNG."""
        return base64.b64decode((await self.ask("Page.captureScreenshot", format="png"))["data"])

    async def close(self) -> None:
        """Listen no more."""
        self._reading.cancel()
        await self._socket.close()


@asynccontextmanager
async def page(folder: Path) -> AsyncIterator[Page]:
    """Run a browser with a profile of its own in a folder; a page of it, with nothing in it."""
    profile = folder / "profile"
    with (folder / "chromium.log").open("wb") as log:
        process = await asyncio.create_subprocess_exec(
            required(), "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run",
            "--disable-background-networking", "--disable-component-update", "--remote-debugging-port=0",
            f"--user-data-dir={profile}", "--window-size=1280,900", "about:blank",
            stdin=asyncio.subprocess.DEVNULL, stdout=log, stderr=log, env=os.environ | {"HOME": str(folder)},
        )  # fmt: skip
    try:
        port = profile / "DevToolsActivePort"
        async with asyncio.timeout(ANSWER_S):
            while not (port.exists() and port.read_text().strip()):
                assert process.returncode is None, (folder / "chromium.log").read_text()[-2000:]
                await asyncio.sleep(0.1)
        where = f"http://127.0.0.1:{port.read_text().splitlines()[0]}/json/list"
        async with aiohttp.ClientSession() as session:
            async with session.get(where) as answer:
                (target,) = [each for each in await answer.json(content_type=None) if each["type"] == "page"]
            async with session.ws_connect(target["webSocketDebuggerUrl"], max_msg_size=2**26) as socket:
                it = Page(socket)
                try:
                    for domain in ("Page", "Network", "Runtime"):
                        await it.ask(f"{domain}.enable")
                    yield it
                finally:
                    await it.close()
    finally:
        if process.returncode is None:
            process.terminate()
        try:
            async with asyncio.timeout(ANSWER_S):
                await process.wait()
        except TimeoutError:
            process.kill()
            await process.wait()
