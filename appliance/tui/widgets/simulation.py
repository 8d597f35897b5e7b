"""A plan on simulated robots, watched: the dialog runs `swiftbot task simulate` and shows what it prints.

It is a process of its own, since simulators are no part of the product, and a fleet is started and removed by it: it is
interrupted, never killed, and goes on removing that when the dialog is left.
"""

import asyncio
import contextlib
import importlib.util
import os
import signal
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Sequence

from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding
from textual.containers import Vertical
from textual.screen import ModalScreen
from textual.widgets import Label, Static

from appliance.connection import Endpoint
from appliance.errors import PrerequisiteError
from appliance.tui.safe import safe
from appliance.tui.widgets import Pane

MOST_LINES = 400
_LONGEST_LINE = 4000


def command_of(task: str, endpoint: Endpoint) -> tuple[str, ...]:
    """Return the command that simulates a task's plan; PrerequisiteError where the simulators are not installed."""
    if importlib.util.find_spec("workshop") is None:
        raise PrerequisiteError(
            "there are no simulators on this machine", remedy="install swiftbot-workshop here, or use `:estimate`"
        )
    connect = (each for one in endpoint.connect for each in ("--connect", one))
    keys = ("--keys", endpoint.keys) if endpoint.keys else ()
    return (sys.executable, "-m", "appliance.cli", "task", "simulate", task, "--fleet", endpoint.fleet, *connect, *keys)


class SimulationDialog(ModalScreen[None]):
    """Shows what the simulation says while it runs; Esc ends it.

    Args:
        task: whose plan.
        command: what simulates it.
    """

    BINDINGS = [Binding("escape,q", "leave", "Leave")]

    def __init__(self, task: str, command: Sequence[str]) -> None:
        super().__init__()
        self._subject = task
        self._command = tuple(command)
        self._lines: deque[str] = deque(maxlen=MOST_LINES)
        self._process: subprocess.Popen[bytes] | None = None

    def compose(self) -> ComposeResult:
        """Make the dialog."""
        with Vertical(classes="dialog"):
            yield Label(Text(f"Simulation of {safe(self._subject, 64)}: no real robot moves"), classes="title")
            with Pane(id="plan-box"):
                yield Static(id="content")
            yield Static("Esc ends it", id="hint")

    def on_mount(self) -> None:
        """Begin."""
        self.query_one(Pane).focus()
        self.run_worker(self._run(), exclusive=True)

    async def _run(self) -> None:
        width = max(40, self.query_one(Pane).size.width - 4)
        try:
            # Not asyncio's: that kills the process when the terminal UI ends, while it still removes its fleet.
            process = self._process = subprocess.Popen(  # noqa: ASYNC220 - it begins at once
                self._command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                env={**os.environ, "COLUMNS": str(width), "NO_COLOR": "1", "TERM": "dumb"},
                start_new_session=True,  # the end of the terminal does not end it half way
            )
        except OSError as error:
            self._add(f"it cannot be started: {error.strerror}")
            return
        waiting = threading.Thread(target=process.wait, name="simulation", daemon=True)
        waiting.start()
        reader = asyncio.StreamReader()
        pipe, _ = await asyncio.get_running_loop().connect_read_pipe(
            lambda: asyncio.StreamReaderProtocol(reader), process.stdout
        )
        try:
            with contextlib.suppress(ValueError):  # a line longer than the buffer: nothing that is printed here
                async for line in reader:
                    self._add(line.decode(errors="replace").rstrip())
            await asyncio.to_thread(waiting.join)
        finally:
            self._interrupt()
            pipe.close()
        code = process.returncode
        self.query_one("#hint", Static).update(
            "Esc leaves" if code == 0 else f"ended with exit code {code}; Esc leaves"
        )

    def _add(self, line: str) -> None:
        self._lines.append(safe(line, _LONGEST_LINE, blanks=True))
        self.query_one("#content", Static).update(Text("\n".join(self._lines)))
        self.query_one(Pane).scroll_end(animate=False)

    def _interrupt(self) -> None:
        """Have it end and remove its fleet, unless it has ended."""
        if self._process is not None and self._process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._process.pid, signal.SIGINT)

    def action_leave(self) -> None:
        """Close it; what is still simulated is ended."""
        self.dismiss(None)
