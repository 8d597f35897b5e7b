"""Tasks of a fleet: `swiftbot submit`, `task …`, `drain`, `undrain`, `fleet`, `tui`.

What `submit` does: a stop at once, a plan that is shown before it runs, a task that is followed. The decisions of
operators on tasks (`task approve`, `pause`, `retry` …) are among `steer`'s.
"""

import asyncio
import contextlib
import os
import shlex
import signal
import subprocess
import sys
import tempfile
import uuid
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from cyclopts import App, Parameter
from cyclopts.validators import Number
from msgspec.structs import replace

from appliance import console
from appliance.cli.common import HERE, WORK, Json, Where, Why, show
from appliance.client import Endpoint, FleetClient, Stopped, cancel_outcome, read_plan_file, roster_of
from appliance.connection import operator_name
from appliance.console import stream_line
from appliance.errors import ConfigError, Exit, NotFoundError, SwiftbotError, UnapprovedError, UnreachableError
from appliance.llm.stop_words import mentions_stop, stop_request
from appliance.model import PLAIN_PRIORITY, Approval, Plan, SubtaskState, TaskRecord, TaskRequest, TaskState
from appliance.reasons import why_text
from appliance.tasks.api import DrainState, MigrateAsk, Migrated
from appliance.tasks.views import view

task_app = App(name="task", help="List, show, watch, move and cancel tasks, and decide on their plans.", group=WORK)


def add_to(app: App) -> None:
    """Add these commands."""
    for command in (submit, fleet, tui, drain, undrain):
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
    from appliance.client import Stopped
    from appliance.llm.stop_words import stop_request

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


async def follow(client: FleetClient, task: str, *, plan_shown: bool = False) -> TaskRecord:
    """Show a task's plan, each change of a subtask, and the results at its end; returns its last record.

    A plan that waits for approval is shown at once, with why it waits and how to approve it.
    """
    shown_plan, held = plan_shown, ""
    told: dict[str, tuple[SubtaskState, str, int]] = {}
    record: TaskRecord | None = None
    async for record in client.watch(task):
        held = console.tell_held(record, held)
        if record.plan is not None and record.subtasks and not shown_plan:
            shown_plan = True
            console.out.print(console.plan_graph(record.plan))
        for each in record.subtasks:
            # Whole tenths of progress: a line a step, not one a message.
            news = (each.state, each.note if not each.progress else "", int(each.progress * 10) // 3)
            if told.get(each.subtask.id, (SubtaskState.WAITING, "", 0)) != news:
                told[each.subtask.id] = news
                console.out.print(console.progress_line(each), style="dim")
    assert record is not None  # noqa: S101 - watch yields at least the final record
    console.out.print(console.task_table(record))
    return record


class Submitting:
    """One instruction, from the command line to its end or until it is planned.

    Args:
        request: what was typed.
        where: the fleet.
        wait: follow it to its end.
        quiet: print no progress.
    """

    def __init__(self, request: TaskRequest, where: Where, *, wait: bool, quiet: bool) -> None:
        self._request = request
        self._where = where
        self._wait = wait
        self._quiet = quiet

    def run(self) -> TaskRecord | Stopped:
        """Submit it; the policy of the fleet decides whether its plan waits for approval."""
        return asyncio.run(self._run())

    def run_shown(self) -> TaskRecord | Stopped:
        """Submit it with a plan that waits, show the plan on the terminal, and run it when it is confirmed."""
        self._request = replace(self._request, approval=Approval.ALWAYS)
        found = asyncio.run(self._propose())
        if isinstance(found, Stopped) or found.state is not TaskState.PROPOSED or found.proposal is None:
            return found
        plan_hash, plan = found.proposal.hash, found.proposal.plan
        if found.proposal.note:
            console.out.print(f"held: {found.proposal.note}")
        edited: Plan | None = None
        while True:
            console.out.print(console.plan_graph(edited or plan))
            match _answer("Run this plan?"):
                case "yes":
                    return asyncio.run(self._approve(plan_hash, edited))
                case "no":
                    return asyncio.run(self._reject(plan_hash))
                case "edit":
                    edited = self._edited(edited or plan) or edited

    # --- steps ------------------------------------------------------------------------------------------------

    async def _run(self) -> TaskRecord | Stopped:
        async with FleetClient(self._where.endpoint()) as client:
            if (stopped := await self._stopped(client)) is not None:
                return stopped
            try:
                accepted = await client.submit(self._request)
                if accepted.remembered is not None:
                    console.err.print(f"task {accepted.id} was handed in before and is not begun again")
                    return accepted
                console.err.print(f"task {accepted.id} is accepted")
                if self._wait:
                    return await self._follow(client)
                planned = await client.planned(accepted.id)
            except asyncio.CancelledError:
                if self._wait:
                    await self._cancel(client)
                raise
            if planned.state is TaskState.PROPOSED:
                console.err.print(console.held_text(planned))
            return planned

    async def _propose(self) -> TaskRecord | Stopped:
        async with FleetClient(self._where.endpoint()) as client:
            if (stopped := await self._stopped(client)) is not None:
                return stopped
            try:
                with console.err.status("planning"):
                    accepted = await client.submit(self._request)
                    return accepted if accepted.remembered is not None else await client.planned(accepted.id)
            except asyncio.CancelledError:
                await self._cancel(client)
                raise

    async def _stopped(self, client: FleetClient) -> Stopped | None:
        """Carry the instruction out when it is a stop."""
        text = self._request.instruction
        if not mentions_stop(text):
            return None
        there = False
        with contextlib.suppress(UnreachableError):
            await client.gateway()
            there = True
        if (stop := stop_request(text, roster_of(client))) is None:
            return None
        # Without a gateway nobody knows the names: then all robots that hear it stop.
        names = (*stop.robots, *(stop.unknown if there else ()))
        return await Stopped.carry_out(client, names, why=text)

    async def _approve(self, plan_hash: str, edited: Plan | None) -> TaskRecord:
        async with FleetClient(self._where.endpoint()) as client:
            record = await client.approve(self._request.id, plan_hash=plan_hash, plan=edited)
            console.err.print(f"task {record.id} is approved")
            if not self._wait:
                return record
            try:
                return await follow(client, record.id, plan_shown=True)
            except asyncio.CancelledError:
                await self._cancel(client)
                raise

    async def _reject(self, plan_hash: str) -> TaskRecord:
        async with FleetClient(self._where.endpoint()) as client:
            return await client.reject(self._request.id, plan_hash=plan_hash)

    async def _follow(self, client: FleetClient) -> TaskRecord:
        if not self._quiet:
            return await follow(client, self._request.id)
        last: TaskRecord | None = None
        held = ""
        async for record in client.watch(self._request.id):
            last, held = record, console.tell_held(record, held)
        assert last is not None  # noqa: S101 - watch yields at least the final record
        return last

    async def _cancel(self, client: FleetClient) -> None:
        """Cancel the task after an interrupt; that it cannot be done is said, and the command ends as interrupted."""
        task = self._request.id
        console.err.print(f"cancelling task {task}")
        try:
            await client.cancel(task)
        except NotFoundError:
            console.err.print(f"task {task} had not been accepted")
        except SwiftbotError as error:
            console.err.print(f"task {task} may go on: {error}")

    # --- editing ----------------------------------------------------------------------------------------------

    def _edited(self, plan: Plan) -> Plan | None:
        """Have a plan edited as JSON; None when it is not valid or nothing was changed."""
        with tempfile.TemporaryDirectory(prefix="swiftbot-") as folder:
            file = Path(folder, "plan.json")
            before = msgspec.json.format(msgspec.json.encode(replace(plan, provenance=None)), indent=2)
            file.write_bytes(before)
            editor = os.environ.get("VISUAL") or os.environ.get("EDITOR") or "vi"
            try:
                subprocess.run([*shlex.split(editor), str(file)], check=True)
                after = file.read_bytes()
                if after.strip() == before.strip():
                    return None
                edited = read_plan_file(after)
                problems = asyncio.run(self._problems(edited))
            except (OSError, ValueError, subprocess.SubprocessError, SwiftbotError) as error:
                console.err.print(f"the plan stays as it was: {error}")
                return None
        for problem in problems:
            console.err.print(f"invalid plan: {problem}")
        return None if problems else edited

    async def _problems(self, plan: Plan) -> tuple[str, ...]:
        async with FleetClient(self._where.endpoint()) as client:
            return (await client.check_plan(plan, task=self._request.id)).problems


def on_terminal() -> bool:
    """Return whether a person can be asked."""
    return sys.stdin.isatty() and sys.stdout.isatty()


def _answer(question: str) -> Literal["yes", "no", "edit"]:
    try:
        prompt = f"{question} [y]es, [N]o, [e]dit: "
        said = console.out.input(prompt, markup=False, emoji=False).strip().casefold()
    except (EOFError, KeyboardInterrupt):
        console.out.print()
        return "no"
    if said in ("y", "yes"):
        return "yes"
    return "edit" if said in ("e", "edit") else "no"


LOOK_S = 0.5


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
