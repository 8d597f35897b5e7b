"""`swiftbot submit`: an instruction, from the command line to its end or until it is planned.

A stop in words is carried out at once; on a terminal the plan is shown before it runs. It runs an event loop for each
step by itself: between two of them a person is asked, and Ctrl-C must end the question.
"""

import asyncio
import os
import shlex
import subprocess
import tempfile
import uuid
from collections.abc import Coroutine
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from cyclopts import App, Parameter
from cyclopts.validators import Number
from msgspec.structs import replace

from appliance import console
from appliance.cli.common import HERE, WORK, Json, Where, on_terminal, show
from appliance.cli.stop import reported_unconfirmed, show_stopped
from appliance.cli.submit_file import submit_file
from appliance.client import FleetClient, Stopped, read_plan_file
from appliance.connection import operator_name
from appliance.errors import ConfigError, Exit, NotFoundError, SwiftbotError, UnapprovedError
from appliance.llm.stop_words import stop_request
from appliance.model import PLAIN_PRIORITY, Approval, Plan, SubtaskState, TaskRecord, TaskRequest, TaskState
from appliance.tasks.views import view


def add_to(app: App) -> None:
    """Add this command."""
    app.command(submit, group=WORK)


def submit(
    text: str = "",
    /,
    *,
    file: Annotated[
        Path | None,
        Parameter(help="Submit the tasks of a file instead: an instruction or a task as JSON in each line."),
    ] = None,
    wait: Annotated[
        bool,
        Parameter(help="Show progress and wait for the end. Ctrl-C offers to detach or cancel; in scripts it cancels."),
    ] = False,
    task_id: Annotated[str, Parameter(name="--id", help="Task ID; submitting the same one twice is one task.")] = "",
    priority: Annotated[
        int | None,
        Parameter(
            help=f"Priority, 0 (lowest) to 9; if not given {PLAIN_PRIORITY}, of a file {PLAIN_PRIORITY - 1}.",
            validator=Number(gte=0, lte=9),
        ),
    ] = None,
    deadline: Annotated[
        float,
        Parameter(help="Seconds from now after which it fails; 0: none.", validator=Number(gte=0)),
    ] = 0.0,
    group: Annotated[tuple[str, ...], Parameter(help="A gateway that may run it; repeatable. None: any.")] = (),
    approval: Annotated[
        Approval, Parameter(help="Whether its plan needs approval before it runs (`task approve`).")
    ] = Approval.NEVER,
    yes: Annotated[bool, Parameter(name=("--yes", "-y"), help="Run the plan without showing it first.")] = False,
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Submit an instruction. Returns once planned; --wait follows it.

    On a terminal the plan is shown before it runs and runs when it is confirmed; in scripts the policy of the fleet
    decides which plans wait for approval. A text that says to stop ("stop", "halt", "rover_1: stop") is not a task: it
    is the soft stop, at once, of the robots named, else of all, as `swiftbot stop` does it.

    With --file each line is a JSON text (the instruction) or an object with `instruction` and any of `id`, `priority`,
    `deadline_s`, `group`, `approval`, `plan`; the options count for lines that do not say it. Tasks are accepted in
    their order, as fast as the fleet takes them; a line that is wrong is named and the others go on. Returns when all
    are accepted; Ctrl-C stops before.
    """
    if (file is None) == (not text) or (file is not None and wait):
        raise ConfigError(
            "--wait is for a single instruction" if text or wait else "there is no instruction",
            remedy="give TEXT, or --file without --wait",
        )
    if priority is None:
        priority = PLAIN_PRIORITY if file is None else PLAIN_PRIORITY - 1
    # The id is chosen here: an interrupt while the task is being submitted must know what to cancel.
    request = TaskRequest(
        instruction=text,
        id=task_id or ("" if file is not None else f"t-{uuid.uuid4().hex[:10]}"),
        submitter=operator_name(),
        priority=priority,
        deadline_s=deadline,
        group=group,
        approval=approval,
    )
    if file is not None:
        return submit_file(file, request, where, as_json=as_json)
    shown = not yes and not as_json and on_terminal()
    with reported_unconfirmed(stop_request(text) is not None):
        submitting = Submitting(request, where, wait=wait, quiet=as_json)
        found = submitting.run_shown() if shown else submitting.run()
    if isinstance(found, Stopped):
        return show_stopped(found, as_json=as_json)
    if as_json or not wait or found.state is TaskState.CANCELLED or found.remembered is not None:
        show(view(found), as_json=as_json, table=console.task_table(found))
    return exit_code(found)


def exit_code(record: TaskRecord) -> int:
    """Return the exit code for how a task ended."""
    if record.failure is not None and record.failure.code == UnapprovedError.code:
        return Exit.REJECTED
    if record.state in (TaskState.FAILED, TaskState.CANCELLED) and _rejected(record):
        return Exit.REJECTED
    if record.state is TaskState.FAILED:
        return Exit.REFUSED if record.failure is not None and record.failure.code == "plan" else Exit.FAILED
    return Exit.CANCELLED if record.state is TaskState.CANCELLED else Exit.DONE


def _rejected(record: TaskRecord) -> bool:
    return record.decision is not None and not record.decision.approved


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
        self._asks = wait and not quiet and on_terminal()
        """Whether a person is asked what an interrupt means; a script's Ctrl-C cancels the task."""
        self._following = False

    def run(self) -> TaskRecord | Stopped:
        """Submit it; the policy of the fleet decides whether its plan waits for approval."""
        return self._followed(self._run())

    def _followed(self, work: Coroutine[Any, Any, TaskRecord | Stopped]) -> TaskRecord | Stopped:
        """Carry work out that ends in following the task; on Ctrl-C a person says what becomes of the task.

        Raises:
            KeyboardInterrupt: it is cancelled, or nobody can be asked.
        """
        while True:
            try:
                return asyncio.run(work)
            except KeyboardInterrupt:
                if not self._following:
                    raise
            task = self._request.id
            match interrupted(task):
                case "detach":
                    console.err.print(f"detached: task {task} continues; `swiftbot task watch {task}` follows it")
                    return asyncio.run(self._looked())
                case "wait":
                    work = self._again()
                case _:
                    asyncio.run(self._called_off())
                    raise KeyboardInterrupt

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
                    return self._followed(self._approve(plan_hash, edited))
                case "no":
                    return asyncio.run(self._reject(plan_hash))
                case "edit":
                    edited = self._edited(edited or plan) or edited

    # --- steps ------------------------------------------------------------------------------------------------

    async def _run(self) -> TaskRecord | Stopped:
        async with self._where.client() as client:
            if (stopped := await Stopped.by_words(client, self._request.instruction)) is not None:
                return stopped
            try:
                accepted = await client.submit(self._request)
                if accepted.remembered is not None:
                    console.err.print(f"task {accepted.id} was submitted before and is not started again")
                    return accepted
                console.err.print(f"task {accepted.id} is accepted")
                if self._wait:
                    return await self._follow(client)
                planned = await client.planned(accepted.id)
            except asyncio.CancelledError:
                if self._wait and not self._following:
                    await self._cancel(client)
                raise
            if planned.state is TaskState.PROPOSED:
                console.err.print(console.held_text(planned))
            return planned

    async def _propose(self) -> TaskRecord | Stopped:
        async with self._where.client() as client:
            if (stopped := await Stopped.by_words(client, self._request.instruction)) is not None:
                return stopped
            try:
                with console.err.status("planning"):
                    accepted = await client.submit(self._request)
                    return accepted if accepted.remembered is not None else await client.planned(accepted.id)
            except asyncio.CancelledError:
                await self._cancel(client)
                raise

    async def _approve(self, plan_hash: str, edited: Plan | None) -> TaskRecord:
        async with self._where.client() as client:
            record = await client.approve(self._request.id, plan_hash=plan_hash, plan=edited)
            console.err.print(f"task {record.id} is approved")
            if not self._wait:
                return record
            self._following = self._asks
            try:
                return await follow(client, record.id, plan_shown=True)
            except asyncio.CancelledError:
                if not self._following:
                    await self._cancel(client)
                raise

    async def _again(self) -> TaskRecord:
        async with self._where.client() as client:
            return await follow(client, self._request.id, plan_shown=True)

    async def _looked(self) -> TaskRecord:
        async with self._where.client() as client:
            return await client.task(self._request.id)

    async def _called_off(self) -> None:
        async with self._where.client() as client:
            await self._cancel(client)

    async def _reject(self, plan_hash: str) -> TaskRecord:
        async with self._where.client() as client:
            return await client.reject(self._request.id, plan_hash=plan_hash)

    async def _follow(self, client: FleetClient) -> TaskRecord:
        self._following = self._asks
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
        async with self._where.client() as client:
            return (await client.check_plan(plan, task=self._request.id)).problems


def interrupted(task: str) -> Literal["detach", "cancel", "wait"]:
    """Ask what an interrupt means; a second one cancels the task, Ctrl-D or the loss of the terminal detaches."""
    try:
        said = console.err.input(f"\ntask {task} runs: [d]etach (it continues), [c]ancel it, [W]ait on? ", markup=False)
    except EOFError:
        console.err.print()
        return "detach"
    except KeyboardInterrupt:
        console.err.print()
        return "cancel"
    match said.strip().casefold():
        case "d" | "detach":
            return "detach"
        case "c" | "cancel":
            return "cancel"
        case _:
            return "wait"


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
