"""How states look: a glyph, a word and a style for each, so that none depends on colour alone. Pure.

Styles are the names of the terminal's colours used as parts: green is well, yellow works or warns, red is broken, cyan
is about to be, magenta leaves or was called off, `dim` is past or idle. What each looks like is a matter of the theme
(`themes`). A state that this version does not know is shown by its own name.
"""

from msgspec import Struct

from appliance.tui.safe import safe


class Sign(Struct, frozen=True):
    """A glyph of one cell, a word, a style."""

    glyph: str
    word: str
    style: str

    @property
    def text(self) -> str:
        """Glyph and word."""
        return f"{self.glyph} {self.word}"


_TASKS = {
    "accepted": Sign("○", "accepted", "cyan"),
    "proposed": Sign("◇", "proposed", "yellow"),
    "running": Sign("●", "running", "yellow"),
    "cancelling": Sign("◌", "cancelling", "magenta"),
    "succeeded": Sign("✔", "succeeded", "green"),
    "failed": Sign("✘", "failed", "red"),
    "cancelled": Sign("⊘", "cancelled", "magenta"),
}
_SUBTASKS = {
    "waiting": Sign("·", "waiting", "dim"),
    "ready": Sign("○", "ready", "cyan"),
    "dispatched": Sign("◔", "dispatched", "cyan"),
    "running": Sign("●", "running", "yellow"),
    "succeeded": Sign("✔", "succeeded", "green"),
    "failed": Sign("✘", "failed", "red"),
    "cancelled": Sign("⊘", "cancelled", "magenta"),
}
_CONTAINERS = {
    "starting": Sign("◔", "starting", "cyan"),
    "ready": Sign("✔", "ready", "green"),
    "reserved": Sign("○", "reserved", "cyan"),
    "busy": Sign("●", "busy", "yellow"),
    "draining": Sign("◌", "draining", "magenta"),
    "dead": Sign("✘", "dead", "red"),
}
_RUNS = {
    "running": Sign("●", "running", "yellow"),
    "paused": Sign("◇", "paused", "cyan"),
    "succeeded": Sign("✔", "succeeded", "green"),
    "failed": Sign("✘", "failed", "red"),
    "stopped": Sign("⊘", "stopped", "magenta"),
}
_CLIENTS = {
    "idle": Sign("·", "idle", "dim"),
    "waiting": Sign("◔", "waiting", "cyan"),
    "training": Sign("●", "training", "yellow"),
    "late": Sign("▲", "late", "yellow"),
    "done": Sign("✔", "done", "green"),
    "left out": Sign("✘", "left out", "red"),
    "absent": Sign("✘", "absent", "red"),
    "excluded": Sign("⊘", "excluded", "magenta"),
    "ended": Sign("·", "ended", "dim"),
}
_LEVELS = {
    "debug": Sign("·", "debug", "dim"),
    "info": Sign(" ", "info", ""),
    "notice": Sign("✉", "notice", "green"),
    "warning": Sign("▲", "warning", "yellow"),
    "error": Sign("✘", "error", "red"),
    "exception": Sign("✘", "error", "red"),
    "critical": Sign("✘", "critical", "bold red"),
}
LEGEND = (
    "· waiting  ○ about to  ◇ waits for a person  ◔ sent or starting  ● works  ✔ well  "
    "✘ broken  ▲ warns  ◌ leaving  ⊘ called off  ? unknown"
)
"""What the glyphs mean, for the help."""


def _of(known: dict[str, Sign], state: object) -> Sign:
    name = str(state)
    return known.get(name) or Sign("?", safe(name, 20) or "unknown", "bold")


def task(state: object) -> Sign:
    """Return the sign of a task's state."""
    return _of(_TASKS, state)


def subtask(state: object) -> Sign:
    """Return the sign of a subtask's state."""
    return _of(_SUBTASKS, state)


def container(state: object) -> Sign:
    """Return the sign of a container's state."""
    return _of(_CONTAINERS, state)


def run(state: object) -> Sign:
    """Return the sign of the state of a run of federated learning."""
    return _of(_RUNS, state)


def client(state: object) -> Sign:
    """Return the sign of what a client of such a run is at."""
    return _of(_CLIENTS, state)


def level(name: object) -> Sign:
    """Return the sign of a log level."""
    return _of(_LEVELS, name)
