"""The warm containers of a fleet: `swiftbot pool …`."""

import asyncio

from cyclopts import App

from appliance import console
from appliance.cli.common import HERE, WORK, Json, Where, show
from appliance.client import FleetClient

pool_app = App(name="pool", help="Warm containers: what there is.", group=WORK)


def add_to(app: App) -> None:
    """Add these commands."""
    app.command(pool_app)


@pool_app.default
@pool_app.command(name="list")
def pool_list(*, as_json: Json = False, where: Where = HERE) -> int:
    """Show the warm containers of all gateways."""

    async def go() -> None:
        async with FleetClient(where.endpoint()) as client:
            await client.gateway()
            by_gateway = client.plane.registry.containers
            found = [each for name in sorted(by_gateway) for each in by_gateway[name].values()]
        show(found, as_json=as_json, table=console.container_table(found))

    asyncio.run(go())
    return 0
