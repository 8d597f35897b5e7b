"""Orders on tasks that an operator gives from the terminal UI; each ends in the record as it is then."""

from rich.console import RenderableType

from appliance.client import FleetClient
from appliance.errors import PayloadError
from appliance.model import TaskRecord, TaskState
from appliance.reasons import why_text
from appliance.steering import cancel_outcome
from appliance.tasks.migration.api import MigrateAsk
from appliance.tui.action import Given


def split_subtask(text: str) -> tuple[str, str]:
    """Return task and subtask of `t-1/s2`.

    Raises:
        PayloadError: it is not written so.
    """
    task, _, subtask = text.partition("/")
    if not task or not subtask:
        raise PayloadError(f"{text[:60]!r} is no subtask", remedy="write task/subtask, such as t-1/s2")
    return task, subtask


async def cancel(fleet: FleetClient, given: Given, _by: str) -> TaskRecord | str:
    """Stop a task."""
    record = await fleet.cancel(given["task"], why=given.get("why", ""))
    # The record is shown in its row at once; what is none of its own doing is said in words.
    return record if record.state in (TaskState.CANCELLING, TaskState.CANCELLED) else cancel_outcome(record)


async def why(fleet: FleetClient, given: Given, _by: str) -> RenderableType:
    """Tell why a task or subtask waits, or was served where it was."""
    task, _, subtask = given["task"].partition("/")
    return why_text(await fleet.why(task, subtask))


async def migrate(fleet: FleetClient, given: Given, _by: str) -> str:
    """Move a subtask's run to another gateway."""
    task, subtask = split_subtask(given["subtask"])
    ask = MigrateAsk(task=task, subtask=subtask, to=given.get("gateway", ""), why=given.get("why", ""))
    moved = await fleet.migrate(ask)
    if not moved.moved:
        return f"{moved.subtask} was not moved: {moved.why}"
    state = "started there" if moved.started else "not yet started there"
    return f"{moved.subtask} moved from {moved.source} to {moved.target}, {state} after {moved.took_ms:.0f} ms"


async def pause(fleet: FleetClient, given: Given, _by: str) -> TaskRecord:
    """Start no further subtask."""
    return await fleet.pause(given["task"], why=given.get("why", ""))


async def hold(fleet: FleetClient, given: Given, _by: str) -> TaskRecord:
    """The same, and end runs that go on from a checkpoint later."""
    return await fleet.pause(given["task"], hold=True, why=given.get("why", ""))


async def resume(fleet: FleetClient, given: Given, _by: str) -> TaskRecord:
    """Let it go on."""
    return await fleet.resume(given["task"], why=given.get("why", ""))


async def retry(fleet: FleetClient, given: Given, _by: str) -> TaskRecord:
    """Try again what failed."""
    return await fleet.retry(given["task"], why=given.get("why", ""))


async def retry_subtask(fleet: FleetClient, given: Given, _by: str) -> TaskRecord:
    """Try one subtask again."""
    task, subtask = split_subtask(given["subtask"])
    return await fleet.retry(task, subtask, why=given.get("why", ""))
