"""The warm containers of a fleet: `swiftbot pool …`."""

import asyncio
from typing import Annotated

from cyclopts import App, Parameter

from appliance import console
from appliance.cli.common import HERE, WORK, Json, Where, Why, show
from appliance.client import FleetClient
from appliance.errors import ConfigError, Exit
from appliance.pool.api import WarmAsk
from appliance.reasons import why_text
from appliance.tasks.views import why

pool_app = App(name="pool", help="Warm containers: what there is, why it was chosen, and what is kept.", group=WORK)

Gateway = Annotated[str, Parameter(help="Which gateway's pool.")]


def add_to(app: App) -> None:
    """Add these commands."""
    app.command(pool_app)


@pool_app.default
@pool_app.command(name="list")
def pool_list(*, as_json: Json = False, where: Where = HERE) -> int:
    """Show the warm containers of all gateways."""

    async def go() -> None:
        async with FleetClient(where.endpoint()) as client:
            await client.gateway()
            by_gateway = client.plane.registry.containers
            found = [each for name in sorted(by_gateway) for each in by_gateway[name].values()]
        show(found, as_json=as_json, table=console.container_table(found))

    asyncio.run(go())
    return 0


@pool_app.command(name="why")
def pool_why(task: str, subtask: str = "", *, as_json: Json = False, where: Where = HERE) -> int:
    """Show for each attempt which gateway decided, what it weighed, and why it took what it took.

    Args:
        task: The task.
        subtask: One of its subtasks; all when none is given.
        as_json: Print JSON.
        where: The fleet.
    """

    async def go() -> None:
        async with FleetClient(where.endpoint()) as client:
            found = why(await client.task(task), subtask)
        show(found, as_json=as_json, table=why_text(found))

    asyncio.run(go())
    return 0


@pool_app.command(name="warm")
def pool_warm(
    image: str,
    *,
    count: int = 1,
    keep: float = 600.0,
    wait: float = 30.0,
    gateway: Gateway = "",
    why: Why = "",
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Have containers of an image ready; returns when they are, 1 when there are fewer by then.

    Args:
        image: Name of the image, such as base.
        count: How many, besides those that work.
        keep: For how long they are kept, seconds.
        wait: How long to wait until they are ready, seconds; 0: not at all.
        gateway: Which gateway's pool; any when none is given.
        why: Why, for the audit.
        as_json: Print JSON.
        where: The fleet.
    """

    async def go() -> bool:
        async with FleetClient(where.endpoint()) as client:
            name = gateway or await client.gateway()
            found = await client.pool_warm(name, WarmAsk(image=image, count=count, keep_s=keep, wait_s=wait, why=why))
        show(
            {"gateway": name, "image": found.image, "ready": found.ready, "starting": found.starting}
            | ({"problem": found.problem} if found.problem else {}),
            as_json=as_json,
            table=f"{name}: {found.ready} of {found.image} ready, {found.starting} starting"
            + (f"; {found.problem}" if found.problem else ""),
        )
        return found.ready >= count or not wait

    return Exit.DONE if asyncio.run(go()) else Exit.FAILED


@pool_app.command(name="evict")
def pool_evict(name: str, *, gateway: Gateway = "", why: Why = "", as_json: Json = False, where: Where = HERE) -> int:
    """Give up one idle container, or all idle ones of an image.

    Args:
        name: A container's id, or the beginning of it; or an image.
        gateway: Of which gateway; without, the one that holds the container, or all for an image.
        why: Why, for the audit.
        as_json: Print JSON.
        where: The fleet.
    """

    async def go() -> None:
        async with FleetClient(where.endpoint()) as client:
            found = await client.pool_evict(name, gateway, why=why)
        rows = [
            {"gateway": each, "evicted": list(answer.containers), "kept": answer.kept, "note": answer.note}
            for each, answer in sorted(found.items())
        ]
        show(rows, as_json=as_json, table=console.evicted_text(found))

    asyncio.run(go())
    return 0


@pool_app.command(name="release")
def pool_release(
    image: str, *, gateway: Gateway = "", why: Why = "", as_json: Json = False, where: Where = HERE
) -> int:
    """Start containers of an image again that is in quarantine because it kept failing.

    Args:
        image: Name of the image.
        gateway: On which gateway; all where it is in quarantine when none is given.
        why: Why, for the audit.
        as_json: Print JSON.
        where: The fleet.
    """

    async def go() -> None:
        async with FleetClient(where.endpoint()) as client:
            found = await client.pool_release(image, gateway, why=why)
        rows = [{"gateway": each, "image": image, "reason": found[each].reason} for each in sorted(found)]
        lines = [f"{each}: {image} is started again; it was left alone: {found[each].reason}" for each in sorted(found)]
        show(rows, as_json=as_json, table="\n".join(lines))

    asyncio.run(go())
    return 0


@pool_app.command(name="decisions")
def pool_decisions(*, limit: int = 30, gateway: Gateway = "", as_json: Json = False, where: Where = HERE) -> int:
    """Show what pools started and gave up lately, and why.

    Args:
        limit: How many at most, newest first.
        gateway: Of which gateway; all when none is given.
        as_json: Print JSON.
        where: The fleet.
    """
    if limit < 1:
        raise ConfigError(f"--limit {limit} shows nothing", remedy="at least 1")

    async def go() -> None:
        async with FleetClient(where.endpoint()) as client:
            found, silent = await client.pool_decisions(limit, gateway)
        for name, error in sorted(silent.items()):
            console.err.print(f"{name} did not answer: {error.message}", markup=False)
        rows = sorted(
            ((name, each) for name, answer in found.items() for each in answer.decisions),
            key=lambda row: row[1].at_ns,
            reverse=True,
        )[:limit]
        told = [
            {
                "gateway": name, "at_ns": each.at_ns, "what": each.what, "image": each.image,
                "container": each.container, "why": each.why,
            }
            for name, each in rows
        ]  # fmt: skip
        show(told, as_json=as_json, table=console.decision_table(rows))

    asyncio.run(go())
    return 0
