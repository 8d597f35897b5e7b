"""The main job, once through on a local fleet: instructions in, plans, live progress, results, log, replay.

It is what a newcomer runs first, so it checks what it shows: it succeeds only if every task succeeded and the
replayed log ends in the same states.
"""

import asyncio
import contextlib
import time
from collections.abc import Sequence
from pathlib import Path

from rich.text import Text

from appliance import console
from appliance.cli.submit import follow
from appliance.client import FleetClient
from appliance.connection import FleetState
from appliance.errors import SwiftbotError
from appliance.model import TaskRecord, TaskRequest, TaskState
from appliance.plane.settings import PlaneConfig
from appliance.tasks.replay import ReplayReport, replay
from workshop import local_fleet
from workshop.local_fleet import Order

INSTRUCTIONS = (
    "Rover_1: go to dock 3, photograph the red box, detect red boxes and report to the operator",
    (
        "Drone_1 take off to 10 m, go to goal 2 and land, while Rover_1 fetches the red box from dock 3 "
        "and places it at dock 2"
    ),
)
"""One sequential for one robot, one with two robots in parallel."""


async def run(order: Order, *, asks: Sequence[str], tui: bool = False, keep: bool = False) -> bool:
    """Run the demonstration; True only if all of it went well.

    Args:
        order: the fleet to start.
        asks: instructions beside its own two.
        tui: open the terminal UI on the running fleet afterwards.
        keep: leave the fleet running.
    """
    began = time.monotonic()
    with contextlib.suppress(SwiftbotError):
        await local_fleet.down(order.directory, progress=_say)
    log_files = set((order.directory / "record").glob("*.mcap"))
    state = await local_fleet.up(order, progress=_say)
    good = True
    try:
        async with FleetClient(state.endpoint) as client:
            console.out.print(
                console.gateway_table(sorted(client.plane.registry.gateways.values(), key=lambda g: g.id))
            )
            for ask in (*INSTRUCTIONS, *asks):
                record = await _one(client, ask)
                good = good and record.state is TaskState.SUCCEEDED
        if tui:
            from appliance.tui.app import run_tui  # noqa: PLC0415 - Textual is only wanted here

            await run_tui(PlaneConfig(mode="client", connect=state.endpoints), state.fleet)
    finally:
        if keep:
            _say(f"the fleet goes on: `swiftbot --help`; end it with `swiftbot down --dir {order.directory}`")
            await asyncio.sleep(1.5)
        else:
            await local_fleet.down(order.directory, progress=_say)
    reports = _replay(state, log_files)
    good = good and bool(reports) and all(report.same for report in reports)
    verdict = "all succeeded, and the replayed log ends in the same states" if good else "NOT all of it went well"
    console.out.print(Text(f"{verdict} ({time.monotonic() - began:.1f} s)", style="bold green" if good else "bold red"))
    return good


def _say(text: str) -> None:
    console.out.print(Text(f"· {text}", style="dim"))


async def _one(client: FleetClient, instruction: str) -> TaskRecord:
    """Submit one instruction, show its plan, its progress and its results."""
    console.out.rule(style="dim")
    console.out.print(Text(f"“{instruction}”", style="bold"))
    accepted = await client.submit(TaskRequest(instruction=instruction, submitter="demo"))
    return await follow(client, accepted.id)


def _replay(state: FleetState, before: set[Path]) -> list[ReplayReport]:
    reports: list[ReplayReport] = []
    for path in sorted(set(Path(state.record_dir).glob("*.mcap")) - before):
        console.out.print(f"log: {path} ({path.stat().st_size:,} bytes)")
        try:
            report = replay(path)
        except SwiftbotError as error:
            console.out.print(Text(f"  {error}", style="red"))
            continue
        console.out.print(console.replay_summary(report))
        reports.append(report)
    return reports
