"""One gateway whole: how it is, its containers, runs and robots, its drain, and its lines of the log."""

from rich.text import Text
from textual.app import ComposeResult
from textual.widgets import Static

from appliance.model import SubtaskState
from appliance.tui import signs
from appliance.tui.drawing import Cell, age, clock, counted, milliseconds
from appliance.tui.frame import FleetScreen
from appliance.tui.grid import Column, Grid
from appliance.tui.keys import bindings
from appliance.tui.safe import safe
from appliance.tui.screens.condition import gateway_state, notes_of
from appliance.tui.screens.pool import container_cells
from appliance.tui.store import Gateway, Store

CONTAINERS = (
    Column(title="container", width=12),
    Column(title="image", width=12, grow=True),
    Column(title="state", width=11),
    Column(title="hits", width=5, right=True),
    Column(title="cold", width=8, right=True, drop=1),
    Column(title="cpu/mem", width=9, right=True, drop=2),
    Column(title="running now", width=22, grow=True),
)
_LOG_LINES = 8


def about(gateway: Gateway, store: Store) -> Text:
    """Return what is known of a gateway, in lines of labelled facts."""
    each = gateway.status
    latency = "not measured" if gateway.latency_ms is None else f"{gateway.latency_ms:.1f} ms from here"
    arc = "not known" if gateway.arc is None else f"{gateway.arc:.1%} of the keys"
    robots = [name for name in sorted(store.robots) if store.robots[name].gateway == each.id]
    facts: list[tuple[str, Cell]] = [
        ("state", gateway_state(gateway)),
        ("version", f"{safe(each.version, 20)}, process {each.pid}, up {age(each.started_ns)}"),
        ("machine", f"{each.cores} cores, cpu {each.cpu_percent:.0f}%, the daemon has {each.memory_mb:.0f} MB"),
        (
            "pool",
            (
                f"{each.ready} ready of {each.containers}, room for {each.capacity}; {each.pool_memory_mb} MB for all"
                f"; limits {'enforced' if each.limits_enforced else 'NOT enforced'}"
            ),
        ),
        (
            "work",
            f"{counted(each.running, 'run')}, {each.queue} wait for a container, coordinates {each.tasks}",
        ),
        ("links", f"{latency}; ring: {arc}"),
        ("models", safe(", ".join(each.models) or "not told", 200)),
        ("robots", safe(", ".join(robots) or "none", 200)),
    ]
    lines = [Text.assemble((f"{name:<8}", "bold"), value) for name, value in facts]
    lines += [note.line() for note in notes_of(gateway)]
    return Text("\n").join(lines)


def runs(gateway: str, store: Store) -> list[Text]:
    """Return what runs on a gateway just now, a line each."""
    found: list[Text] = []
    for task in store.newest:
        record = store.tasks[task]
        if record.state.final:
            continue
        for each in record.subtasks:
            if each.gateway == gateway and each.state in (SubtaskState.RUNNING, SubtaskState.DISPATCHED):
                sign = signs.subtask(each.state)
                text = f"{sign.glyph} {safe(task, 63)}/{safe(each.subtask.id, 20)} {safe(each.subtask.skill, 30)}"
                start = f" · start {milliseconds(each.startup_ms)}" if each.startup_ms is not None else ""
                note = f" · {safe(each.note, 80)}" if each.note else ""
                found.append(Text(f"{text} {sign.word} {each.progress:.0%}{start}{note}", sign.style))
    return found


class GatewayScreen(FleetScreen):
    """One gateway.

    Args:
        gateway: its id.
    """

    scope = "gateway"
    tab = "fleet"
    shows = ("gateways", "containers", "robots", "tasks", "entries")
    BINDINGS = bindings("gateway")
    DEFAULT_CSS = """
    GatewayScreen #about { height: auto; padding: 0 1; }
    GatewayScreen #runs { height: auto; max-height: 6; padding: 0 1; }
    GatewayScreen #lines { height: auto; max-height: 8; padding: 0 1; }
    """

    def __init__(self, gateway: str) -> None:
        super().__init__()
        self._gateway = gateway

    def title_of(self) -> str:
        """Return the gateway's name."""
        return self._gateway

    def body(self) -> ComposeResult:
        """Make the parts."""
        yield Static(id="about")
        yield Grid(CONTAINERS, container_cells, id="containers", empty="no containers")
        yield Static(id="runs")
        yield Static(id="lines")

    def draw_body(self, store: Store) -> None:
        """Show the gateway as it is now."""
        gateway = store.gateways.get(self._gateway)
        text = Text(f"{self._gateway} is not known any more", "dim") if gateway is None else about(gateway, store)
        self.say("#about", text)
        rows = {key: each for key, each in sorted(store.containers.items()) if each.gateway == self._gateway}
        self.query_one("#containers", Grid).show(
            self.filtered(rows, lambda key, each: f"{key} {each.image} {each.state}")
        )
        running = runs(self._gateway, store)
        self._show("#runs", running[:6])
        said = [each for each in store.entries if each.source == self._gateway][-_LOG_LINES:]
        lines = [
            Text.assemble((f"{clock(each.at_ns)} ", "dim"), (each.text, signs.level(each.level).style)) for each in said
        ]
        self._show("#lines", lines)

    def _show(self, which: str, lines: list[Text]) -> None:
        text = Text("\n").join(lines)
        text.no_wrap = True
        self.say(which, text)

    def chosen(self) -> dict[str, str]:
        """Return the gateway and the selected container."""
        found = {"gateway": self._gateway}
        thing = self.query_one("#containers", Grid).thing
        if thing is not None:
            found["container"] = thing.id
        return found
