"""The screen of replay: opens a recorded log and drives all other screens by it, with play, pause, seek and rate."""

import time
from pathlib import Path

from rich.text import Text
from textual import on
from textual.app import ComposeResult
from textual.widgets import Static

from appliance.tui.actions import bindings
from appliance.tui.base_screen import FleetScreen
from appliance.tui.formatting import Cell, clock, counted, file_size
from appliance.tui.replay import LogFile, ReplayView, find_logs, told
from appliance.tui.safe import safe
from appliance.tui.store import Store
from appliance.tui.widgets.grid import Column, Grid

FILES = (
    Column(title="recorded log", width=24, grow=True),
    Column(title="written", width=19),
    Column(title="size", width=9, right=True),
    Column(title="folder", width=20, grow=True, drop=1),
)
TICK_S = 0.25


def file_cells(each: LogFile) -> tuple[Cell, ...]:
    """Return the row of a file."""
    return (
        (safe(each.path.name, 120), "bold"),
        time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(each.written_s)),
        file_size(each.size),
        safe(str(each.path.parent), 200),
    )


def timeline(share: float, width: int) -> str:
    """Return a line with the place in it."""
    width = max(3, width)
    at = min(width - 1, max(0, round(share * (width - 1))))
    return f"{'━' * at}●{'─' * (width - 1 - at)}"


class ReplayScreen(FleetScreen):
    """Recorded logs, and the one that is open."""

    scope = "replay"
    shows = ("connection",)
    BINDINGS = bindings("replay")

    def __init__(self) -> None:
        super().__init__()
        self._files: dict[str, LogFile] = {}
        self._about_said: object = None

    def body(self) -> ComposeResult:
        """Make the parts."""
        yield Static(id="about")
        yield Grid(FILES, file_cells, id="files", empty="no recorded log was found: `:open FILE` opens one")

    def on_mount(self) -> None:
        """Look for logs, draw the clock."""
        self._look()
        self.set_interval(TICK_S, self._tick)

    def on_screen_resume(self) -> None:
        """Look again: a recorder may have begun another file."""
        if self.ready:
            self._look()

    def _look(self) -> None:
        self._files = {str(each.path): each for each in find_logs(self.host.config.logs, self.view.fleet)}
        self.flush(force=True)

    @property
    def replay(self) -> ReplayView | None:
        """The log that is open."""
        view = self.view
        return view if isinstance(view, ReplayView) else None

    def _tick(self) -> None:
        if self.is_current:
            self._draw_about()

    def draw_body(self, store: Store) -> None:
        """Show the place in the log, and the logs there are."""
        _ = store
        shown = self.filtered(self._files, lambda name, _: name)
        self.query_one("#files", Grid).show(shown)
        self._draw_about()

    def _draw_about(self) -> None:
        about = self.query_one("#about", Static)
        replay = self.replay
        if replay is None:
            text = Text("Enter opens a recorded log: all screens show it then, as it was.", "dim")
        else:
            text = self._about(replay)
        if text != self._about_said:
            self._about_said = text
            about.update(text)

    def _about(self, replay: ReplayView) -> Text:
        head, now = replay.head, time.monotonic()
        at_s, length_s = head.position_s(now), head.length_s
        state = "… reading" if replay.reading else "‖ paused" if head.paused else "▶ plays"
        share = at_s / length_s if length_s else 1.0
        out = Text.assemble(
            (state, "bold" if head.paused else "bold yellow"),
            f" {told(at_s)} of {told(length_s)} · {head.rate:g}x · {clock(head.position_ns(now))}",
            f" · fleet {safe(replay.fleet, 40)}\n",
            (f"{timeline(share, max(10, self.size.width - 2))}\n", "cyan"),
            f"{safe(Path(replay.about.path).name, 80)}: {counted(replay.about.messages, 'message')} on "
            f"{counted(len(replay.about.channels), 'key')}",
        )
        if replay.about.dropped:
            out.append(f", {replay.about.dropped:,} were not recorded", "yellow")
        if replay.refused:
            out.append(f", {replay.refused:,} could not be read", "yellow")
        for problem in replay.problems[:3]:
            out.append(f"\n▲ {safe(problem, 200)}", "yellow")
        if replay.problem:
            out.append(f"\n✘ {safe(replay.problem, 200)}", "red")
        return out

    # --- actions ---------------------------------------------------------------------------------------------------

    @on(Grid.Picked)
    def _picked(self, event: Grid.Picked) -> None:
        event.stop()
        self.host.run_line(f'open "{event.key}"')
