"""Robots: `swiftbot robots …`."""

import asyncio
import getpass
import os
import sys
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from appliance import console
from appliance.cli.common import HERE, WORK, Json, Where, show
from appliance.client import FleetClient
from appliance.errors import ConfigError, Exit, RefusedError, SwiftbotError
from appliance.robots.api import Forgotten, LinkAdd, LinkFacts, LinkList, LinkRemove, RobotForget
from appliance.robots.settings import MavlinkLink

robots_app = App(name="robots", help="Robots: who there is, their MAVLink links, and buttons.", group=WORK)
links_app = App(name="links", help="MAVLink links of gateways: what goes over them; add and remove them.")
robots_app.command(links_app)


def add_to(app: App) -> None:
    """Add these commands."""
    app.command(robots_app)


@robots_app.default
@robots_app.command(name="list")
def robots_list(*, as_json: Json = False, where: Where = HERE) -> int:
    """Show the robots."""

    async def go() -> None:
        async with FleetClient(where.endpoint()) as client:
            await client.gateway()
            found = sorted(client.plane.registry.robots.values(), key=lambda each: each.id)
        show(found, as_json=as_json, table=console.robot_table(found))

    asyncio.run(go())
    return 0


@robots_app.command(name="forget")
def robots_forget(robot: str, *, as_json: Json = False, where: Where = HERE) -> int:
    """Remove the row of a robot that is offline; it comes back when it is heard again.

    Args:
        robot: Its name as the list shows it.
    """

    async def go() -> Forgotten:
        async with FleetClient(where.endpoint()) as client:
            return await client.robot_forget(RobotForget(robot=robot, by=_who()))

    done = asyncio.run(go())
    if as_json:
        show(done, as_json=True)
    else:
        console.out.print(f"{done.gateway} has forgotten {done.robot}", markup=False)
    return 0


Gateway = Annotated[str, Parameter(help="The gateway; needed only where there are several.")]


@links_app.default
@links_app.command(name="list")
def robots_links(*, gateway: Gateway = "", as_json: Json = False, where: Where = HERE) -> int:
    """Show MAVLink links: rates, senders with their losses, latency, what was refused, routes."""
    from appliance.cli.links import links_tables

    async def go() -> tuple[dict[str, LinkList], dict[str, SwiftbotError]]:
        async with FleetClient(where.endpoint()) as client:
            return await client.robot_links(gateway)

    found, failed = asyncio.run(go())
    show([found[name] for name in sorted(found)], as_json=as_json, table=links_tables(found))
    for name, error in sorted(failed.items()):
        console.err.print(f"{name} does not answer: {error}", markup=False)
    return Exit.DONE if found else Exit.UNREACHABLE


@links_app.command(name="add")
def robots_link_add(
    url: str,
    *,
    gateway: Gateway = "",
    connect: Annotated[bool, Parameter(negative="", help="Connect to the address instead of listening.")] = False,
    signing: str = "",
    only_in: tuple[str, ...] = (),
    not_in: tuple[str, ...] = (),
    only_out: tuple[str, ...] = (),
    not_out: tuple[str, ...] = (),
    prefix: str = "drone_",
    mavlink1: Annotated[bool, Parameter(negative="")] = False,
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Open a MAVLink link on a running gateway; it is kept over restarts.

    Args:
        url: udp://host:port, tcp://host:port, or serial:/dev/ttyUSB0:57600.
        signing: File on the gateway with the link's MAVLink 2 signing key.
        only_in: Message heard there that may go on to other links; may be given several times.
        not_in: But not this one.
        only_out: Message of other links that may be sent there.
        not_out: But not this one.
        prefix: Names of vehicles heard there: this and their system id.
        mavlink1: Send MAVLink 1 alone, to what understands no other.
    """
    serial = url.startswith("serial:")
    link = MavlinkLink(
        listen="" if connect or serial else url, connect=url if connect or serial else "", signing=signing,
        only_in=only_in, not_in=not_in, only_out=only_out, not_out=not_out, prefix=prefix, mavlink1=mavlink1,
    )  # fmt: skip
    link.check()

    async def go() -> tuple[str, LinkFacts]:
        async with FleetClient(where.endpoint()) as client:
            name = await _only(client, gateway)
            return name, await client.robot_link_add(name, LinkAdd(link=link, by=_who()))

    name, facts = asyncio.run(go())
    if as_json:
        show(facts, as_json=True)
    else:
        console.out.print(f"{name} has {facts.url}, also after a restart", markup=False)
    return 0


@links_app.command(name="remove")
def robots_link_remove(url: str, *, gateway: Gateway = "", as_json: Json = False, where: Where = HERE) -> int:
    """Close a MAVLink link of a running gateway for good, also one of its configuration.

    Args:
        url: The link as the list shows it.
    """

    async def go() -> tuple[str, LinkFacts]:
        async with FleetClient(where.endpoint()) as client:
            name = await _only(client, gateway)
            return name, await client.robot_link_remove(name, LinkRemove(url=url, by=_who()))

    name, facts = asyncio.run(go())
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
            f"there are {len(members)} gateways", remedy=f"say --gateway with one of {', '.join(members)}"
        )
    return members[0]


@robots_app.command(name="qgc-actions")
def robots_qgc_actions(*, config: Path, out: Path | None = None) -> int:
    """Write QGroundControl's custom actions file: a button for each task template of a gateway.

    Args:
        config: The gateway's TOML file, whose robots.templates are meant.
        out: File to write, for QGroundControl's CustomActions folder; printed when not given.
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
