"""Work with a fleet: `swiftbot submit`, `task …`, `fleet`, `tui`."""

import asyncio
import signal
import uuid
from pathlib import Path
from typing import Annotated

import msgspec
from cyclopts import App, Parameter
from cyclopts.validators import Number

from appliance import console
from appliance.cli.common import HERE, WORK, Json, Where, show
from appliance.client import Endpoint, FleetClient
from appliance.connection import operator_name
from appliance.console_watch import stream_line
from appliance.errors import ConfigError, Exit, UnapprovedError
from appliance.model import PLAIN_PRIORITY, Approval, TaskRecord, TaskRequest, TaskState
from appliance.reasons import why_text
from appliance.steering import cancel_outcome
from appliance.tasks.views import view

task_app = App(name="task", help="List, show, watch, move and cancel tasks, and decide on their plans.", group=WORK)


def add_to(app: App) -> None:
    """Add these commands."""
    for command in (submit, fleet, tui):
        app.command(command, group=WORK)
    app.command(task_app)


def submit(
    text: str,
    *,
    wait: Annotated[
        bool, Parameter(negative="", help="Show progress and wait for the end; Ctrl-C cancels it.")
    ] = False,
    task_id: Annotated[str, Parameter(name="--id", help="Task id; a known one is not done twice.")] = "",
    priority: Annotated[
        int, Parameter(help="0 (whenever there is room) to 9 (before all others).", validator=Number(gte=0, lte=9))
    ] = PLAIN_PRIORITY,
    deadline: Annotated[
        float,
        Parameter(help="Seconds from now after which it is of no use and ends; 0: none.", validator=Number(gte=0)),
    ] = 0.0,
    group: Annotated[
        tuple[str, ...], Parameter(help="A gateway that may serve it; repeat for several. None: whichever can.")
    ] = (),
    approval: Annotated[
        Approval, Parameter(help="Whether its plan is to be approved before anything runs (`task approve`).")
    ] = Approval.NEVER,
    yes: Annotated[
        bool, Parameter(name=("--yes", "-y"), negative="", help="Run the plan without showing it first.")
    ] = False,
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Submit an instruction. Returns once planned; --wait follows it.

    On a terminal the plan is shown before it runs and runs when it is confirmed; in scripts the policy of the fleet
    decides which plans wait for approval. A text that says to stop ("stop", "halt", "rover_1: stop") is not a task: it
    is the soft stop, at once, of the robots named, else of all, as `swiftbot stop` does it.
    """
    from appliance.cli.steer import said_of_stop, show_stopped
    from appliance.cli.submitting import Submitting, on_terminal
    from appliance.llm.stop_words import stop_request
    from appliance.stopping import Stopped

    # The id is chosen here: an interrupt while the task is being handed in must know what to cancel.
    request = TaskRequest(
        instruction=text,
        id=task_id or f"t-{uuid.uuid4().hex[:10]}",
        submitter=operator_name(),
        priority=priority,
        deadline_s=deadline,
        group=group,
        approval=approval,
    )
    shown = not yes and not as_json and on_terminal()
    with said_of_stop(stop_request(text) is not None):
        submitting = Submitting(request, where, wait=wait, quiet=as_json)
        found = submitting.run_shown() if shown else submitting.run()
    if isinstance(found, Stopped):
        return show_stopped(found, as_json=as_json)
    if as_json or not wait or found.state is TaskState.CANCELLED or found.remembered is not None:
        show(view(found), as_json=as_json, table=console.task_table(found))
    return _outcome(found)


def _outcome(record: TaskRecord) -> int:
    if record.failure is not None and record.failure.code == UnapprovedError.code:
        return Exit.REJECTED
    if record.state in (TaskState.FAILED, TaskState.CANCELLED) and _rejected(record):
        return Exit.REJECTED
    if record.state is TaskState.FAILED:
        return Exit.REFUSED if record.failure is not None and record.failure.code == "plan" else Exit.FAILED
    return Exit.CANCELLED if record.state is TaskState.CANCELLED else Exit.DONE


def _rejected(record: TaskRecord) -> bool:
    return record.decision is not None and not record.decision.approved


@task_app.command(name="list")
def task_list(*, limit: int = 20, as_json: Json = False, where: Where = HERE) -> int:
    """List the newest tasks of the fleet."""

    async def go() -> None:
        async with FleetClient(where.endpoint()) as client:
            found = await client.tasks(limit)
        for each in found.unreachable:
            console.err.print(f"{each} did not answer; its tasks may be missing")
        show([view(each) for each in found.tasks], as_json=as_json, table=console.task_list(found.tasks))

    asyncio.run(go())
    return 0


@task_app.command(name="show")
def task_show(task: str, *, as_json: Json = False, where: Where = HERE) -> int:
    """Show a task with its subtasks."""

    async def go() -> None:
        async with FleetClient(where.endpoint()) as client:
            record = await client.task(task)
        show(view(record), as_json=as_json, table=console.task_table(record))

    asyncio.run(go())
    return 0


@task_app.command(name="watch")
def task_watch(
    task: str,
    *,
    since: Annotated[
        str, Parameter(help="Leave out what is older: seconds, or such as 90s, 5m, 2h, now. All that is known if not.")
    ] = "",
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Follow a task until its end: progress, log lines, figures and findings of all gateways in one stream.

    With --json a line an object. Ctrl-C leaves; the task goes on.
    """
    since_s = _seconds(since)

    async def go() -> TaskRecord:
        async with FleetClient(where.endpoint()) as client:
            async for line in client.stream(task, since_s=since_s):
                if as_json:
                    print(msgspec.json.encode(line).decode(), flush=True)
                else:
                    console.out.print(stream_line(line), soft_wrap=True)
            return await client.task(task)

    try:
        record = asyncio.run(go())
    except KeyboardInterrupt:
        console.err.print(f"task {task} goes on; `swiftbot task cancel {task}` stops it")
        return 0
    return _outcome(record)


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


@task_app.command(name="why")
def task_why(task: str, subtask: str = "", *, as_json: Json = False, where: Where = HERE) -> int:
    """Show why a task waits or ran where it did: its group, who could serve it, who not, its place, when it may start.

    Args:
        task: The task.
        subtask: One of its subtasks; all when none is given.
        as_json: Print JSON.
        where: The fleet.
    """

    async def go() -> None:
        async with FleetClient(where.endpoint()) as client:
            found = await client.why(task, subtask)
        show(found, as_json=as_json, table=why_text(found))

    asyncio.run(go())
    return 0


@task_app.command(name="cancel")
def task_cancel(
    task: str,
    *,
    why: Annotated[str, Parameter(help="Why, for the audit and the record.")] = "",
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Stop a task; returns when it has ended, and says so when it had ended before."""

    async def go() -> None:
        async with FleetClient(where.endpoint()) as client:
            record = await client.cancel(task, why=why)
            console.err.print(cancel_outcome(record))
            async for record in client.watch(task):  # noqa: B007 - the last one is shown
                pass
        show(view(record), as_json=as_json, table=console.task_table(record))

    asyncio.run(go())
    return 0


def fleet(*, as_json: Json = False, where: Where = HERE) -> int:
    """Show the gateways, and what is wrong with the recorders."""

    async def go() -> None:
        async with FleetClient(where.endpoint()) as client:
            await client.gateway()
            found = sorted(client.plane.registry.gateways.values(), key=lambda each: each.id)
        show(found, as_json=as_json, table=console.fleet_view(found))

    asyncio.run(go())
    return 0


def tui(
    *,
    write: Annotated[
        bool, Parameter(negative="", help="Start unlocked; without, nothing can be changed before `:write`.")
    ] = False,
    theme: Annotated[
        str, Parameter(help="dark, light, blind-dark, blind-light, contrast-dark or contrast-light.")
    ] = "",
    config: Annotated[
        Path | None, Parameter(help="Own settings and keys, TOML; else ~/.config/swiftbot/tui.toml, if there is one.")
    ] = None,
    replay: Annotated[
        Path | None, Parameter(help="Show this recorded log (MCAP) instead of a fleet: play, pause, seek.")
    ] = None,
    serve: Annotated[
        bool, Parameter(negative="", help="Serve it to browsers on this machine; prints an address with a token.")
    ] = False,
    port: Annotated[int, Parameter(help="Where --serve listens on 127.0.0.1; 0: any that is free.")] = 0,
    where: Where = HERE,
) -> int:
    """Open the terminal UI on a fleet or on a recorded log, here or in a browser."""
    from appliance.plane.settings import PlaneConfig
    from appliance.tui import settings
    from appliance.tui.app import run_tui

    own = settings.load(config)
    own = msgspec.structs.replace(own, write=own.write or write, theme=theme or own.theme)
    if replay is not None and serve:
        raise ConfigError(
            "--serve shows a fleet", remedy="open the log in the browser by `:open FILE`, or leave --serve"
        )
    endpoint = Endpoint(fleet=where.fleet, connect=()) if replay is not None else where.endpoint()
    if serve:
        # Each browser's terminal UI is a process of its own: it is told all that was asked for here.
        options = ["--theme", own.theme] + (["--write"] if own.write else [])
        options += ["--config", str(config)] if config is not None else []
        _serve_tui(endpoint, port=port, options=options)
    else:
        plane = PlaneConfig(mode="client", connect=endpoint.connect)
        if where.directory is not None:
            own = msgspec.structs.replace(own, logs=(*own.logs, str(where.directory / "record")))
        asyncio.run(run_tui(plane, endpoint.fleet, own, replay=replay))
    return 0


def _serve_tui(endpoint: Endpoint, *, port: int, options: list[str]) -> None:
    """Serve the terminal UI until SIGTERM or Ctrl-C."""
    from appliance.tui.serve import serve

    async def go() -> None:
        stop = asyncio.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            asyncio.get_running_loop().add_signal_handler(number, stop.set)

        def tell(address: str) -> None:
            # Flushed: whoever started it as a process waits for the address.
            print(address, flush=True)
            console.err.print("whoever knows this address may look, and unlock; Ctrl-C ends it")

        await serve(endpoint.fleet, endpoint.connect, port=port, options=options, stop=stop, tell=tell)

    asyncio.run(go())
