"""The warm containers of a fleet: `swiftbot pool …`. Its orders are made from the registry of operations."""

from typing import Annotated

from cyclopts import App, Parameter

from appliance import console
from appliance.cli.common import HERE, WORK, Json, Where, show
from appliance.errors import ConfigError, Exit
from appliance.operations import not_answered, task_and_subtask
from appliance.reasons import why_text
from appliance.tasks.views import why

pool_app = App(name="pool", help="List, warm and evict containers, and explain why they were chosen.", group=WORK)


def add_to(app: App) -> None:
    """Add this group."""
    app.command(pool_app)


@pool_app.default
@pool_app.command(name="list")
async def pool_list(*, as_json: Json = False, where: Where = HERE) -> int:
    """List the warm containers of all gateways."""
    async with where.client() as client:
        await client.gateway()
        by_gateway = client.plane.registry.containers
        found = [container for name in sorted(by_gateway) for container in by_gateway[name].values()]
    show(found, as_json=as_json, table=console.container_table(found))
    return Exit.DONE


@pool_app.command(name="why")
async def pool_why(task: str, /, *, as_json: Json = False, where: Where = HERE) -> int:
    """Explain placement, for each attempt: candidates, scores, choice.

    Args:
        task: Task, or one of its subtasks as TASK/SUBTASK.
    """
    task, subtask = task_and_subtask(task)
    async with where.client() as client:
        found = why(await client.task(task), subtask)
    show(found, as_json=as_json, table=why_text(found))
    return Exit.DONE


@pool_app.command(name="decisions")
async def pool_decisions(
    *,
    limit: Annotated[int, Parameter(help="How many at most, newest first.")] = 30,
    gateway: Annotated[str, Parameter(help="Which gateway's; all if not given.")] = "",
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """List what pools started and evicted lately, and why."""
    if limit < 1:
        raise ConfigError(f"--limit {limit} shows nothing", remedy="at least 1")
    async with where.client() as client:
        found, failed = await client.pool_decisions(limit, gateway)
    for note in not_answered(failed):
        console.err.print(note)
    rows = sorted(
        ((name, decision) for name, answer in found.items() for decision in answer.decisions),
        key=lambda row: row[1].at_ns,
        reverse=True,
    )[:limit]
    listed = [
        {
            "gateway": name, "at_ns": decision.at_ns, "what": decision.what, "image": decision.image,
            "container": decision.container, "why": decision.why,
        }
        for name, decision in rows
    ]  # fmt: skip
    show(listed, as_json=as_json, table=console.decision_table(rows))
    return Exit.DONE
