"""A plan on simulated robots before it is approved: `swiftbot task simulate`."""

import asyncio
import contextlib
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter, validators
from rich.console import Group
from rich.table import Table
from rich.text import Text

from appliance import console
from appliance.cli.common import HERE, Json, Skills, Where, show
from appliance.errors import Exit
from appliance.model import TaskState

if TYPE_CHECKING:
    from workshop.dry_run import DryRun


def add_to(app: App) -> None:
    """Add the command to those of tasks."""
    app["task"].command(simulate)


def simulate(
    task: str,
    /,
    *,
    rate: Annotated[float, Parameter(validator=validators.Number(gt=0, lte=20))] = 4.0,
    limit_s: Annotated[float, Parameter(name="--limit", validator=validators.Number(gt=0, lte=86400))] = 900.0,
    skills: Skills = (),
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Run a task's plan on simulated robots of this machine: the real map, no real robot moves.

    Each robot is simulated under its name where it stands, with its charge and what it holds. Ctrl-C ends it.
    Exit code 1: the plan failed there, or did not end in time.

    Args:
        task: Task ID; its plan may still wait for approval.
        rate: How many times faster than real the robots move.
        limit_s: Seconds after which it is ended as it stands.
        skills: Folder with further skills, as the gateways have them.
        as_json: Print JSON: state, steps, robots afterwards.
        where: The fleet.
    """
    from workshop.dry_run import dry_run

    def say(text: str) -> None:
        with contextlib.suppress(OSError):  # who has read it is gone: the simulation's fleet is removed all the same
            console.err.print(text, markup=False, highlight=False)

    async def go() -> "DryRun":
        async with where.client() as client:
            return await dry_run(
                client, task, skills=skills, rate=rate, limit_s=limit_s,
                progress=say,
            )  # fmt: skip

    found = asyncio.run(go())
    show(found, as_json=as_json, table=_table(found))
    return Exit.DONE if found.state is TaskState.SUCCEEDED else Exit.FAILED


def _table(found: "DryRun") -> Group:
    steps = Table(box=None, pad_edge=False, header_style="bold dim")
    for title in ("subtask", "skill", "robot", "state", "took", "problem"):
        steps.add_column(title, overflow="fold")
    for step in found.steps:
        took = "" if step.took_s is None else f"{step.took_s:.1f} s"
        cells = (step.subtask, step.skill, step.robot or "–", str(step.state), took, step.problem)
        steps.add_row(*(Text(cell) for cell in cells))
    robots = Table(box=None, pad_edge=False, header_style="bold dim")
    for title in ("robot", "ends at", "battery", "holds"):
        robots.add_column(title, overflow="fold")
    for robot in found.robots:
        at = "not known" if robot.pose is None else f"({robot.pose.x:.1f}, {robot.pose.y:.1f}, {robot.pose.z:.1f})"
        left = "not known" if robot.battery_percent is None else f"{robot.battery_percent:.0f} %"
        used = f", {robot.battery_used_percent:.1f} % used" if robot.battery_used_percent else ""
        robots.add_row(*(Text(cell) for cell in (robot.robot, at, left + used, robot.holding or "nothing")))
    good = found.state is TaskState.SUCCEEDED
    verdict = f"in the simulation: {found.state}{f': {found.problem}' if found.problem else ''}"
    return Group(
        Text(found.note, "bold yellow"),
        steps,
        robots,
        *(Text(text, "yellow") for text in found.differs),
        Text(f"robots moved {found.rate:g} times faster than real", "dim"),
        Text(verdict, "bold green" if good else "bold red"),
    )
