"""A terminal UI in a process of its own, drawn into a terminal that only counts, with keys pressed and timed.

Run as `python -m workshop.bench.tui.screen OPTIONS-AS-JSON`; prints its figures as JSON at the end. A key counts as
painted when what it is to change has changed and bytes have gone to the terminal after that.
"""

import asyncio
import gc
import itertools
import math
import sys
import time
from collections.abc import Callable
from typing import Any, ClassVar

import msgspec
import psutil
import structlog
from msgspec import Struct
from rich.text import Text
from textual import events
from textual.app import ComposeResult
from textual.drivers.headless_driver import HeadlessDriver
from textual.widgets import DataTable

from appliance.model import TaskRecord
from appliance.plane.settings import PlaneConfig
from appliance.process import gentle_collector
from appliance.tui import status_styles
from appliance.tui.app import SCREENS, SwiftbotApp
from appliance.tui.base_screen import FleetScreen
from appliance.tui.safe import safe
from appliance.tui.settings import TuiConfig
from appliance.tui.store import Store
from appliance.tui.subscriptions import FleetView
from appliance.tui.widgets.grid import Grid
from workshop.bench.figures import finite, quantile, summary

TITLES = ("task", "state", "first step", "instruction")


def _cells(record: TaskRecord) -> tuple[Text, ...]:
    sign = status_styles.task(record.state)
    first = record.subtasks[0] if record.subtasks else None
    step = f"{first.progress:.0%} {safe(first.note, 40)}" if first is not None else ""
    return Text(safe(record.id, 63), "bold"), Text(sign.text, sign.style), Text(step), Text(safe(record.instruction))


class PlainScreen(FleetScreen):
    """All tasks in a DataTable."""

    scope = "fleet"
    shows = ("tasks",)

    def __init__(self) -> None:
        super().__init__()
        self.table: DataTable[Text] = DataTable(id="plain", cursor_type="row")

    def body(self) -> ComposeResult:
        """Make the table."""
        yield self.table

    def draw_body(self, store: Store) -> None:
        """Set every cell of every task; widths follow the contents, as they do unless one says otherwise."""
        table = self.table
        if not table.columns:
            for title in TITLES:
                table.add_column(title, key=title)
        for name in store.newest:
            cells = _cells(store.tasks[name])
            if name in table.rows:
                for title, cell in zip(TITLES, cells, strict=True):
                    table.update_cell(name, title, cell, update_width=True)
            else:
                table.add_row(*cells, key=name)


class PlainApp(SwiftbotApp):
    """The terminal UI with that table on its first screen."""

    MODES = SCREENS | {"overview": PlainScreen}  # pyright: ignore[reportAssignmentType] - as in the class above

    @property
    def cursor(self) -> int:
        """Row under the cursor."""
        return self.front.table.cursor_row if isinstance(self.front, PlainScreen) else -1


LINES, COLUMNS = 48, 160
_EVERY_S = 0.25
"""Between two keys: a person who looks for something."""
_LONGEST_S = 10.0
_SETTLE_S = 5.0
"""Before anything is measured: all facts are there, caches are filled."""


class Look(Struct, frozen=True, kw_only=True):
    """Which UI looks at which fleet, for how long."""

    fleet: str
    connect: str
    seconds: float
    plain: bool = False
    tasks: int = 1000


class Terminal(HeadlessDriver):
    """A terminal that takes everything and counts it."""

    written = 0
    watches: ClassVar[list[Callable[[], None]]] = []
    """Told whenever something was written."""

    @property
    def is_headless(self) -> bool:
        """Return False: it is to be drawn as into a real one."""
        return False

    def write(self, data: str) -> None:
        """Count what is written."""
        Terminal.written += len(data)
        for watch in Terminal.watches:
            watch()


async def _press(app: SwiftbotApp, key: str, done: Callable[[], bool]) -> float | None:
    """Press a key; return how long it took until what it does was painted, milliseconds."""
    painted = asyncio.Event()

    def look() -> None:
        if done():
            painted.set()

    Terminal.watches = [look]
    began = time.monotonic()
    app.post_message(events.Key(key, key if len(key) == 1 else None))
    try:
        async with asyncio.timeout(_LONGEST_S):
            await painted.wait()
    except TimeoutError:
        return None
    finally:
        Terminal.watches = []
    return 1e3 * (time.monotonic() - began)


def _cursor(app: SwiftbotApp) -> object:
    if isinstance(app, PlainApp):
        return app.cursor
    grids = list(app.screen.query(Grid).results(Grid))
    return grids[0].selected if grids else None


def _times(found: list[float]) -> dict[str, Any]:
    """Return a summary with the 95th percentile, which the target is set for."""
    return summary(found) | {"p95": finite(quantile(sorted(found), 0.95)) if found else None}


async def _keys(app: SwiftbotApp, look: Look) -> dict[str, list[float]]:
    """Walk through the tables for the time that is set; return times by key, endless for those without effect."""
    found: dict[str, list[float]] = {}
    until = time.monotonic() + look.seconds
    walk = ["down", "down", "pagedown", "up", "down", "pageup"]
    script = itertools.cycle(walk if look.plain else ["0", "2", *walk, "3", *walk, "1", *walk, "4", *walk])
    for key in script:
        if time.monotonic() > until:
            break
        mode = {"0": "overview", "1": "fleet", "2": "tasks", "3": "robots", "4": "pool"}.get(key, "")
        if mode and app.current_mode == mode:
            continue
        before = _cursor(app)

        def done(mode: str = mode, before: object = before) -> bool:
            return app.current_mode == mode if mode else _cursor(app) != before

        took = await _press(app, key, done)
        found.setdefault("screen" if key.isdigit() else "cursor", []).append(math.inf if took is None else took)
        await asyncio.sleep(_EVERY_S)
    return found


def resident(samples: list[list[float]]) -> dict[str, float | None]:
    """Return how much memory was resident at the start, at the end and at most, and how fast it grew.

    Args:
        samples: pairs of seconds and MB, in order.

    Returns:
        `start`, `end` and `most` in MB; `mb_per_min`, the slope of the line of least squares through all samples, and
        through those of the second half, when caches are filled; None where there are too few.
    """
    return {
        "start": samples[0][1] if samples else None,
        "end": samples[-1][1] if samples else None,
        "most": max((mb for _, mb in samples), default=None),
        "mb_per_min": _slope(samples),
        "mb_per_min_second_half": _slope(samples[len(samples) // 2 :]),
    }


def _slope(samples: list[list[float]]) -> float | None:
    """Return the slope of the line of least squares, a minute; None when all are of one moment."""
    if not samples:
        return None
    middle_s, middle_mb = (sum(each[index] for each in samples) / len(samples) for index in (0, 1))
    spread = sum((at_s - middle_s) ** 2 for at_s, _ in samples)
    if not spread:
        return None
    return round(60 * sum((at_s - middle_s) * (mb - middle_mb) for at_s, mb in samples) / spread, 2)


async def _memory(every_s: float, found: list[list[float]]) -> None:
    process, began = psutil.Process(), time.monotonic()
    while True:
        found.append([round(time.monotonic() - began, 1), round(process.memory_info().rss / 2**20, 1)])
        await asyncio.sleep(every_s)


async def watch(look: Look) -> dict[str, Any]:
    """Run the UI and measure it."""
    config = TuiConfig(tasks=2 * look.tasks)
    view = FleetView(PlaneConfig(mode="client", connect=(look.connect,)), look.fleet, config)
    structlog.configure(processors=[structlog.processors.add_log_level, view.take_own_log])
    kind = PlainApp if look.plain else SwiftbotApp
    app = kind(view, config)
    app.driver_class = Terminal
    running = asyncio.create_task(app.run_async(size=(COLUMNS, LINES)))
    until = time.monotonic() + 60
    while len(view.store.tasks) < look.tasks and time.monotonic() < until and not running.done():  # noqa: ASYNC110
        await asyncio.sleep(0.1)
    await asyncio.sleep(_SETTLE_S)
    if running.done():
        await running
    gc.collect()
    process = psutil.Process()
    memory: list[list[float]] = []
    measuring = asyncio.create_task(_memory(max(0.5, look.seconds / 60), memory))
    times_before, began, written = process.cpu_times(), time.monotonic(), Terminal.written
    revisions = sum(view.store.revisions(("gateways", "robots", "tasks", "containers", "entries")))
    found = await _keys(app, look)
    elapsed, times = time.monotonic() - began, process.cpu_times()
    measuring.cancel()
    cpu_s = times.user + times.system - times_before.user - times_before.system
    changes = sum(view.store.revisions(("gateways", "robots", "tasks", "containers", "entries"))) - revisions
    every = [took for each in found.values() for took in each]
    app.exit()
    await running
    return {
        "key_to_paint_ms": _times(every),
        "by_key_ms": {name: _times(each) for name, each in found.items()},
        "keys_without_effect": every.count(math.inf),
        "cpu_share_of_a_core": round(cpu_s / elapsed, 3),
        "changes_taken_per_s": round(changes / elapsed),
        "terminal_kb_per_s": round((Terminal.written - written) / 1024 / elapsed, 1),
        "memory_mb": memory,
        "resident_mb": resident(memory),
        "known": {kind: len(getattr(view.store, kind)) for kind in ("gateways", "robots", "tasks", "containers")},
    }


if __name__ == "__main__":
    with gentle_collector():
        print(msgspec.json.encode(asyncio.run(watch(msgspec.json.decode(sys.argv[1], type=Look)))).decode())
