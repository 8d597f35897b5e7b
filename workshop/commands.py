"""The commands that the workshop adds to `swiftbot`."""

from cyclopts import App

from workshop.cli import bench, dry_run, fleet, sim, train


def add_to(app: App) -> None:
    """Add `up`, `down`, `demo`, `task simulate`, `sim`, `bench` and `train`."""
    for part in (fleet, dry_run, sim, bench, train):
        part.add_to(app)
