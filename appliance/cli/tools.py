"""Logs, images, checks: `swiftbot log …`, `images …`, `doctor`."""

import asyncio
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from appliance import console
from appliance.cli.common import TOOLS, Json, show

log_app = App(name="log", help="Look into MCAP logs and replay them.", group=TOOLS)
images_app = App(name="images", help="Images that skills run in.", group=TOOLS)


def add_to(app: App) -> None:
    """Add these commands."""
    app.command(log_app)
    app.command(images_app)
    app.command(doctor, group=TOOLS)


@log_app.command(name="info")
def log_info(path: Path, *, as_json: Json = False) -> int:
    """Say what an MCAP log holds, also one that was cut off."""
    from appliance.record.reader import info

    found = info(path)
    show(found, as_json=as_json, table=console.log_summary(found))
    return 0


@log_app.command(name="replay")
def log_replay(path: Path, *, as_json: Json = False) -> int:
    """Fold a log's transitions through the task state machine and compare the end states; 1 when they differ."""
    from appliance.tasks.replay import replay

    report = replay(path)
    show(report, as_json=as_json, table=console.replay_summary(report))
    return 0 if report.same else 1


@images_app.command(name="build")
def images_build(names: tuple[str, ...] = (), *, force: Annotated[bool, Parameter(negative="")] = False) -> int:
    """Build the images that skills run in, from Debian packages; those that are there already are kept.

    Args:
        names: Which; all when none is given.
        force: Build even if present.
    """
    from appliance.pool.images import build
    from appliance.skills.catalogue import load_catalogue

    catalogue = load_catalogue()

    async def go() -> None:
        for name in names or tuple(catalogue.images):
            reference = await build(name, catalogue, progress=console.err.print, force=force)
            console.out.print(reference)

    asyncio.run(go())
    return 0


@images_app.command(name="list")
def images_list(*, as_json: Json = False) -> int:
    """List the images of the catalogue and whether they are built."""
    from appliance.pool.images import list_images
    from appliance.skills.catalogue import load_catalogue

    found = asyncio.run(list_images(load_catalogue()))
    show(found, as_json=as_json, table=console.image_table(found))
    return 0


def doctor(*, config: Path | None = None, as_json: Json = False) -> int:
    """Check everything this machine must have; names the remedy for each check that fails.

    Args:
        config: A gateway's TOML file, to check its ports and folders too.
    """
    from appliance import config as configuration
    from appliance.doctor import run_checks

    loaded = configuration.load(config) if config else None
    checks = asyncio.run(run_checks(loaded))
    show(checks, as_json=as_json, table=console.check_table(checks))
    return 0 if all(check.ok or not check.required for check in checks) else 5
