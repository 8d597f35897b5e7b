"""Runs the terminal UI: in a terminal until the person leaves, or without one for a picture of it."""

from functools import partial
from pathlib import Path

import structlog

from appliance.collector import gentle_collector
from appliance.model.open_enum import enums_open
from appliance.plane.settings import PlaneConfig
from appliance.tui.app import SwiftbotApp
from appliance.tui.data import FleetView, View, take_own_log
from appliance.tui.plans.history import History, default_file
from appliance.tui.replay.source import ReplayView
from appliance.tui.settings import TuiConfig


async def export_picture(
    view: View, path: Path, *, keys: tuple[str, ...] = ("2",), size: tuple[int, int] = (100, 30)
) -> None:
    """Run the terminal UI without a terminal on `view`, press `keys`, write its picture to `path` as SVG.

    Args:
        view: What is shown.
        path: SVG file to write.
        keys: Keys pressed first, in Textual's names.
        size: Columns and lines.
    """
    app = SwiftbotApp(view)
    async with app.run_test(size=size) as pilot:
        await pilot.pause()
        await pilot.press(*keys)
        await pilot.pause(0.5)
        app.draw(force=True)
        await pilot.pause()
        app.export_svg(path)


async def run_tui(
    plane_config: PlaneConfig, fleet: str, config: TuiConfig | None = None, *, replay: Path | None = None
) -> None:
    """Run the terminal UI on a fleet, or on a recorded log, until the person leaves (`swiftbot tui`).

    Log lines of this process go to its log screen meanwhile: on the terminal they would spoil the picture.

    Raises:
        ConfigError: a setting cannot work.
        NotFoundError, RecordError: the recorded log cannot be read.
    """
    config = config or TuiConfig()
    config.check()
    view = FleetView(plane_config, fleet, config) if replay is None else await ReplayView.open(replay, config)
    app = SwiftbotApp(view, config, history=History(default_file()))
    before = structlog.get_config()
    structlog.configure(
        processors=[structlog.processors.add_log_level, partial(take_own_log, view.store)],
        cache_logger_on_first_use=False,
    )
    try:
        with enums_open(), gentle_collector():
            await app.run_async()
    finally:
        structlog.configure(**before)
