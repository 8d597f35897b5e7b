"""Alerts: `swiftbot alerts`, `alerts ack`, `alerts test`."""

import asyncio
import time
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter
from rich.table import Table
from rich.text import Text

from appliance import console
from appliance.alerts.rules import ordered
from appliance.cli.common import HERE, WORK, Json, Where, Why, json_line, on_terminal, show
from appliance.client import FleetClient
from appliance.errors import ConfigError, Exit
from appliance.model.alerts import Alert, AlertLevel
from appliance.operations import ack_these, acked_text
from appliance.reasons import time_of_day

alerts_app = App(name="alerts", help="List and acknowledge alerts: what is wrong or waits for a person.", group=WORK)


def add_to(app: App) -> None:
    """Add this group."""
    app.command(alerts_app)


@alerts_app.default
@alerts_app.command(name="list")
async def alerts_list(
    *,
    watch: Annotated[
        bool, Parameter(help="Also print each change until Ctrl-C; with --json an object per line.")
    ] = False,
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """List the alerts: severity, since when, what, where, what to do, who has acknowledged it."""
    try:
        async with where.client() as client:
            if watch:
                await _watch(client, as_json=as_json)
            found = await client.alerts()
    except asyncio.CancelledError:
        if not watch:
            raise
        return Exit.DONE
    for name in found.unreachable:
        console.err.print(f"{name} did not answer; its alerts may be missing")
    show(found.alerts, as_json=as_json, table=alert_table(found.alerts) if found.alerts else "no alerts")
    return Exit.DONE


async def _watch(client: FleetClient, *, as_json: bool) -> None:
    """Print the alerts there are, then each change, until it is cancelled."""
    changes: asyncio.Queue[Alert] = asyncio.Queue()
    client.on_alert(changes)
    found = await client.alerts()
    told = {each.id: each for each in found.alerts}
    for each in ordered(told.values()):
        _tell(each, as_json=as_json)
    while True:
        alert = await changes.get()
        if told.get(alert.id) != alert:
            told[alert.id] = alert
            _tell(alert, as_json=as_json)


def _tell(alert: Alert, *, as_json: bool) -> None:
    if as_json:
        print(json_line(alert), flush=True)
        return
    at = time_of_day(alert.cleared_ns or (alert.acked.at_ns if alert.acked else 0) or alert.changed_ns)
    said = f"acknowledged by {alert.acked.by}" if alert.acked is not None else str(alert.level)
    state = ("over", "green") if alert.cleared_ns else (said, style_of(alert))
    console.out.print(
        Text.assemble((f"{at} ", "dim"), (f"{state[0]} ", state[1]), (f"{alert.id} ", "bold"), alert.what),
        soft_wrap=True,
    )


def style_of(alert: Alert) -> str:
    """Return the style of an alert's severity; of one that was acknowledged, it is dim."""
    if alert.acked is not None:
        return "dim"
    return "bold red" if alert.level is AlertLevel.CRITICAL else "yellow"


def alert_table(alerts: tuple[Alert, ...]) -> Table:
    """Alerts, a line each, what to do below."""
    table = Table(box=None, pad_edge=False, header_style="bold dim")
    for name in ("severity", "since", "alert", "what", "acknowledged"):
        table.add_column(name, overflow="fold")
    now_ns = time.time_ns()
    for each in alerts:
        left_s = (each.until_ns - now_ns) / 1e9
        what = f"{each.what}; {left_s:.0f} s left" if each.until_ns and left_s > 0 else each.what
        said = f"{each.acked.by}{f': {each.acked.why}' if each.acked.why else ''}" if each.acked is not None else "–"
        table.add_row(Text(str(each.level), style=style_of(each)), time_of_day(each.since_ns), each.id, what, said)
        if each.remedy and each.acked is None:
            table.add_row("", "", "", Text(f"→ {each.remedy}", style="dim"), "")
    return table


@alerts_app.command(name="ack")
async def alerts_ack(
    *alerts: str,
    every: Annotated[
        bool, Parameter(name="--all", help="All that are not acknowledged; on a terminal they are listed first.")
    ] = False,
    yes: Annotated[bool, Parameter(name=("--yes", "-y"), help="With --all: do not list them and ask first.")] = False,
    why: Why = "",
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Acknowledge alerts: they stay listed with your name, and count no more. Exit code 1 when one of them is over.

    Args:
        alerts: IDs, as `swiftbot alerts` shows them.
    """
    if bool(alerts) is every:
        raise ConfigError("name the alerts, or give --all", remedy="`swiftbot alerts` lists them")
    async with where.client() as client:
        if every:
            waiting = tuple(each for each in (await client.alerts()).alerts if each.acked is None)
            if waiting and not yes and not as_json and on_terminal():
                console.out.print(alert_table(waiting))
                if not await _confirmed(len(waiting)):
                    console.err.print("no alert was acknowledged")
                    return Exit.CANCELLED
            outcome = await ack_these(client, [each.id for each in waiting], why=why)
            show(outcome.value, as_json=as_json, table=outcome.text)
            return Exit.DONE
        found = await client.acknowledge(alerts, why=why)
    show(found, as_json=as_json, table=acked_text(found))
    return Exit.FAILED if found.unknown else Exit.DONE


@alerts_app.command(name="test")
async def alerts_test(
    *,
    config: Annotated[Path, Parameter(name="--config", help="The gateway's TOML file.")] = Path(
        "/etc/swiftbot/gateway.toml"
    ),
    as_json: Json = False,
) -> int:
    """Send a test message to each address of alerts.urls_file from this machine. Exit code 1: one did not take it."""
    from appliance.alerts.delivery import read_addresses
    from appliance.config import load

    read = load(config)
    if not read.alerts.urls_file:
        raise ConfigError(
            f"{config} names no addresses for alerts", remedy='set alerts.urls_file = "/etc/swiftbot/alerts.urls"'
        )
    addresses, wrong = await asyncio.to_thread(read_addresses, read.alerts.file)
    told = f"A test by {read.id}: alerts of fleet {read.fleet} are delivered here."
    problems = dict.fromkeys(wrong, "no message was sent there")
    for each in addresses:
        problems[each.name] = await asyncio.to_thread(each.send, f"SwiftBot {read.fleet}: test", told)
    lines = [f"✘ {name}: {problem}" if problem else f"✔ {name}" for name, problem in problems.items()]
    rows = [{"address": name, "taken": not problem, "problem": problem} for name, problem in problems.items()]
    show(rows, as_json=as_json, table=Text("\n".join(lines)))
    return Exit.FAILED if any(problems.values()) else Exit.DONE


async def _confirmed(count: int) -> bool:
    """Ask whether what is listed is acknowledged; the fleet is heard meanwhile."""
    question = f"Acknowledge {'this alert' if count == 1 else f'these {count} alerts'}? [y]es, [N]o: "
    try:
        said = await asyncio.to_thread(console.out.input, question, markup=False, emoji=False)
    except EOFError:
        console.out.print()
        return False
    return said.strip().casefold() in ("y", "yes")
