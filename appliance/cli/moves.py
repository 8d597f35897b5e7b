"""Move runs between gateways: `swiftbot task migrate`, `drain`, `undrain`."""

import asyncio
from typing import Annotated

from cyclopts import App, Parameter

from appliance import console
from appliance.cli.common import HERE, WORK, Json, Where, Why, show
from appliance.cli.work import task_app
from appliance.client import FleetClient
from appliance.errors import Exit, SwiftbotError
from appliance.tasks.api import DrainState, MigrateAsk, Migrated

LOOK_S = 0.5


def add_to(app: App) -> None:
    """Add these commands."""
    app.command(drain, group=WORK)
    app.command(undrain, group=WORK)


@task_app.command(name="migrate")
def task_migrate(
    task: str,
    subtask: str,
    *,
    to: Annotated[str, Parameter(help="The gateway that is to take it; by default the closest.")] = "",
    why: Why = "",
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Move a running subtask to another gateway, with its checkpoint; Ctrl-C calls it off while that can be done.

    Exit code 0 when it has started there, 1 when it was moved and had not yet; otherwise why not, and it goes on
    where it is.
    """

    async def go() -> Migrated:
        async with FleetClient(where.endpoint()) as client:
            try:
                return await client.migrate(MigrateAsk(task=task, subtask=subtask, to=to, why=why))
            except asyncio.CancelledError:
                await _call_off(client, task, subtask)
                raise

    moved = asyncio.run(go())
    show(moved, as_json=as_json, table=_told(moved))
    return Exit.DONE if moved.started else Exit.FAILED


async def _call_off(client: FleetClient, task: str, subtask: str) -> None:
    try:
        called_off = await client.migrate_cancel(task, subtask)
    except SwiftbotError as error:
        console.err.print(f"the move may go on: {error}", markup=False)
    else:
        console.err.print("the move is called off" if called_off else "too late: the move is done, or there is none")


def _told(moved: Migrated) -> str:
    state = "started there" if moved.started else "not yet started there"
    steps = ", ".join(f"{name} {took:.0f} ms" for name, took in moved.steps_ms.items())
    saved = f", from its {moved.checkpoint} checkpoint" if moved.checkpoint else ""
    return (
        f"{moved.subtask} moved from {moved.source} to {moved.target}: attempt {moved.attempt}{saved}, {state} after "
        f"{moved.took_ms:.0f} ms ({steps})\n{moved.why}"
    )


def drain(
    gateway: str,
    *,
    wait: Annotated[bool, Parameter(negative="", help="Show progress and wait until no run is left.")] = False,
    deadline: Annotated[
        float, Parameter(help="Seconds after which runs that are left are cancelled and repeated elsewhere; 0: never.")
    ] = 0.0,
    why: Why = "",
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Have a gateway give its runs away and take no more, until `undrain` or its next start."""

    async def go() -> DrainState:
        async with FleetClient(where.endpoint()) as client:
            state = await client.drain(gateway, deadline, why=why)
            told = ""
            while wait and state.draining and not state.done:
                if (text := _progress(state)) != told and not as_json:
                    told = text
                    console.err.print(text, markup=False)
                await asyncio.sleep(LOOK_S)
                state = await client.drain_state(gateway)
        return state

    state = asyncio.run(go())
    show(state, as_json=as_json, table=_progress(state))
    return Exit.DONE if state.done or not wait else Exit.FAILED


def undrain(gateway: str, *, why: Why = "", as_json: Json = False, where: Where = HERE) -> int:
    """Have a gateway take runs again."""

    async def go() -> DrainState:
        async with FleetClient(where.endpoint()) as client:
            return await client.undrain(gateway, why=why)

    state = asyncio.run(go())
    show(state, as_json=as_json, table=_progress(state))
    return 0


def _progress(state: DrainState) -> str:
    if not state.draining:
        return f"{state.gateway} takes runs"
    head = f"{state.gateway} drains: {state.moved} runs moved away, {state.ended} ended there, {len(state.left)} left"
    return "\n".join([head, *(f"  {each.run} ({each.skill}): {each.why}" for each in state.left)])
