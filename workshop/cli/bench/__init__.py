"""Measurements: `swiftbot bench …`."""

from cyclopts import App

from workshop.cli.bench import faults, plane, pools, robots, screens, work
from workshop.cli.bench.common import bench_app

__all__ = ["add_to", "faults", "plane", "pools", "robots", "screens", "work"]


def add_to(app: App) -> None:
    """Add these commands."""
    app.command(bench_app)
