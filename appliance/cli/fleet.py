"""Gateways of a fleet: `swiftbot fleet`, `drain`. `uncordon` is made from the registry of operations."""

import asyncio
from typing import Annotated

from cyclopts import App, Parameter

from appliance import console
from appliance.cli.common import HERE, WORK, Json, Where, Why, fields, show
from appliance.client import FleetClient
from appliance.errors import Exit, SwiftbotError
from appliance.model import GatewayStatus
from appliance.model.alerts import Alert
from appliance.operations import drain_text

LOOK_S = 0.5


def add_to(app: App) -> None:
    """Add these commands."""
    for command in (fleet, drain):
        app.command(command, group=WORK)


async def fleet(*, as_json: Json = False, where: Where = HERE) -> int:
    """Show the gateways, also lost ones, and problems of the recorders. Exit code 1: a gateway is lost, or may be."""
    async with where.client() as client:
        await client.gateway()
        found = sorted(client.plane.registry.gateways.values(), key=lambda gateway: gateway.id)
        alerts, unsure = await _alerts(client)
    here = {each.id for each in found}
    lost = {each.name: each.since_ns for each in alerts if each.kind == "gateway-lost" and each.name not in here}
    gone = [GatewayStatus(id=name, fleet=where.fleet) for name in sorted(lost)]
    rows = [GatewayShown(**fields(each), lost_ns=lost.get(each.id)) for each in (*found, *gone)]
    show(rows, as_json=as_json, table=console.fleet_view(found, lost))
    if unsure:
        console.err.print(f"whether a gateway is lost is not known: {unsure}", markup=False)
    return Exit.FAILED if lost or unsure else Exit.DONE


async def _alerts(client: FleetClient) -> tuple[tuple[Alert, ...], str]:
    """Return the alerts, and why some may be missing: the gateways are shown all the same."""
    try:
        found = await client.alerts()
    except SwiftbotError as error:
        return (), error.message
    silent = ", ".join(found.unreachable)
    return found.alerts, f"{silent} did not answer" if silent else ""


class GatewayShown(GatewayStatus, frozen=True, kw_only=True):
    """A gateway's account of itself, and whether it is there; of a lost one only its name is known."""

    lost_ns: int | None = None
    """When it was lost, Unix nanoseconds; null: it answers."""


async def drain(
    gateway: str,
    /,
    *,
    wait: Annotated[bool, Parameter(help="Show progress and wait until no run is left.")] = False,
    deadline: Annotated[
        float, Parameter(help="Seconds after which remaining runs are cancelled and repeated elsewhere; 0: never.")
    ] = 0.0,
    why: Why = "",
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Drain a gateway: move its runs elsewhere and schedule no new ones, until `uncordon` or its next start."""
    async with where.client() as client:
        state = await client.drain(gateway, deadline, why=why)
        shown = ""
        while wait and state.draining and not state.done:
            if (text := drain_text(state)) != shown and not as_json:
                shown = text
                console.err.print(text)
            await asyncio.sleep(LOOK_S)
            state = await client.drain_state(gateway)
    show(state, as_json=as_json, table=drain_text(state))
    return Exit.DONE if state.done or not wait else Exit.FAILED
