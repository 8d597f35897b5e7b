"""The log that a real fleet's recorder writes, on all screens of the terminal UI while the fleet goes on."""

import asyncio
import time
from pathlib import Path

import msgspec
import pytest

from appliance.client import FleetClient
from appliance.connection import FleetState
from appliance.model import TaskRecord, TaskRequest, TaskState
from appliance.record.reader import read
from appliance.tui.replay import ReplayView
from appliance.tui.widgets.dialogs import ConfirmDialog

from .operating import LONG_S, Operator, operator

pytestmark = [pytest.mark.anyio, pytest.mark.podman]


def ended(folder: Path, task: str) -> bool:
    """Whether a log of a folder has the end of a task."""
    return any(
        msgspec.json.decode(message.payload, type=TaskRecord).state.final
        for path in folder.glob("*.mcap")
        for message in read(path)
        if message.key.endswith(f"/task/{task}/record") and not message.deleted
    )


def replay(ann: Operator) -> ReplayView:
    """Return the log that is shown."""
    assert isinstance(ann.app.view, ReplayView)
    return ann.app.view


def at_s(ann: Operator) -> float:
    """Seconds into the log."""
    return replay(ann).head.position_s(time.monotonic())


async def test_a_recorded_log_drives_the_screens(fleet: FleetState) -> None:
    """Opened from the list, sought, played, paused, slower and faster, by keys; a stop is the fleet's all the same."""
    folder = Path(fleet.record_dir)
    async with FleetClient(fleet.endpoint) as client:
        await client.submit(TaskRequest(instruction="rover_1: go to dock 1", id="t-past"))
        async with asyncio.timeout(LONG_S):
            while not await asyncio.to_thread(ended, folder, "t-past"):
                await asyncio.sleep(0.5)
        async with operator(fleet, "ann", logs=(str(folder),)) as ann:
            newest = max(folder.glob("*.mcap"), key=lambda path: path.stat().st_mtime)
            await ann.press("8")
            await ann.see(newest.name[:20])
            await ann.press("home", "enter")
            await ann.until(lambda: isinstance(ann.app.view, ReplayView))
            await ann.see("‖ paused", "1x", "messages on")
            assert not ann.app.unlocked

            # Seek: to the end and to the beginning, and ten seconds at a time.
            await ann.line("seek 100%")
            await ann.until(lambda: "t-past" in ann.store.tasks and ann.store.tasks["t-past"].state.final)
            assert ann.store.tasks["t-past"].state is TaskState.SUCCEEDED
            for key, seen in (
                ("1", ("gw-1", "gw-2")),
                ("3", ("rover_1", "rover_2")),
                ("4", ("base",)),
                ("7", ("t-past",)),
            ):
                await ann.press(key)
                await ann.see(*seen)
            await ann.press("2")
            await ann.see("t-past", "succeeded")
            await ann.press("c")
            await ann.see("a recorded log cannot be steered")
            assert not isinstance(ann.app.screen, ConfirmDialog)
            await ann.press("2", "J")
            await ann.write("0")
            await ann.press("enter")
            await ann.until(lambda: at_s(ann) == 0.0 and "t-past" not in ann.store.tasks)
            await ann.press("right")
            await ann.until(lambda: at_s(ann) == min(10.0, replay(ann).head.length_s))
            await ann.press("left")
            await ann.until(lambda: at_s(ann) == 0.0)

            # Play to the end, faster and slower; at the end it stands still.
            await ann.press("plus", "plus", "minus")
            await ann.see("2x")
            await ann.press("space")
            await ann.until(lambda: at_s(ann) > 0.5)
            await ann.press("space")
            await ann.see("RECORDED ‖")
            stood = at_s(ann)
            await ann.line("rate 100")
            await ann.see("100x")
            assert at_s(ann) == stood
            await ann.press("space")
            await ann.until(lambda: at_s(ann) == replay(ann).head.length_s and replay(ann).head.paused)
            await ann.until(lambda: "t-past" in ann.store.tasks and ann.store.tasks["t-past"].state.final)
            await ann.line("rate 1000")
            await ann.see("0.1 to 100")

            # The fleet goes on behind it: a stop is its own, and going back shows it as it is.
            await ann.press("f8")
            await ann.until_true(lambda: _stopped(client))
            await ann.press("L")
            await ann.until(lambda: not isinstance(ann.app.view, ReplayView))
            await ann.see("■")
            await ann.press("W")
            await ann.line("resume-all it was a rehearsal")
            await ann.until(lambda: isinstance(ann.app.screen, ConfirmDialog))
            await ann.press("y")
            await ann.hears("all robots may move again")
            assert not await _stopped(client)


async def _stopped(client: FleetClient) -> bool:
    """Whether a soft stop is in force."""
    return bool((await client.standing()).active)
