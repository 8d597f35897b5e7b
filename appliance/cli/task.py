"""Tasks: `swiftbot task …`. Commands that only order one thing are made from the registry of operations."""

import asyncio
import contextlib
import difflib
import os
import sys
from collections.abc import Callable
from csv import DictWriter
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Annotated, TextIO

from cyclopts import App, Parameter
from cyclopts.validators import Number
from msgspec.structs import replace

from appliance import console
from appliance.after_stop import robots_of, unfinished
from appliance.cli.common import HERE, WORK, Json, Where, Why, json_line, show, show_task, tell_left
from appliance.cli.submit import exit_code
from appliance.client import FleetClient, cancel_outcome, read_plan_file
from appliance.errors import ConfigError, Exit, SwiftbotError
from appliance.model import Plan, TaskRecord
from appliance.model.task_api import MigrateAsk, Migrated, TasksAsk
from appliance.operations import left_of, split_subtask
from appliance.tasks import history
from appliance.tasks.views import STATUSES, view
from appliance.times import since_ns

task_app = App(name="task", help="List, show, watch, move and cancel tasks, and decide on their plans.", group=WORK)


def add_to(app: App) -> None:
    """Add this group."""
    app.command(task_app)


MOST = 1000
"""Tasks of one answer."""
PAGE = 200


@Parameter(name="*")
@dataclass(frozen=True)
class Filters:
    """Which tasks are meant."""

    state: Annotated[tuple[str, ...], Parameter(help=f"State: {', '.join(STATUSES)}; repeatable.")] = ()
    robot: Annotated[str, Parameter(help="Robot of one of its subtasks.")] = ""
    by: Annotated[str, Parameter(help="Who submitted it.")] = ""
    since: Annotated[
        str, Parameter(help="Accepted since: 90s, 5m, 2h, 3d ago, or 07:30, 2026-11-27, 2026-11-27T07:30.")
    ] = ""
    text: Annotated[str, Parameter(help="Part of its ID, instruction or failure, without regard to case.")] = ""
    remembered: Annotated[
        bool, Parameter(help="Also older tasks of which the gateways only keep the outcome, without plan and results.")
    ] = False

    def ask(self) -> TasksAsk:
        """Return the question for them; ConfigError where a state or time is none."""
        states = tuple(each.casefold().replace("-", " ") for each in self.state)
        if unknown := [each for each in states if each not in STATUSES]:
            near = difflib.get_close_matches(unknown[0], STATUSES, n=1)
            hint = f"did you mean {near[0]}?" if near else f"states: {', '.join(STATUSES)}"
            raise ConfigError(f"--state {unknown[0][:40]!r} is no state", remedy=hint)
        since = since_ns(self.since, now=datetime.now().astimezone())
        return TasksAsk(status=states, robot=self.robot, by=self.by, since_ns=since, text=self.text,
                        remembered=self.remembered)  # fmt: skip


ALL_TASKS = Filters()


@task_app.command(name="list")
async def task_list(
    *,
    limit: Annotated[int, Parameter(help="How many at most.", validator=Number(gte=0, lte=MOST))] = 20,
    before: Annotated[str, Parameter(help="Task ID: list only older ones, as the next page of a list.")] = "",
    filters: Filters = ALL_TASKS,
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """List tasks of the fleet, the newest first; `task export` writes all of them."""
    wanted = filters.ask()
    async with where.client() as client:
        found = await client.tasks(limit, wanted=wanted, after=await client.task(before) if before else None)
    for name in found.unreachable:
        console.err.print(f"{name} did not answer; its tasks may be missing")
    show([view(record) for record in found.tasks], as_json=as_json, table=console.task_list(found.tasks))
    if found.more and found.tasks and not as_json:
        console.err.print(f"there are older ones: --before {found.tasks[-1].id}", markup=False)
    return Exit.DONE


@task_app.command(name="export")
async def task_export(
    file: Annotated[Path | None, Parameter(help="File to write; standard output if not given.")] = None,
    /,
    *,
    csv: Annotated[
        bool, Parameter(name="--csv", help="Write a table with a heading, without subtasks, in place of JSON lines.")
    ] = False,
    filters: Filters = ALL_TASKS,
    as_json: Annotated[bool, Parameter(name="--json", help="Write JSON lines; that is the default.")] = False,
    where: Where = HERE,
) -> int:
    """Write tasks, newest first: a JSON object a line as `task show --json` prints it, or CSV.

    Exit code 1: a gateway did not answer, so that some are missing.
    """
    if csv and as_json:
        raise ConfigError("give --csv or --json", remedy="leave one of them out")
    wanted = replace(filters.ask(), limit=PAGE)
    silent: set[str] = set()
    count = 0
    # Beside it first: a file that was there stays whole when the fleet cannot be reached, or Ctrl-C ends the command.
    if file is not None and not file.name:
        raise ConfigError(f"{str(file)!r} is a folder", remedy="name the file to write")
    draft = file.with_name(f".{file.name}.{os.getpid()}") if file is not None else None
    try:
        with contextlib.ExitStack() as opened:
            out = sys.stdout if draft is None else opened.enter_context(draft.open("w", newline="", encoding="utf-8"))
            write = (_csv_writer if csv else _json_writer)(out)
            async with where.client() as client:
                async for page in client.history(wanted):
                    silent |= set(page.unreachable)
                    for record in page.tasks:
                        write(record)
                    count += len(page.tasks)
                    if file is not None and console.err.is_terminal:
                        console.err.print(f"{count:,} tasks", end="\r")
        if draft is not None and file is not None:
            draft.replace(file)
    except BrokenPipeError:
        raise
    except OSError as error:
        raise ConfigError(
            f"{file or 'the output'} cannot be written: {error.strerror}", remedy="check path and disk"
        ) from error
    finally:
        if draft is not None:
            with contextlib.suppress(OSError):  # where its folder is none, it was not written either
                draft.unlink()
    for name in sorted(silent):
        console.err.print(f"{name} did not answer; its tasks may be missing")
    if file is not None:
        console.err.print(f"{count:,} tasks written to {file}", markup=False)
    return Exit.FAILED if silent else Exit.DONE


def _json_writer(out: TextIO) -> Callable[[TaskRecord], object]:
    """Return what writes a task as a line of JSON."""
    # Within strings alone there are such characters: a terminal must not obey what an instruction holds.
    return lambda record: out.write(json_line(view(record)).translate(_ESCAPED) + "\n")


def _csv_writer(out: TextIO) -> Callable[[TaskRecord], object]:
    """Return what writes a task as a row; the heading is written at once."""
    table = DictWriter(out, fieldnames=list(history.flat(TaskRecord(id="", instruction=""))))
    table.writeheader()
    return lambda record: table.writerow({name: _cell(value) for name, value in history.flat(record).items()})


def _cell(value: str | float) -> str | float:
    """Return a cell that no spreadsheet takes for a formula and no terminal obeys.

    A text that begins like a formula gets an apostrophe, and control characters are replaced.
    """
    if not isinstance(value, str):
        return value
    value = value.translate(_REPLACED)
    return f"'{value}" if value.startswith(("=", "+", "-", "@")) else value


_OBEYED = (*range(32), *range(127, 160), *range(0x202A, 0x202F), *range(0x2066, 0x206A))
"""What terminals obey instead of showing it: controls, and marks that turn the direction of text."""
_ESCAPED = {code: f"\\u{code:04x}" for code in _OBEYED}
_REPLACED = dict.fromkeys(_OBEYED, "\ufffd")


@task_app.command(name="watch")
async def task_watch(
    task: str,
    /,
    *,
    since: Annotated[
        str, Parameter(help="Leave out what is older: seconds, or 90s, 5m, 2h, now. If not given: all that is known.")
    ] = "",
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Follow a task until its end: progress, log lines, figures and findings of all gateways in one stream.

    With --json, one object per line. Ctrl-C leaves; the task continues.
    """
    since_s = _seconds(since)
    try:
        async with where.client() as client:
            async for line in client.stream(task, since_s=since_s):
                if as_json:
                    print(json_line(line), flush=True)
                else:
                    console.out.print(console.stream_line(line), soft_wrap=True)
            record = await client.task(task)
    except asyncio.CancelledError:
        console.err.print(f"task {task} continues; `swiftbot task cancel {task}` stops it")
        return Exit.DONE
    return exit_code(record)


def _seconds(text: str) -> float | None:
    """How far back a stream begins; None: at the beginning."""
    if not text:
        return None
    if text == "now":
        return 0.0
    units = {"s": 1.0, "m": 60.0, "h": 3600.0}
    number, unit = (text[:-1], units[text[-1]]) if text[-1] in units else (text, 1.0)
    try:
        seconds = float(number) * unit
    except ValueError:
        seconds = -1.0
    if not 0 <= seconds < 1e9:
        raise ConfigError(f"--since {text[:40]!r} is no time", remedy="give seconds, or such as 90s, 5m, 2h, now")
    return seconds


@task_app.command(name="cancel")
async def task_cancel(task: str, /, *, why: Why = "", as_json: Json = False, where: Where = HERE) -> int:
    """Cancel a task; returns when it has ended, and says so when it had ended before."""
    async with where.client() as client:
        record = await client.cancel(task, why=why)
        console.err.print(cancel_outcome(record))
        async for record in client.watch(task):  # noqa: B007 - the last one is shown
            pass
        left = await left_of(client, robots_of(record), record=record)
    show_task(record, as_json=as_json)
    if not as_json:
        tell_left(left)
    return Exit.DONE


@task_app.command(name="show")
async def task_show(task: str, /, *, as_json: Json = False, where: Where = HERE) -> int:
    """Show a task with its subtasks, or the plan that waits; of one that did not end well, how its robots stand now.

    Args:
        task: Task ID.
    """
    async with where.client() as client:
        record = await client.task(task)
        left = await left_of(client, robots_of(record), record=record) if unfinished(record) and not as_json else ()
    show_task(record, as_json=as_json)
    tell_left(left)
    return Exit.DONE


@task_app.command(name="approve")
async def task_approve(
    task: str,
    /,
    *,
    plan_hash: Annotated[
        str, Parameter(name="--hash", help="Hash of the plan that you have seen, at least 8 characters.")
    ],
    plan: Annotated[Path | None, Parameter(help="JSON file with an edited plan to run instead; checked first.")] = None,
    why: Why = "",
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Approve the plan of a task that waits for it, as it is or edited; `task show` shows the hash."""
    edited = _plan_of(plan) if plan is not None else None
    async with where.client() as client:
        record = await client.approve(task, plan_hash=plan_hash, plan=edited, why=why)
    show_task(record, as_json=as_json)
    return Exit.DONE


def _plan_of(file: Path) -> Plan:
    try:
        return read_plan_file(file.read_bytes())
    except OSError as error:
        raise ConfigError(f"{file} cannot be read: {error.strerror}", remedy="give a JSON file with a plan") from error


@task_app.command(name="check")
async def task_check(plan: Path, /, *, task: str = "", as_json: Json = False, where: Where = HERE) -> int:
    """Check a plan against the current skills, robots and site; runs nothing. Exit code 4 when it is invalid.

    Args:
        plan: JSON file with the plan.
        task: The task it is for, where one waits or runs.
    """
    edited = _plan_of(plan)
    async with where.client() as client:
        found = await client.check_plan(edited, task=task)
    waits = f"\nwould wait for approval: {found.approval}" if found.approval else ""
    lines = "\n".join(found.problems) or f"valid, hash {found.hash}{waits}"
    show(found, as_json=as_json, table=lines)
    return Exit.REFUSED if found.problems else Exit.DONE


@task_app.command(name="migrate")
async def task_migrate(
    subtask: str,
    /,
    *,
    to: Annotated[str, Parameter(help="Gateway to move it to; by default the closest.")] = "",
    why: Why = "",
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Move a running subtask to another gateway, with its checkpoint; Ctrl-C calls it off while that is possible.

    Exit code 0 when it has started there, 1 when it was moved and has not started yet; otherwise the reason is shown,
    and it continues where it is.

    Args:
        subtask: Subtask, as TASK/SUBTASK.
    """
    task, part = split_subtask(subtask)
    async with where.client() as client:
        try:
            moved = await client.migrate(MigrateAsk(task=task, subtask=part, to=to, why=why))
        except asyncio.CancelledError:
            await _call_off(client, task, part)
            raise
    show(moved, as_json=as_json, table=_move_text(moved))
    return Exit.DONE if moved.started else Exit.FAILED


async def _call_off(client: FleetClient, task: str, subtask: str) -> None:
    try:
        called_off = await client.migrate_cancel(task, subtask)
    except SwiftbotError as error:
        console.err.print(f"the move may continue: {error}", markup=False)
    else:
        console.err.print("the move is called off" if called_off else "too late: the move is done, or there is none")


def _move_text(moved: Migrated) -> str:
    state = "started there" if moved.started else "not yet started there"
    steps = ", ".join(f"{name} {took:.0f} ms" for name, took in moved.steps_ms.items())
    saved = f", from its {moved.checkpoint} checkpoint" if moved.checkpoint else ""
    return (
        f"{moved.subtask} moved from {moved.source} to {moved.target}: attempt {moved.attempt}{saved}, {state} after "
        f"{moved.took_ms:.0f} ms ({steps})\n{moved.why}"
    )
