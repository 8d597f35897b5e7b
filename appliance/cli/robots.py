"""Robots: `swiftbot robots …`: who there is, MAVLink links, taking one over by hand, conformance of its program."""

import getpass
import os
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter
from cyclopts.validators import Number
from msgspec.structs import replace
from rich.console import Group
from rich.markup import escape
from rich.table import Table

from appliance import console
from appliance.cli.common import HERE, WORK, Json, Where, Why, fields, show
from appliance.cli.drive import robots_drive
from appliance.client import FleetClient
from appliance.errors import ConfigError, ConflictError, Exit, NotFoundError, RefusedError, SwiftbotError
from appliance.model import Lease, RobotInfo, SubtaskState, TaskState
from appliance.model.gateways import queues
from appliance.model.keys import check_name
from appliance.model.robot_api import LinkAdd, LinkFacts, LinkList, LinkRemove, MavlinkLink, RobotForget, Standing
from appliance.robots.authority.soft_stop import Stops
from appliance.robots.conformance import Conformance, Operator, Seen, is_present
from appliance.times import until_of

robots_app = App(name="robots", help="List robots, take them over, check them, manage MAVLink links.", group=WORK)
links_app = App(name="links", help="List, add and remove the MAVLink links of gateways.")
robots_app.command(links_app)


def add_to(app: App) -> None:
    """Add these commands."""
    robots_app.command(robots_drive, name="drive")
    app.command(robots_app)


@robots_app.default
@robots_app.command(name="list")
async def robots_list(*, as_json: Json = False, where: Where = HERE) -> int:
    """List the robots: whether each is online, stopped, or taken over. Exit code 1: stops are not known."""
    async with where.client() as client:
        await client.gateway()
        found, unsure = await robots_now(client)
    held = {each.id: "; ".join(filter(None, (each.stopped, each.taken_over, each.maintenance))) for each in found}
    if unsure:
        held = dict.fromkeys(held, "stops not known")
    show(found, as_json=as_json, table=console.robot_table(found, held))
    if unsure:
        console.err.print(f"which robots are stopped or taken over is not known: {unsure}", markup=False)
    return Exit.FAILED if unsure else Exit.DONE


@robots_app.command(name="queue")
async def robots_queue(robot: str = "", *, as_json: Json = False, where: Where = HERE) -> int:
    """List the tasks that robots do and that wait for them, in order; `swiftbot task first` puts one before others.

    Args:
        robot: Of this one alone.
        as_json: Print JSON.
        where: The fleet.
    """
    async with where.client() as client:
        await client.gateway()
        roster, members = client.plane.registry.robots, client.plane.members()
        if robot and robot not in roster:
            raise NotFoundError(f"no robot {robot[:60]!r}", remedy="`swiftbot robots` lists them")
        statuses = [each for name, each in client.plane.registry.gateways.items() if name in members]
    found = [each for each in queues(statuses) if robot in ("", each.robot)]
    show(found, as_json=as_json, table=console.queue_table(found))
    return Exit.DONE


async def robots_now(client: FleetClient) -> tuple[list["RobotShown"], str]:
    """Return the robots by name with what holds each; and why that is not known, where no gateway answered that."""
    unsure = ""
    try:
        standing = await client.standing()
        closures = (await client.closures()).closures
    except SwiftbotError as error:
        standing, closures, unsure = None, (), error.message
    robots = sorted(client.plane.registry.robots.values(), key=lambda each: each.id)
    kept_out = {each.name: each.text for each in closures if each.kind == "robot"}
    return [replace(robot_shown(each, standing), maintenance=kept_out.get(each.id)) for each in robots], unsure


class RobotShown(RobotInfo, frozen=True, kw_only=True):
    """A robot as it describes itself, and what holds it."""

    stopped: str | None = None
    """The soft stop that holds it, in words; null: none."""
    taken_over: str | None = None
    """Which operator has taken it over, in words; null: nobody."""
    maintenance: str | None = None
    """Who has taken it out of use, why and until when, in words; null: it is in use."""
    stops_known: bool = True
    """False: no gateway answered what holds it, so that `stopped`, `taken_over` and `maintenance` say nothing."""


def robot_shown(robot: RobotInfo, standing: Standing | None) -> RobotShown:
    """Return a robot with what holds it; without an answer that is not known."""
    if standing is None:
        return RobotShown(**fields(robot), stops_known=False)
    stops = Stops()
    stops.merge(standing.stops, standing.lifted)
    stop = stops.of(robot.id)
    leases = [each.text for each in standing.leases if each.robot == robot.id and not each.ended]
    return RobotShown(**fields(robot), stopped=stop.text if stop else None, taken_over="; ".join(leases) or None)


@robots_app.command(name="maintain")
async def robots_maintain(
    robot: str,
    /,
    *,
    until: Annotated[str, Parameter(help="When it ends by itself: 14:00, 2026-12-01, or a duration such as 2h.")] = "",
    end: Annotated[bool, Parameter(help="End it: tasks may command the robot again.")] = False,
    why: Why = "",
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Take a robot into maintenance: no plan uses it and no task commands it; `robots takeover` still moves it.

    Args:
        robot: Its name as the list shows it.
    """
    if end and until:
        raise ConfigError("give --until or --end", remedy="leave one of them out")
    until_ns = until_of(until)
    async with where.client() as client:
        if end:
            done = await client.reopen("robot", robot, why=why)
        else:
            done = await client.maintain(robot, until_ns=until_ns, why=why)
    show(
        done,
        as_json=as_json,
        table=f"{robot} is in use again; it was {done.text}" if end else f"{robot} is {done.text}",
    )
    return Exit.DONE


@robots_app.command(name="forget")
async def robots_forget(robot: str, /, *, as_json: Json = False, where: Where = HERE) -> int:
    """Forget a robot that is offline; it is listed again once it is heard.

    Args:
        robot: Its name as the list shows it.
    """
    async with where.client() as client:
        done = await client.robot_forget(RobotForget(robot=robot, by=_who()))
    if as_json:
        show(done, as_json=True)
    else:
        console.out.print(f"{done.gateway} forgot {done.robot}", markup=False)
    return 0


Gateway = Annotated[str, Parameter(help="Gateway ID; needed if there are several.")]


@links_app.default
@links_app.command(name="list")
async def robots_links(*, gateway: Gateway = "", as_json: Json = False, where: Where = HERE) -> int:
    """List MAVLink links: rates, senders with their losses, latency, refused frames, routes."""
    async with where.client() as client:
        found, failed = await client.robot_links(gateway)
    show([found[name] for name in sorted(found)], as_json=as_json, table=links_tables(found))
    for name, error in sorted(failed.items()):
        console.err.print(f"{name} does not answer: {error}", markup=False)
    return Exit.DONE if found else Exit.UNREACHABLE


@links_app.command(name="add")
async def robots_link_add(
    url: str,
    /,
    *,
    gateway: Gateway = "",
    connect: Annotated[bool, Parameter(help="Connect to the address instead of listening.")] = False,
    signing: str = "",
    only_in: tuple[str, ...] = (),
    not_in: tuple[str, ...] = (),
    only_out: tuple[str, ...] = (),
    not_out: tuple[str, ...] = (),
    prefix: str = "drone_",
    mavlink1: bool = False,
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Add a MAVLink link to a running gateway; it is kept over restarts.

    Args:
        url: udp://host:port, tcp://host:port, or serial:/dev/ttyUSB0:57600.
        signing: File on the gateway with the link's MAVLink 2 signing key.
        only_in: Message received there that may be forwarded to other links; repeatable.
        not_in: Message that may not; repeatable.
        only_out: Message of other links that may be sent there; repeatable.
        not_out: Message that may not; repeatable.
        prefix: Prefix of the names of vehicles there, before their system ID.
        mavlink1: Send MAVLink 1 only.
    """
    serial = url.startswith("serial:")
    link = MavlinkLink(
        listen="" if connect or serial else url, connect=url if connect or serial else "", signing=signing,
        only_in=only_in, not_in=not_in, only_out=only_out, not_out=not_out, prefix=prefix, mavlink1=mavlink1,
    )  # fmt: skip
    link.check()

    async with where.client() as client:
        name = await _only(client, gateway)
        facts = await client.robot_link_add(name, LinkAdd(link=link, by=_who()))
    if as_json:
        show(facts, as_json=True)
    else:
        console.out.print(f"{name} has {facts.url}, also after a restart", markup=False)
    return 0


@links_app.command(name="remove")
async def robots_link_remove(url: str, /, *, gateway: Gateway = "", as_json: Json = False, where: Where = HERE) -> int:
    """Remove a MAVLink link of a running gateway for good, also one of its configuration.

    Args:
        url: The link as the list shows it.
    """
    async with where.client() as client:
        name = await _only(client, gateway)
        facts = await client.robot_link_remove(name, LinkRemove(url=url, by=_who()))
    if as_json:
        show(facts, as_json=True)
    else:
        console.out.print(f"{name} no longer has {facts.url}", markup=False)
    return 0


def _who() -> str:
    return f"{getpass.getuser()} on {os.uname().nodename}"


async def _only(client: FleetClient, gateway: str) -> str:
    """Return the gateway that is meant; RefusedError when it must be said which."""
    await client.gateway()
    if gateway:
        return gateway
    members = sorted(client.plane.members())
    if len(members) > 1:
        raise RefusedError(
            f"there are {len(members)} gateways", remedy=f"give --gateway with one of {', '.join(members)}"
        )
    return members[0]


@robots_app.command(name="qgc-actions")
def robots_qgc_actions(*, config: Path, out: Path | None = None) -> int:
    """Write QGroundControl's custom actions file: a button for each task template of a gateway.

    Args:
        config: The gateway's TOML file, with robots.templates.
        out: File to write, for QGroundControl's CustomActions folder; if not given, it is printed.
    """
    from appliance import config as configuration
    from appliance.robots.qgc import actions

    robots = configuration.load(config).robots
    if not robots.templates:
        raise ConfigError(f"{config} has no robots.templates", remedy="see docs/robots.md, Tasks by MAVLink")
    data = actions(robots.templates, component=robots.component_id)
    if out is None:
        sys.stdout.write(data.decode())
        return 0
    try:
        out.write_bytes(data)
    except OSError as error:
        raise ConfigError(f"{out} cannot be written: {error.strerror}", remedy="name another file") from error
    console.out.print(f"{out}: {len(robots.templates)} tasks", markup=False)
    return 0


def links_tables(found: Mapping[str, LinkList]) -> Group:
    """Return a table of the links, one of their senders, and one of the routes."""
    links = Table("gateway", "link", "ends", "in/s", "out/s", "B/s in", "latency ms", "refused", "", box=None)
    senders = Table("gateway", "link", "sender", "frames", "lost", "loss", "late", "repeated", "silent s", box=None)
    routes = Table("gateway", "sender", "was heard last on", box=None)
    for name, each in sorted(found.items()):
        for link in each.links:
            links.add_row(name, link.url, str(len(link.ends)), *_figures(link), _note(link))
            for one in link.senders:
                senders.add_row(
                    name, link.url, f"{one.system}/{one.component}", f"{one.received:,}", f"{one.lost:,}",
                    f"{one.loss:.1%}", str(one.late), str(one.repeated), f"{one.silent_s:g}",
                )  # fmt: skip
        for sender, where in each.routes.items():
            routes.add_row(name, sender, where)
    return Group(*(each for each in (links, senders, routes) if each is links or each.row_count))


def _figures(link: LinkFacts) -> tuple[str, str, str, str, str]:
    refused = sum(link.refused.values())
    latency = ", ".join(f"{each.mean_ms:.1f}" for each in link.latency) or "–"
    return f"{link.in_hz:,.0f}", f"{link.out_hz:,.0f}", f"{link.in_bytes_s:,.0f}", latency, f"{refused:,}"


def _note(link: LinkFacts) -> str:
    """Return what else is to be said of a link."""
    said = ["listens" if link.listens else "connects"]
    if link.signed:
        said.append("signed")
    if link.added:
        said.append("added at run time")
    if link.problem:
        said.append(link.problem)
    said += [f"a storm of {each} is damped" for each in link.damped]
    return ", ".join(said + [f"{kind} {count}" for kind, count in sorted(link.refused.items())])


STEP_S = 0.5

LeaseId = Annotated[str, Parameter(name="--lease", help="ID of the lease, as `robots takeover` printed it.")]


@robots_app.command(name="renew")
async def robots_renew(robot: str, /, *, lease: LeaseId, as_json: Json = False, where: Where = HERE) -> int:
    """Renew the lease of a robot that was taken over.

    Args:
        robot: Robot ID.
    """
    async with where.client() as client:
        found = await client.renew(Lease(id=lease, robot=robot))
    show(found, as_json=as_json, table=f"renewed {robot} for {found.lease_s:g} s")
    return 0


@robots_app.command(name="move")
async def robots_move(
    robot: str,
    /,
    *,
    lease: LeaseId,
    forward: float = 0.0,
    left: float = 0.0,
    up: float = 0.0,
    turn: float = 0.0,
    seconds: Annotated[float, Parameter(name="--for", validator=Number(gt=0, lte=60))] = 0.5,
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Move a robot that was taken over; it holds afterwards, or when this command ends.

    Args:
        robot: Which robot.
        lease: The lease.
        forward: Metres a second ahead; negative: back.
        left: To its left; negative: to its right.
        up: Up, of one that flies.
        turn: Degrees a second to the right.
        seconds: For how long.
    """
    velocity = {"forward_mps": forward, "left_mps": left, "up_mps": up, "turn_dps": turn}

    async with where.client() as client:
        held = Lease(id=lease, robot=robot)
        until = time.monotonic() + seconds
        while True:
            left_s = until - time.monotonic()
            for_s = max(0.05, min(STEP_S, left_s))
            reply = await client.drive(held, "velocity", **velocity, for_s=for_s)
            if left_s <= STEP_S:
                break
            await client.renew(held)
    show(reply.result, as_json=as_json, table=f"{robot} is at {reply.result.get('pose')}")
    return 0


@robots_app.command(name="release")
async def robots_release(
    robot: str, /, *, lease: LeaseId, why: Why = "", as_json: Json = False, where: Where = HERE
) -> int:
    """Release a robot that was taken over: it holds, then its tasks continue.

    Args:
        robot: Which robot.
        lease: The lease.
    """
    async with where.client() as client:
        found = await client.give_back(Lease(id=lease, robot=robot), why=why)
    show(found, as_json=as_json, table=f"{robot} is {found.ended}")
    return 0


_LEASE_S = 60.0
_WHY = "conformance check"
_GOTO_S = 30.0
_SLOW_S = 2.0
_MARKS = {"passed": "[green]✔[/green]", "failed": "[red]✘[/red]", "skipped": "[yellow]–[/yellow]"}


@robots_app.command(name="check")
async def robots_check(
    robot: str,
    /,
    *,
    moves: Annotated[bool, Parameter(help="Also drive the robot a metre and back.")] = False,
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Check that the program of a Zenoh robot conforms to the contract (docs/robot-contract.md).

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
            console_of.print(f"  hint: {one.remedy}", markup=False, highlight=False)

    async with where.client() as client:
        await client.gateway()
        await _may_be_checked(client, robot)
        checks = Conformance(client.plane.session, robot, _operator(client, robot), on_begin=begin, on_seen=seen)
        report = await checks.run(moves=moves)
    if as_json:
        show(report, as_json=True)
    else:
        failed = sum(each.outcome == "failed" for each in report.checks)
        verdict = "conforms to the contract" if report.passed else f"fails {failed} of {len(report.checks)} checks"
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
            each.state is SubtaskState.RUNNING and robot in each.robots for each in task.subtasks
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
