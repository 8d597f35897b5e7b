"""Measurements: `swiftbot bench …`."""

from cyclopts import App

from workshop.cli.bench import learning, paper, plane, pools, robots, work
from workshop.cli.bench.common import bench_app

__all__ = ["add_to", "learning", "paper", "plane", "pools", "robots", "work"]


def add_to(app: App) -> None:
    """Add these commands."""
    app.command(bench_app)
