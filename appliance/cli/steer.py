"""Steer a fleet: `swiftbot stop`, `resume`, `standing`, `acts`, `asks`, `answer`, `llm swap`.

And of `task`: `approve`, `reject`, `check`, `pause`, `resume`, `retry`. Robots are taken over by `robots take`.
"""

import asyncio
import contextlib
import time
from collections.abc import Awaitable, Callable, Generator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter

from appliance import console
from appliance.cli.common import HERE, WORK, Json, Where, Why, show
from appliance.cli.task import task_app
from appliance.client import FleetClient, read_plan_file
from appliance.errors import ConfigError, Exit, SwiftbotError
from appliance.model import Plan, TaskRecord
from appliance.robots.api import StopAnswer
from appliance.tasks.views import view

if TYPE_CHECKING:
    from appliance.client import Stopped

llm_app = App(name="llm", help="Language models of gateways.", group=WORK)


def add_to(app: App) -> None:
    """Add these commands."""
    for command in (stop, resume, standing, acts, asks, answer):
        app.command(command, group=WORK)
    app.command(llm_app)


# --- tasks ------------------------------------------------------------------------------------------------------


def _order(where: Where, give: Callable[[FleetClient], Awaitable[TaskRecord]], *, as_json: bool) -> TaskRecord:
    async def go() -> TaskRecord:
        async with FleetClient(where.endpoint()) as client:
            return await give(client)

    record = asyncio.run(go())
    show(view(record), as_json=as_json, table=console.task_table(record))
    return record


@task_app.command(name="approve")
def task_approve(
    task: str,
    *,
    plan_hash: Annotated[
        str, Parameter(name="--hash", help="Hash of the plan that waits, 8 characters or more: what you have seen.")
    ],
    plan: Annotated[
        Path | None, Parameter(help="JSON file with an edited plan to take in its place; checked before it is.")
    ] = None,
    why: Why = "",
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Approve the plan of a task that waits for it, as it is or edited; `task show` tells the hash."""
    edited = _plan_of(plan) if plan is not None else None
    _order(where, lambda client: client.approve(task, plan_hash=plan_hash, plan=edited, why=why), as_json=as_json)
    return 0


def _plan_of(file: Path) -> Plan:
    try:
        return read_plan_file(file.read_bytes())
    except OSError as error:
        raise ConfigError(f"{file} cannot be read: {error.strerror}", remedy="give a JSON file with a plan") from error


@task_app.command(name="reject")
def task_reject(task: str, *, why: Why = "", as_json: Json = False, where: Where = HERE) -> int:
    """Turn the plan of a task down that waits for approval; the task ends."""
    _order(where, lambda client: client.reject(task, why=why), as_json=as_json)
    return 0


@task_app.command(name="check")
def task_check(plan: Path, *, task: str = "", as_json: Json = False, where: Where = HERE) -> int:
    """Check a plan against skills, robots and site of now; runs nothing. Exit code 4 when something is wrong.

    Args:
        plan: JSON file with the plan.
        task: The task it is for, where one waits or runs.
        as_json: Print JSON.
        where: The fleet.
    """
    edited = _plan_of(plan)

    async def go() -> int:
        async with FleetClient(where.endpoint()) as client:
            found = await client.check_plan(edited, task=task)
        waits = f"\nwould wait for approval: {found.approval}" if found.approval else ""
        lines = "\n".join(found.problems) or f"valid, hash {found.hash}{waits}"
        show(found, as_json=as_json, table=lines)
        return Exit.REFUSED if found.problems else Exit.DONE

    return asyncio.run(go())


@task_app.command(name="pause")
def task_pause(
    task: str,
    *,
    hold: Annotated[
        bool, Parameter(negative="", help="End runs that save checkpoints; they go on from there. Others go on.")
    ] = False,
    why: Why = "",
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Start no further subtask of a task until it is resumed; what runs goes on to its end."""
    record = _order(where, lambda client: client.pause(task, hold=hold, why=why), as_json=as_json)
    going = [each.subtask.id for each in record.subtasks if each.state in ("dispatched", "running")]
    if going and not as_json:
        console.err.print(f"under way: {', '.join(going)}", markup=False)
    return 0


@task_app.command(name="resume")
def task_resume(task: str, *, why: Why = "", as_json: Json = False, where: Where = HERE) -> int:
    """Let a paused task go on."""
    _order(where, lambda client: client.resume(task, why=why), as_json=as_json)
    return 0


@task_app.command(name="retry")
def task_retry(task: str, subtask: str = "", *, why: Why = "", as_json: Json = False, where: Where = HERE) -> int:
    """Try again what failed or was cancelled of a task; what has succeeded is kept.

    Args:
        task: The task.
        subtask: One of its subtasks, of a task that still runs too; all that did not succeed when none is given.
        why: Why, for the audit.
        as_json: Print JSON.
        where: The fleet.
    """
    _order(where, lambda client: client.retry(task, subtask, why=why), as_json=as_json)
    return 0


# --- robots -----------------------------------------------------------------------------------------------------


def stop(*robots: str, why: Why = "", as_json: Json = False, where: Where = HERE) -> int:
    """Soft stop: robots hold, and are given no command until `resume`; none named: the whole fleet.

    Commands in flight are cancelled and the tasks that need the robots are paused. It survives restarts of gateways.
    It is no safety-rated emergency stop: that is a switch at the robot. Names may be typed as "Rover_1", "rover 1",
    "drones". Exit code 1 when a robot did not confirm, one that is offline too: it is stopped when it is back. A name
    that no robot has stops nothing and is reported first (exit code 4 when nothing was stopped).
    """
    return carry_out_stop(robots, why=why, as_json=as_json, where=where)


def carry_out_stop(names: tuple[str, ...], *, why: str, as_json: bool, where: Where) -> int:
    """Stop the robots of these names, all when there are none, and print what came of it."""
    from appliance.client import Stopped

    async def go() -> Stopped:
        async with FleetClient(where.endpoint()) as client:
            return await Stopped.carry_out(client, names, why=why)

    with said_of_stop():
        done = asyncio.run(go())
    return show_stopped(done, as_json=as_json)


@contextlib.contextmanager
def said_of_stop(is_stop: bool = True) -> Generator[None]:
    """Say first that a stop is not confirmed when it ends with an error."""
    try:
        yield
    except SwiftbotError:
        if is_stop:
            console.err.print("NOT CONFIRMED: use the switch at a robot that moves")
        raise


def show_stopped(done: "Stopped", *, as_json: bool) -> int:
    """Print what came of a stop; the exit code says whether all of it is confirmed."""
    show(done.as_json(), as_json=as_json, table=done.text())
    if done.unknown:
        return Exit.REFUSED if done.answer is None else Exit.FAILED
    return Exit.DONE if done.confirmed else Exit.FAILED


def resume(*robots: str, why: Why = "", as_json: Json = False, where: Where = HERE) -> int:
    """Lift soft stops: of these robots, or all of them; the tasks go on. Exit code 1 when a gateway did not confirm."""
    from appliance.client import answer_text

    async def go() -> StopAnswer:
        async with FleetClient(where.endpoint()) as client:
            return await client.resume_robots(robots, why=why)

    answer = asyncio.run(go())
    show(answer, as_json=as_json, table=answer_text(answer))
    return Exit.FAILED if answer.silent else Exit.DONE


def standing(*, as_json: Json = False, where: Where = HERE) -> int:
    """Show the soft stops in force and the robots that operators have taken over: who, and why."""

    async def go() -> None:
        async with FleetClient(where.endpoint()) as client:
            found = await client.standing()
        lines = [f"{', '.join(each.robots) or 'the fleet'}: {each.text}" for each in found.active]
        lines += [f"{each.robot}: {each.text}" for each in found.leases]
        shown = {"stops": found.active, "leases": found.leases}
        show(shown, as_json=as_json, table="\n".join(lines) or "nothing is stopped or taken over")

    asyncio.run(go())
    return 0


def acts(*, limit: int = 30, as_json: Json = False, where: Where = HERE) -> int:
    """Show what operators ordered lately, and what came of it; the recorder's log has all of it."""

    async def go() -> None:
        async with FleetClient(where.endpoint()) as client:
            found, silent = await client.acts(limit)
        for name, error in sorted(silent.items()):
            console.err.print(f"{name} did not answer: {error.message}", markup=False)
        lines = [
            f"{time.strftime('%H:%M:%S', time.localtime(each.at_ns / 1e9))} {each.by}: {each.verb} {each.target}"
            f"{f' ({each.why})' if each.why else ''}: {each.outcome}{f', {each.problem}' if each.problem else ''}"
            for each in found
        ]
        show(list(found), as_json=as_json, table="\n".join(lines) or "no orders")

    asyncio.run(go())
    return 0


def asks(*, as_json: Json = False, where: Where = HERE) -> int:
    """List the questions of skills and robots that wait for an answer."""

    async def go() -> None:
        async with FleetClient(where.endpoint()) as client:
            found = await client.enquiries()
        for name in found.unreachable:
            console.err.print(f"{name} did not answer; its questions may be missing", markup=False)
        lines = [
            f"{each.id}  {each.robot or each.task} asks {each.to or 'anybody'}: {each.question}"
            + (f" ({', '.join(each.choices)})" if each.choices else "")
            for each in found.enquiries
        ]
        show(list(found.enquiries), as_json=as_json, table="\n".join(lines) or "nobody asks anything")

    asyncio.run(go())
    return 0


def answer(enquiry: str, text: str, *, why: Why = "", as_json: Json = False, where: Where = HERE) -> int:
    """Answer a question; the first answer counts.

    Args:
        enquiry: Its id, as `asks` shows it.
        text: The answer; one of the choices where there are any.
        why: Why, for the audit.
        as_json: Print JSON.
        where: The fleet.
    """

    async def go() -> None:
        async with FleetClient(where.endpoint()) as client:
            found = await client.answer(enquiry, text, why=why)
        show(found, as_json=as_json, table=f"{found.question} {found.answer}")

    asyncio.run(go())
    return 0


@llm_app.command(name="swap")
def llm_swap(gateway: str, folder: str, *, why: Why = "", as_json: Json = False, where: Where = HERE) -> int:
    """Have a gateway plan with another model; it loads and is tested beside the old one, which stays if it fails.

    Args:
        gateway: Which gateway.
        folder: Folder on that gateway, made for onnxruntime-genai. It lasts until the gateway's next start.
        why: Why, for the audit.
        as_json: Print JSON.
        where: The fleet.
    """

    async def go() -> None:
        async with FleetClient(where.endpoint()) as client:
            console.err.print(f"{gateway} loads and tests {folder}; it goes on planning meanwhile", markup=False)
            found = await client.swap_model(gateway, folder, why=why)
        text = f"{gateway} plans with {found.after} instead of {found.before or 'none'}, after {found.ms:.0f} ms"
        show(found, as_json=as_json, table="\n".join([text, *found.tests]))

    asyncio.run(go())
    return 0
