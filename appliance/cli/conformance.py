"""Conformance of a robot's program: `swiftbot robots check`."""

import asyncio
from typing import Annotated

from cyclopts import App, Parameter
from rich.markup import escape

from appliance import console
from appliance.cli.common import HERE, Json, Where, show
from appliance.cli.robots import robots_app
from appliance.client import FleetClient
from appliance.errors import ConflictError, Exit, NotFoundError, RefusedError
from appliance.model import Lease, SubtaskState, TaskState
from appliance.plane.keys import check_name
from appliance.robots.conformance import Conformance, Operator, Report, Seen, is_present

_LEASE_S = 60.0
_WHY = "conformance check"
_GOTO_S = 30.0
_SLOW_S = 2.0
_MARKS = {"passed": "[green]✔[/green]", "failed": "[red]✘[/red]", "skipped": "[yellow]–[/yellow]"}


def add_to(app: App) -> None:
    """Add this command; it hangs below `robots`."""
    del app


@robots_app.command(name="check")
def robots_check(
    robot: str,
    *,
    moves: Annotated[bool, Parameter(negative="", help="Drive the robot a metre and back, too.")] = False,
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Check that the program of a robot that speaks Zenoh keeps to the contract (docs/robot-contract.md).

    The robot does not move, unless --moves is given; it holds for about half a minute, under a lease, so that no task
    commands it. Ends with exit code 1 when a check fails.

    Args:
        robot: Its name, as the list shows it.
    """
    check_name(robot, "robot")
    console_of = console.err if as_json else console.out

    def begin(name: str, about_s: float) -> None:
        if about_s >= _SLOW_S:
            console_of.print(f"  [dim]{name}: about {about_s:.0f} s …[/dim]", markup=True)

    def seen(one: Seen) -> None:
        console_of.print(f"{_MARKS[one.outcome]} {one.check}: {escape(one.what)}", markup=True, highlight=False)
        if one.remedy:
            console_of.print(f"  remedy: {one.remedy}", markup=False, highlight=False)

    async def go() -> Report:
        async with FleetClient(where.endpoint()) as client:
            await client.gateway()
            await _may_be_checked(client, robot)
            checks = Conformance(client.plane.session, robot, _operator(client, robot), on_begin=begin, on_seen=seen)
            return await checks.run(moves=moves)

    report = asyncio.run(go())
    if as_json:
        show(report, as_json=True)
    else:
        failed = sum(each.outcome == "failed" for each in report.checks)
        verdict = "keeps to the contract" if report.passed else f"fails {failed} of {len(report.checks)} checks"
        console.out.print(f"{robot} {verdict}", markup=False, highlight=False)
    return Exit.DONE if report.passed else Exit.FAILED


async def _may_be_checked(client: FleetClient, robot: str) -> None:
    """Raise where there is no such robot, its gateway answers for it, or a task has it."""
    info = client.plane.registry.robots.get(robot)
    if info is None:
        if not await is_present(client.plane.session, robot):
            known = ", ".join(sorted(client.plane.registry.robots)) or "none"
            raise NotFoundError(f"no robot {robot[:60]!r}", remedy=f"there are: {known}")
        return
    if info.gateway or info.kind == "mavlink":
        raise RefusedError(
            f"{robot} is a MAVLink vehicle, for which {info.gateway or 'a gateway'} answers",
            remedy="check a robot that speaks Zenoh itself",
        )
    for task in (await client.tasks(200)).tasks:
        if task.state is TaskState.RUNNING and any(
            each.state is SubtaskState.RUNNING and robot in (each.bound_robot, each.subtask.robot)
            for each in task.subtasks
        ):
            raise ConflictError(f"{robot} is busy with task {task.id}", remedy="wait for its end, or cancel it")


def _operator(client: FleetClient, robot: str) -> Operator:
    held: list[Lease] = []

    async def take() -> str:
        held.append(await client.take_over(robot, lease_s=_LEASE_S, why=_WHY))
        return held[0].id

    async def drive(x: float, y: float) -> object:
        return await client.drive(held[0], "goto", timeout_s=_GOTO_S, waypoints=[{"x": x, "y": y}], speed_mps=0.5)

    return Operator(
        take=take,
        keep=lambda: client.renew(held[0]),
        drive=drive,
        give_back=lambda: client.give_back(held[0], why=_WHY),
    )
