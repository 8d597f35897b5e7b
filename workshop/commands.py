"""The commands that the workshop adds to `swiftbot`."""

from cyclopts import App

from workshop.cli import bench, fleet, sim, train


def add_to(app: App) -> None:
    """Add `up`, `down`, `demo`, `sim`, `bench` and `train`."""
    for part in (fleet, sim, bench, train):
        part.add_to(app)
