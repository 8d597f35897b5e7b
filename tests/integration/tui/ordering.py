"""What tests of orders do again and again at a terminal UI, and what they wait for."""

import asyncio
from collections.abc import Callable

import pytest
from moving_bench import pretty

from appliance.client import FleetClient
from appliance.model import SubtaskState, TaskRecord, TaskState
from appliance.tui.screens.review import ReviewScreen
from appliance.tui.widgets.dialogs import ConfirmDialog

from .operating import LONG_S, Operator

ENDLESS = 4000
"""Steps of a run that is ended before it has made them."""

TOUR = "rover_1: go to dock 3, then go to dock 2"


def is_told(order: tuple[str, str], told: set[tuple[str, str]]) -> bool:
    """Whether an order stands in the audit. What follows `:stop` and names no robot is why as well."""
    return any(verb == order[0] and why.endswith(order[1]) for verb, why in told)


async def record_of(client: FleetClient, task: str, holds: Callable[[TaskRecord], object]) -> TaskRecord:
    """Wait until a task's record is so; after a minute, fail with how it is."""
    record: TaskRecord | None = None
    try:
        async with asyncio.timeout(LONG_S):
            while not holds(record := await client.task(task)):
                await asyncio.sleep(0.1)
    except TimeoutError:
        pytest.fail(f"it never came to be so: {pretty(record)}")
    return record


def running(record: TaskRecord) -> bool:
    """Whether a subtask of it runs. How far it is, a record tells no oftener than it is written for other reasons."""
    return any(each.state is SubtaskState.RUNNING for each in record.subtasks)


def final(record: TaskRecord) -> bool:
    """Whether it has ended."""
    return record.state.final


async def select(ann: Operator, task: str) -> None:
    """Go to a task on the screen of tasks."""
    await ann.press("2")
    await ann.until(lambda: task in ann.store.tasks)
    with ann.app._context():
        ann.app.show_task(task)
    await ann.until(lambda: ann.chosen.get("task") == task)


async def confirm(ann: Operator, *words: str) -> None:
    """Read a question, and say yes."""
    await ann.until(lambda: isinstance(ann.app.screen, ConfirmDialog))
    await ann.see(*words)
    await ann.press("y")


async def proposed(ann: Operator, client: FleetClient, instruction: str = TOUR) -> TaskRecord:
    """Submit an instruction for review; its record once the plan waits and is looked at."""
    await ann.press("s")
    await ann.see("Instruction")
    await ann.write(instruction)
    await ann.press("enter")
    await ann.see("Enter runs this plan")
    await ann.press("f2")
    await ann.until(lambda: isinstance(ann.app.screen, ReviewScreen))
    screen = ann.app.screen
    assert isinstance(screen, ReviewScreen)
    record = await record_of(client, screen.task_id, lambda record: record.state is TaskState.PROPOSED)
    await ann.see("waits for approval", "goto")
    return record
