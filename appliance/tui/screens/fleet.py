"""The screen of the fleet: its gateways, what is wrong with them in whole sentences, and the recorders."""

from rich.text import Text
from textual import on
from textual.app import ComposeResult
from textual.widgets import Static

from appliance.tui.drawing import Cell, age, bar
from appliance.tui.frame import FleetScreen
from appliance.tui.grid import Column, Grid
from appliance.tui.keys import bindings
from appliance.tui.safe import safe
from appliance.tui.screens.condition import gateway_notes, gateway_state, recorder_notes
from appliance.tui.screens.gateway import GatewayScreen
from appliance.tui.store import Gateway, Store

GATEWAYS = (
    Column(title="gateway", width=9, grow=True),
    Column(title="state", width=12),
    Column(title="load", width=4, right=True),
    Column(title="cpu", width=4, right=True),
    Column(title="mem", width=5, right=True),
    Column(title="pool", width=5, right=True),
    Column(title="runs", width=5, right=True),
    Column(title="tasks", width=5, right=True),
    Column(title="link", width=7, right=True),
    Column(title="arc", width=4, right=True),
    Column(title="version", width=7),
    Column(title="up", width=5, right=True, drop=1),
    Column(title="busy", width=16, drop=2),
    Column(title="robots", width=16, grow=True, drop=3),
)
"""All that is to be told of a gateway stands at 80 columns, beside a scroll bar."""
_MOST_NOTES = 6


def gateway_cells(gateway: Gateway, now_ns: int = 0) -> tuple[Cell, ...]:
    """Return the cells of a gateway's row."""
    each = gateway.status
    dim = "dim" if gateway.lost_ns else ""
    return (
        (safe(each.id, 63), f"bold {dim}"),
        gateway_state(gateway),
        (f"{each.load:.0%}", dim or _hot(each.load)),
        (f"{each.cpu_percent:.0f}%", dim),
        (f"{each.memory_mb:.0f}M", dim),
        (f"{each.ready}/{each.containers}", dim),
        (f"{each.running}+{each.queue}" if each.queue else str(each.running), dim),
        (str(each.tasks), dim),
        ("" if gateway.latency_ms is None else f"{gateway.latency_ms:.1f}ms", dim),
        ("" if gateway.arc is None else f"{gateway.arc:.0%}", dim),
        (safe(each.version, 12), dim),
        (age(each.started_ns, now_ns), dim),
        (bar(each.load, 10), dim or _hot(each.load)),
        (safe(", ".join(each.robots), 80), dim),
    )


def _hot(load: float) -> str:
    return "red" if load >= 0.9 else "yellow" if load >= 0.7 else ""


class FleetOverview(FleetScreen):
    """All gateways; Enter shows one whole."""

    scope = "fleet"
    shows = ("gateways", "recorders")
    BINDINGS = bindings("fleet")
    DEFAULT_CSS = """
    FleetOverview #notes { height: auto; max-height: 8; padding: 0 1; }
    """

    def body(self) -> ComposeResult:
        """Make the parts."""
        yield Grid(GATEWAYS, gateway_cells, id="gateways", empty="no gateway is known yet")
        yield Static(id="notes")

    def draw_body(self, store: Store) -> None:
        """Show the gateways by name."""
        rows = {name: store.gateways[name] for name in sorted(store.gateways)}
        shown = self.filtered(rows, _text)
        empty = "no gateway matches the filter" if rows else "no gateway is known yet"
        self.query_one("#gateways", Grid).show(shown, empty=empty)
        lines = gateway_notes(rows.values())
        more = len(lines) - _MOST_NOTES
        if more > 0:
            lines = [
                *lines[:_MOST_NOTES],
                Text(f"… {more} more of the same kind: Enter on a gateway shows its own", "dim"),
            ]
        lines += recorder_notes(store.recorders[name] for name in sorted(store.recorders))
        self.say("#notes", Text("\n").join(lines))

    def chosen(self) -> dict[str, str]:
        """Return the selected gateway."""
        selected = self.query_one("#gateways", Grid).selected
        return {} if selected is None else {"gateway": selected}

    @on(Grid.Picked)
    def drill(self, event: Grid.Picked) -> None:
        """Show one gateway whole."""
        self.application.push_screen(GatewayScreen(event.key))


def _text(name: str, gateway: Gateway) -> str:
    status = gateway.status
    return f"{name} {gateway_state(gateway)[0]} {status.version} {' '.join(status.robots)} {status.pool_problem}"
