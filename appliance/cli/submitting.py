"""What `swiftbot submit` does: a stop at once, a plan that is shown before it runs, a task that is followed."""

import asyncio
import contextlib
import os
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Literal

import msgspec
from msgspec.structs import replace

from appliance import console
from appliance.cli.common import Where
from appliance.client import FleetClient
from appliance.errors import NotFoundError, SwiftbotError, UnreachableError
from appliance.llm.stop_words import mentions_stop, stop_request
from appliance.model import Approval, Plan, SubtaskState, TaskRecord, TaskRequest, TaskState
from appliance.steering import read_plan_file
from appliance.stopping import Stopped, roster_of


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
