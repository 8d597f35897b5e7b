"""The terminal UI on a large busy fleet: how long from key to paint, how much of a core, whether memory stays flat.

Each UI looks at a fleet of its own, one after the other, so that neither pays for the other.
"""

import asyncio
import os
import sys
from collections.abc import Callable
from typing import Any

import msgspec

from appliance.errors import SwiftbotError
from appliance.ports import free_port
from workshop.bench.pooled import fleet_name
from workshop.bench.tui.feed import Size
from workshop.bench.tui.screen import COLUMNS, LINES, Look

Progress = Callable[[str], None]

_LONGEST_S = 120.0
"""Beyond the time that is measured: imports, linking, the first facts."""


async def run(
    *, seconds: float, gateways: int, robots: int, tasks: int, rate: int, plain: bool, progress: Progress
) -> dict[str, Any]:
    """Measure.

    Args:
        seconds: for how long each UI is measured.
        gateways: of the fleet.
        robots: of the fleet.
        tasks: of the fleet.
        rate: updates a second that are put.
        plain: whether the plain table is measured beside.
        progress: told how far it is.
    """
    result: dict[str, Any] = {
        "fleet": {"gateways": gateways, "robots": robots, "tasks": tasks, "updates_per_s": rate},
        "terminal": f"{COLUMNS}x{LINES}",
        "cores": os.cpu_count(),
        "seconds": seconds,
        "targets": {"key_to_paint_p95_ms": 100, "cpu_share_of_a_core": 0.6},
    }
    for name in ("ui", "plain_table") if plain else ("ui",):
        progress(f"{name}: {seconds:.0f} s at {rate} updates/s")
        size = Size(
            fleet=fleet_name(), listen=f"tcp/127.0.0.1:{free_port()}", gateways=gateways, robots=robots, tasks=tasks,
            rate=rate,
        )  # fmt: skip
        result[name] = await _one(size, seconds, plain=name == "plain_table")
    return result


async def _one(size: Size, seconds: float, *, plain: bool) -> dict[str, Any]:
    look = Look(fleet=size.fleet, connect=size.listen, seconds=seconds, plain=plain, tasks=size.tasks)
    feed = await _start("feed", size)
    screen: asyncio.subprocess.Process | None = None
    try:
        async with asyncio.timeout(seconds + _LONGEST_S):
            await _line(feed, "feed")
            screen = await _start("screen", look)
            measured: dict[str, Any] = msgspec.json.decode(await _line(screen, "screen"))
            await screen.wait()
            feed.stdin.close() if feed.stdin is not None else None
            put: dict[str, Any] = msgspec.json.decode(await _line(feed, "feed"))
            await feed.wait()
    finally:
        for process in (feed, screen):
            if process is not None and process.returncode is None:
                process.kill()
                await process.wait()
    return {"updates_put_per_s": round(put["put"] / put["seconds"])} | measured


async def _start(module: str, options: msgspec.Struct) -> asyncio.subprocess.Process:
    return await asyncio.create_subprocess_exec(
        sys.executable, "-m", f"workshop.bench.tui.{module}", msgspec.json.encode(options).decode(),
        stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE, limit=2**24,
        env=os.environ | {"TERM": "xterm-256color", "COLORTERM": "truecolor"},
    )  # fmt: skip


async def _line(process: asyncio.subprocess.Process, name: str) -> bytes:
    assert process.stdout is not None  # noqa: S101 - asked for above
    while line := await process.stdout.readline():
        if line.startswith((b"{", b"ready")):
            return line
    raise SwiftbotError(f"the process {name} of the measurement ended early", remedy="its error stands above")
