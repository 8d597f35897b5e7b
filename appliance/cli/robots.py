"""Robots: `swiftbot robots …`."""

import asyncio
import sys
from pathlib import Path

from cyclopts import App

from appliance import console
from appliance.cli.common import HERE, WORK, Json, Where, show
from appliance.client import FleetClient
from appliance.errors import ConfigError

robots_app = App(name="robots", help="Robots: who there is, and buttons for ground stations.", group=WORK)


def add_to(app: App) -> None:
    """Add these commands."""
    app.command(robots_app)


@robots_app.default
@robots_app.command(name="list")
def robots_list(*, as_json: Json = False, where: Where = HERE) -> int:
    """Show the robots."""

    async def go() -> None:
        async with FleetClient(where.endpoint()) as client:
            await client.gateway()
            found = sorted(client.plane.registry.robots.values(), key=lambda each: each.id)
        show(found, as_json=as_json, table=console.robot_table(found))

    asyncio.run(go())
    return 0


@robots_app.command(name="qgc-actions")
def robots_qgc_actions(*, config: Path, out: Path | None = None) -> int:
    """Write QGroundControl's custom actions file: a button for each task template of a gateway.

    Args:
        config: The gateway's TOML file, whose robots.templates are meant.
        out: File to write, for QGroundControl's CustomActions folder; printed when not given.
    """
    from appliance import config as configuration
    from appliance.robots.qgc import actions

    robots = configuration.load(config).robots
    if not robots.templates:
        raise ConfigError(f"{config} has no robots.templates", remedy="see docs/operations.md, Tasks by MAVLink")
    data = actions(robots.templates, component=robots.component_id)
    if out is None:
        sys.stdout.write(data.decode())
        return 0
    try:
        out.write_bytes(data)
    except OSError as error:
        raise ConfigError(f"{out} cannot be written: {error.strerror}", remedy="name another file") from error
    console.out.print(f"{out}: {len(robots.templates)} tasks", markup=False)
    return 0
