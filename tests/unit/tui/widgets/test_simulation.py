"""The dialog in which a simulation is watched."""

import asyncio
import sys
from pathlib import Path

import pytest
from textual.app import App
from textual.widgets import Static

from appliance.connection import Endpoint
from appliance.errors import PrerequisiteError
from appliance.tui.widgets import simulation
from appliance.tui.widgets.simulation import SimulationDialog, command_of

pytestmark = pytest.mark.anyio
SAYS = "print('begins \\x1b[2J [/red]', flush=True); import sys; sys.exit(3)"
ENDS_WELL = """
import pathlib, sys, time
print("runs", flush=True)
try:
    time.sleep(60)
except KeyboardInterrupt:
    pathlib.Path(sys.argv[1]).write_text("removed")
"""


def shown(app: App[None], name: str) -> str:
    """Return the text of a part of the dialog."""
    return str(app.screen.query_one(name, Static).content)


async def test_what_it_prints_is_shown_and_its_end_told() -> None:
    """Escape sequences and markup are shown, not obeyed; a failure has its exit code."""
    app = App[None]()
    async with app.run_test() as pilot:
        await app.push_screen(SimulationDialog("t-1", (sys.executable, "-c", SAYS)))
        while "exit code 3" not in shown(app, "#hint"):
            await pilot.pause(0.02)
        assert "begins" in shown(app, "#content")
        assert "[/red]" in shown(app, "#content")
        assert "\x1b" not in shown(app, "#content")
        await pilot.press("escape")
        assert not isinstance(app.screen, SimulationDialog)


async def test_leaving_it_has_the_simulation_clean_up(tmp_path: Path) -> None:
    """The process is interrupted, not killed: it removes its fleet."""
    left = tmp_path / "left"
    app = App[None]()
    async with app.run_test() as pilot:
        command = ("env", "--default-signal=INT", sys.executable, "-c", ENDS_WELL, str(left))
        await app.push_screen(SimulationDialog("t-1", command))
        while "runs" not in shown(app, "#content"):
            await pilot.pause(0.02)
        await pilot.press("escape")
        async with asyncio.timeout(20):
            while not (left.exists() and left.read_text()):
                await asyncio.sleep(0.02)


def test_the_command_names_the_fleet_and_the_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    """It reaches what the terminal UI is connected to; without simulators it says what to install."""
    endpoint = Endpoint(fleet="yard", connect=("tls/a:1", "tls/b:1"), keys="ann.keys")
    assert command_of("t-1", endpoint)[3:] == (
        "task", "simulate", "t-1", "--fleet", "yard", "--connect", "tls/a:1", "--connect", "tls/b:1",
        "--keys", "ann.keys",
    )  # fmt: skip
    monkeypatch.setattr(simulation.importlib.util, "find_spec", lambda _: None)
    with pytest.raises(PrerequisiteError, match="no simulators"):
        command_of("t-1", endpoint)
