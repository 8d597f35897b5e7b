"""The terminal UI in a real browser: who is let in, what is seen, and that mouse and keys steer a real fleet."""

import asyncio
import io
import json
import os
import signal
import sys
from collections.abc import AsyncIterator
from pathlib import Path

import chromium
import pytest
from fleets import INTERRUPTIBLE, fleet_in
from PIL import Image

from appliance.client import FleetClient
from appliance.connection import FleetState

pytestmark = [pytest.mark.anyio, pytest.mark.podman]


@pytest.fixture
def browser() -> str:
    """Return the browser, or say why there is none, before anything else is started."""
    return chromium.required()


@pytest.fixture
async def small(browser: str, tmp_path: Path) -> AsyncIterator[FleetState]:
    """One gateway, a recorder and a rover, each a process of its own."""
    async with fleet_in(tmp_path, gateways=1, zenoh=1) as state:
        yield state


@pytest.fixture
async def address(small: FleetState, tmp_path: Path) -> AsyncIterator[str]:
    """Serve its terminal UI as an operator does; the address that is printed."""
    environment = os.environ | {"XDG_STATE_HOME": str(tmp_path), "XDG_CONFIG_HOME": str(tmp_path)}
    connect = [word for each in small.endpoints for word in ("--connect", each)]
    process = await asyncio.create_subprocess_exec(
        *INTERRUPTIBLE, sys.executable, "-m", "appliance.cli", "tui", "--serve", "--fleet", small.fleet, *connect,
        stdout=asyncio.subprocess.PIPE, env=environment,
    )  # fmt: skip
    assert process.stdout is not None
    try:
        async with asyncio.timeout(60):
            yield (await process.stdout.readline()).decode().strip()
    finally:
        process.send_signal(signal.SIGINT)
        async with asyncio.timeout(30):
            await process.communicate()


def colours(png: bytes) -> int:
    """Return how many colours a picture has."""
    found = Image.open(io.BytesIO(png)).convert("RGB").getcolors(2**24)
    assert found is not None
    return len(found)


@pytest.mark.timeout(240)
async def test_seen_clicked_and_stopped_in_a_browser(small: FleetState, address: str, tmp_path: Path) -> None:
    """Without the token 403; with it the UI, a click on a screen's name shows that screen, and F8 stops the fleet."""
    base, _, token = address.partition("?token=")
    async with chromium.page(tmp_path) as page, FleetClient(small.endpoint) as client:
        assert await page.open(base) == 403
        assert "token" in await page.value("document.body.innerText")
        assert page.received == b""

        assert await page.open(address) == 200
        await page.gets("SwiftBot", "gw-1", "[R] read-only")
        assert await page.value("location.search") == "", "the token stays in the address bar"
        assert token not in await page.value("document.cookie"), "scripts can read the token"
        assert await page.value("document.body.classList.contains('-first-byte')")
        before = await page.picture()
        assert colours(before) > 50, "nothing but the ground is to be seen"

        # "Robots" in the second line, by the measures of the terminal: cells, and the box they are in.
        heard = len(page.received)
        sizes = [said[1] for each in page.sent if (said := json.loads(each))[0] == "resize"]
        left, top, width, height = await page.value(
            "(() => { const box = document.querySelector('.xterm-screen').getBoundingClientRect();"
            " return [box.left, box.top, box.width, box.height]; })()"
        )
        cell, line = width / sizes[-1]["width"], height / sizes[-1]["height"]
        await page.click(left + 33.5 * cell, top + 1.5 * line)
        await page.gets("N↑", "rover_1", after=heard)
        after = await page.picture()
        assert after != before
        assert colours(after) > 50

        # The terminal has the keys without a click of its own, and a stop needs no unlocking.
        await page.key("F8", 119)
        async with asyncio.timeout(chromium.ANSWER_S):
            while not (await client.standing()).active:
                await asyncio.sleep(0.2)
        (stop,) = (await client.standing()).active
        assert stop.robots == ()
        await page.gets("stopped", after=heard)
        (tmp_path / "browser.png").write_bytes(await page.picture())
