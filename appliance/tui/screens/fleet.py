"""The screen of the fleet: its gateways, what is wrong with them in whole sentences, and the recorders."""

from collections.abc import Iterable

from rich.text import Text
from textual import on
from textual.app import ComposeResult
from textual.widgets import Static

from appliance.record.facts import RecorderStatus
from appliance.tui.drawing import Cell, age, bar, clock
from appliance.tui.frame import FleetScreen
from appliance.tui.grid import Column, Grid
from appliance.tui.keys import bindings
from appliance.tui.safe import safe
from appliance.tui.screens.gateway import GatewayScreen
from appliance.tui.store import SILENT, Gateway, Store

GATEWAYS = (
    Column(title="gateway", width=14, grow=True),
    Column(title="state", width=12),
    Column(title="load", width=4, right=True),
    Column(title="cpu", width=4, right=True),
    Column(title="mem", width=6, right=True),
    Column(title="pool", width=5, right=True),
    Column(title="runs", width=5, right=True),
    Column(title="tasks", width=5, right=True),
    Column(title="link", width=7, right=True, drop=1),
    Column(title="arc", width=4, right=True, drop=2),
    Column(title="up", width=5, right=True, drop=3),
    Column(title="version", width=8, drop=4),
    Column(title="busy", width=16, drop=5),
    Column(title="robots", width=16, grow=True, drop=6),
)
_MOST_NOTES = 6


def gateway_state(gateway: Gateway) -> tuple[str, str]:
    """Return a gateway's state in few words, with its sign and style; `notes` has the whole story."""
    status = gateway.status
    if gateway.lost_ns:
        return f"✘ {clock(gateway.lost_ns)}", "red"
    if status.draining:
        return "◌ draining", "magenta"
    if status.pool_problem:
        return "✘ pool", "red"
    if status.overloaded:
        return "▲ overload", "yellow"
    if not status.limits_enforced:
        return "▲ no limits", "yellow"
    return "✔ up", "green"


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
        (age(each.started_ns, now_ns), dim),
        (safe(each.version, 12), dim),
        (bar(each.load, 10), dim or _hot(each.load)),
        (safe(", ".join(each.robots), 80), dim),
    )


def _hot(load: float) -> str:
    return "red" if load >= 0.9 else "yellow" if load >= 0.7 else ""


def gateway_notes(gateways: Iterable[Gateway]) -> list[Text]:
    """Return what is wrong with gateways in whole sentences, the worst first."""
    found: list[tuple[int, Text]] = []
    for gateway in gateways:
        each = gateway.status
        name = safe(each.id, 63)
        if gateway.lost_ns:
            found.append((0, Text(f"✘ {name}: not reachable since {clock(gateway.lost_ns)}", "red")))
            continue
        if each.pool_problem:
            found.append((1, Text(f"✘ {name}: {safe(each.pool_problem)}", "red")))
        if each.overloaded:
            found.append((2, Text(f"▲ {name}: {safe(each.overloaded)}", "yellow")))
        if each.drain:
            found.append((2, Text(f"◌ {name}: {safe(each.drain)}", "magenta")))
        if not each.limits_enforced:
            told = "container CPU and memory limits are not enforced (the kernel delegates no cgroups)"
            found.append((3, Text(f"▲ {name}: {told}", "yellow")))
        refused = sum(each.refused.values())
        if refused:
            kinds = ", ".join(f"{safe(kind, 40)} {count}" for kind, count in sorted(each.refused.items()))
            found.append((4, Text(f"· {name}: {refused} bad inputs refused ({kinds})", "dim")))
    return [text for _, text in sorted(found, key=lambda each: each[0])]


def recorder_notes(recorders: Iterable[RecorderStatus]) -> list[Text]:
    """Return how the recorders are, a line each."""
    lines: list[Text] = []
    for each in recorders:
        name = safe(each.id, 63)
        dropped = sum(each.dropped.values())
        lost = f", {dropped} lost ({safe(', '.join(sorted(each.dropped)))})" if dropped else ""
        if each.problem:
            lines.append(Text(f"✘ recorder {name}: {safe(each.problem)}{lost}", "red"))
        elif each.state == SILENT:
            lines.append(Text(f"▲ recorder {name}: not heard any more; is `swiftbot record` running?", "yellow"))
        else:
            style = "yellow" if dropped else "dim"
            lines.append(Text(f"✔ recorder {name}: {each.messages} messages in {safe(each.file, 200)}{lost}", style))
    return lines


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
