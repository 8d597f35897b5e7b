"""Saved instructions: `swiftbot instructions …`. `remove` is made from the registry of operations."""

from collections.abc import Sequence
from typing import Annotated

from cyclopts import App, Parameter
from cyclopts.validators import Number
from rich.table import Table

from appliance import console
from appliance.cli.common import HERE, WORK, Json, Where, Why, show, show_task
from appliance.client import FleetClient
from appliance.errors import Exit
from appliance.model import PLAIN_PRIORITY, TaskRequest
from appliance.model.schedules import SavedInstruction
from appliance.schedules.instructions import filled, parameters, read_values
from appliance.schedules.records import no_instruction

instructions_app = App(name="instructions", help="Save instructions with parameters, and submit them.", group=WORK)


def add_to(app: App) -> None:
    """Add this group."""
    app.command(instructions_app)


@instructions_app.command(name="save")
async def instructions_save(
    name: str,
    text: str,
    /,
    *,
    about: Annotated[str, Parameter(help="What it is for.")] = "",
    replace: Annotated[bool, Parameter(help="Replace the one of that name.")] = False,
    why: Why = "",
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Save an instruction; parameters stand in it as {place}, or {place=dock 1} with a default.

    Args:
        name: Name it is run by.
        text: The instruction.
    """
    known = parameters(text)
    async with where.client() as client:
        saved = await client.instruction_save(name, text, about=about, replace=replace, why=why)
    usage = " ".join(f"{each.name}={each.default or '…'}" for each in known)
    show(saved, as_json=as_json, table=f"saved: swiftbot instructions run {name} {usage}".rstrip())
    return Exit.DONE


@instructions_app.default
@instructions_app.command(name="list")
async def instructions_list(*, as_json: Json = False, where: Where = HERE) -> int:
    """List the saved instructions with their parameters."""
    async with where.client() as client:
        found = await client.instructions()
    for gateway in found.unreachable:
        console.err.print(f"{gateway} did not answer; its instructions may be missing")
    table = instruction_table(found.instructions) if found.instructions else "no saved instructions"
    show(found.instructions, as_json=as_json, table=table)
    return Exit.FAILED if found.unreachable else Exit.DONE


@instructions_app.command(name="run")
async def instructions_run(
    name: str,
    /,
    *values: str,
    dry: Annotated[bool, Parameter(help="Print the instruction and submit nothing.")] = False,
    priority: Annotated[
        int, Parameter(help="Priority, 0 (lowest) to 9.", validator=Number(gte=0, lte=9))
    ] = PLAIN_PRIORITY,
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Submit a saved instruction; its plan is made and reviewed again. Returns once planned.

    Args:
        name: Name of the saved instruction.
        values: Values of its parameters, as name=value.
    """
    async with where.client() as client:
        text = await instruction_of(client, name, values)
        if dry:
            show({"instruction": text}, as_json=as_json, table=text)
            return Exit.DONE
        accepted = await client.submit(TaskRequest(instruction=text, submitter=client.operator, priority=priority))
        console.err.print(f"task {accepted.id} is accepted")
        planned = await client.planned(accepted.id)
    show_task(planned, as_json=as_json)
    return Exit.REFUSED if planned.failure is not None and planned.failure.code == "plan" else Exit.DONE


async def instruction_of(client: FleetClient, name: str, values: Sequence[str]) -> str:
    """Return a saved instruction with values in the place of its parameters.

    Raises:
        NotFoundError: there is none of that name.
        PayloadError: a value is missing, or has no parameter.
    """
    given = read_values(values)
    found = await client.instructions()
    saved = next((each for each in found.instructions if each.id == name), None)
    if saved is None:
        error = no_instruction(name)
        if found.unreachable:
            error.message += f"; {', '.join(found.unreachable)} did not answer"
        raise error
    return filled(saved.text, given)


def instruction_table(saved: Sequence[SavedInstruction]) -> Table:
    """Saved instructions, a line each."""
    table = Table(box=None, pad_edge=False, header_style="bold dim")
    for name in ("name", "instruction", "about", "by"):
        table.add_column(name, overflow="fold")
    for each in saved:
        table.add_row(each.id, each.text, each.about, each.saved.by if each.saved is not None else "–")
    return table
