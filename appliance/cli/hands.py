"""Take a robot over by hand: `swiftbot robots take`, `renew`, `move`, `give`."""

import asyncio
import time
from typing import Annotated

from cyclopts import App, Parameter
from cyclopts.validators import Number

from appliance.cli.common import HERE, Json, Where, show
from appliance.cli.robots import robots_app
from appliance.client import FleetClient
from appliance.model import Lease, RobotReply
from appliance.robots.api import LEASE_S

STEP_S = 0.5

LeaseId = Annotated[str, Parameter(name="--lease", help="Id of the lease, as `robots take` printed it.")]


def add_to(app: App) -> None:
    """Add these commands; they hang below `robots`."""
    del app


@robots_app.command(name="take")
def robots_take(
    robot: str,
    *,
    lease: Annotated[float, Parameter(help="Seconds until it ends by itself.", validator=Number(gte=1, lte=120))] = (
        3 * LEASE_S
    ),
    why: str = "",
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Take a robot over: it holds, its tasks wait, and only commands with the lease move it until that ends.

    Args:
        robot: Which robot.
        lease: Seconds until it ends by itself.
        why: Why, for the audit and for the tasks that wait.
        as_json: Print JSON.
        where: The fleet.
    """

    async def go() -> None:
        async with FleetClient(where.endpoint()) as client:
            found = await client.take_over(robot, lease_s=lease, why=why)
        text = f"{robot} is yours for {found.lease_s:g} s: --lease {found.id}"
        show(found, as_json=as_json, table=text)

    asyncio.run(go())
    return 0


@robots_app.command(name="renew")
def robots_renew(robot: str, *, lease: LeaseId, as_json: Json = False, where: Where = HERE) -> int:
    """Keep a robot that was taken over for as long again."""

    async def go() -> None:
        async with FleetClient(where.endpoint()) as client:
            found = await client.renew(Lease(id=lease, robot=robot))
        show(found, as_json=as_json, table=f"{robot} is yours for {found.lease_s:g} s more")

    asyncio.run(go())
    return 0


@robots_app.command(name="move")
def robots_move(
    robot: str,
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
    """Move a robot that was taken over; it holds when the time is over, or this command ends.

    Args:
        robot: Which robot.
        lease: The lease.
        forward: Metres a second ahead; negative: back.
        left: To its left; negative: to its right.
        up: Up, of one that flies.
        turn: Degrees a second to the right.
        seconds: For how long.
        as_json: Print JSON.
        where: The fleet.
    """
    velocity = {"forward_mps": forward, "left_mps": left, "up_mps": up, "turn_dps": turn}

    async def go() -> RobotReply:
        async with FleetClient(where.endpoint()) as client:
            held = Lease(id=lease, robot=robot)
            until = time.monotonic() + seconds
            while True:
                left_s = until - time.monotonic()
                for_s = max(0.05, min(STEP_S, left_s))
                reply = await client.drive(held, "velocity", **velocity, for_s=for_s)
                if left_s <= STEP_S:
                    return reply
                await client.renew(held)

    reply = asyncio.run(go())
    show(reply.result, as_json=as_json, table=f"{robot} is at {reply.result.get('pose')}")
    return 0


@robots_app.command(name="give")
def robots_give(robot: str, *, lease: LeaseId, why: str = "", as_json: Json = False, where: Where = HERE) -> int:
    """Give a robot back to the tasks; it holds first.

    Args:
        robot: Which robot.
        lease: The lease.
        why: Why, for the audit.
        as_json: Print JSON.
        where: The fleet.
    """

    async def go() -> None:
        async with FleetClient(where.endpoint()) as client:
            found = await client.give_back(Lease(id=lease, robot=robot), why=why)
        show(found, as_json=as_json, table=f"{robot} is {found.ended}")

    asyncio.run(go())
    return 0
