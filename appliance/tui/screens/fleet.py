"""The screens of gateways: the fleet, one gateway whole, and the warm containers of all.

The fleet: its gateways, what is wrong with them in whole sentences, each with its remedy, and the recorders. One
gateway: how it is, its containers, runs and robots, its drain, and its lines of the log. The pool: containers by
image, state, age, hits and size; how starts went; decisions, which are asked of the gateways every few seconds while
the screen is seen, since they are put nowhere.

A gateway's state is worked out once for all of them, so that none calls well what another calls broken.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from typing import cast

from msgspec import Struct
from rich.cells import cell_len
from rich.text import Text
from textual import on
from textual.app import ComposeResult
from textual.widgets import Static

from appliance.alerts.rules import alert_id
from appliance.errors import SwiftbotError
from appliance.model import ContainerInfo, GatewayStatus, Phase, SubtaskState
from appliance.model.pool_api import PoolDecision
from appliance.model.recorder_api import RecorderStatus
from appliance.reasons import time_of_day
from appliance.record.models import SILENT, kinds_text
from appliance.tui import status_styles
from appliance.tui.actions import bindings
from appliance.tui.base_screen import FleetScreen
from appliance.tui.command_line import plain_image
from appliance.tui.formatting import Cell, age, bar, counted, hanging, milliseconds, sparkline
from appliance.tui.safe import safe
from appliance.tui.store import Gateway, Start, Store
from appliance.tui.widgets.grid import Column, Grid


class Note(Struct, frozen=True, kw_only=True):
    """Something about a gateway that a person is to know."""

    weight: int
    """0: gone; 1: broken; 2: works less than it could; 3: the machine lacks something; 4: for information."""
    kind: str = ""
    """Of its alert; empty: it has none."""
    about: str
    """`gateway`, or `pool` for what keeps containers from being started."""
    glyph: str
    style: str
    text: str
    remedy: str = ""

    def line(self, name: str = "") -> Text:
        """Return it as a line, with a gateway's name before it where there are several."""
        told = f"{safe(name, 63)}: {self.text}" if name else self.text
        return Text(f"{self.glyph} {told}{f' → {self.remedy}' if self.remedy else ''}", self.style)


def gateway_state(gateway: Gateway) -> tuple[str, str]:
    """Return a gateway's state in few words, with its sign and style; `notes_of` has the whole story."""
    status = gateway.status
    if gateway.lost_ns:
        return f"✘ lost {time_of_day(gateway.lost_ns)[:5]}", "red"
    if status.draining:
        return "◌ draining", "magenta"
    if status.pool_problem:
        return "✘ pool", "red"
    if status.overloaded:
        return "▲ overload", "yellow"
    if not status.limits_enforced:
        return "▲ no limits", "yellow"
    return "✔ up", "green"


def notes_of(gateway: Gateway) -> list[Note]:
    """Return what is to be known of a gateway, the worst first."""
    each, name = gateway.status, safe(gateway.status.id, 63)
    if gateway.lost_ns:
        gone = f"not reachable since {time_of_day(gateway.lost_ns)}"
        remedy = "check power and network, then: systemctl status swiftbot-gateway"
        return [Note(kind="gateway-lost", weight=0, about="gateway", glyph="✘", style="red", text=gone, remedy=remedy)]
    found: list[Note] = []
    if each.pool_problem:
        text, remedy = safe(each.pool_problem), _pool_remedy(each.pool_problem, name)
        found.append(Note(kind="pool", weight=1, about="pool", glyph="✘", style="red", text=text, remedy=remedy))
    if each.overloaded:
        text, remedy = safe(each.overloaded), "its runs are moved away by themselves; `:drain` gives all away"
        found.append(
            Note(kind="overload", weight=2, about="gateway", glyph="▲", style="yellow", text=text, remedy=remedy)
        )
    if each.draining:
        text, remedy = safe(each.drain) or "draining", "`:uncordon` schedules runs there again"
        found.append(Note(weight=2, about="gateway", glyph="◌", style="magenta", text=text, remedy=remedy))
    if not each.limits_enforced:
        text = "container limits are not enforced (no cgroups)"
        remedy = "`swiftbot doctor`"
        found.append(
            Note(kind="no-limits", weight=3, about="gateway", glyph="▲", style="yellow", text=text, remedy=remedy)
        )
    if each.site_problem:
        text, remedy = safe(each.site_problem), "add [fence] to the site's file: points outside it are then refused"
        if "fence" not in each.site_problem:
            remedy = "`swiftbot site check FILE`, then restart the gateway"
        found.append(Note(kind="site", weight=3, about="gateway", glyph="▲", style="yellow", text=text, remedy=remedy))
    if each.keys_problem:
        text, remedy = safe(each.keys_problem), "`swiftbot keys list`, then `swiftbot keys renew ROLE NAME`"
        found.append(Note(kind="keys", weight=2, about="gateway", glyph="▲", style="yellow", text=text, remedy=remedy))
    if each.parts_problem:
        text, remedy = safe(each.parts_problem), "`swiftbot parts check` there; then sign what is to run"
        found.append(Note(kind="parts", weight=2, about="gateway", glyph="▲", style="yellow", text=text, remedy=remedy))
    if refused := sum(each.refused.values()):
        kinds = ", ".join(f"{safe(kind, 40)} {count}" for kind, count in sorted(each.refused.items()))
        text = f"{refused} bad inputs refused ({kinds})"
        found.append(Note(weight=4, about="gateway", glyph="·", style="dim", text=text))
    return found


def _pool_remedy(problem: str, gateway: str) -> str:
    """Return what helps a pool: an image that is left alone waits for a person's word, memory and Podman do not."""
    if "left alone" in problem:
        return f"mend the image, then `:release IMAGE {gateway}`"
    if "MB for containers" in problem:
        return "end what else takes memory there, or lower `pool.memory_mb`"
    return "`swiftbot doctor` there says why"


def gateway_notes(
    gateways: Iterable[Gateway], *, about: str = "", acked: Callable[[str], bool] = lambda _: False
) -> list[Text]:
    """Return what is to be known of several gateways, a line each, the worst first.

    Args:
        gateways: that it concerns.
        about: only what concerns this (`Note.about`); empty: everything.
        acked: whether somebody has acknowledged the alert of an id: such lines are left out.
    """
    found = [
        (note, each.status.id)
        for each in gateways
        for note in notes_of(each)
        if about in ("", note.about) and not acked(alert_id(note.kind, each.status.id))
    ]
    return [note.line(name) for note, name in sorted(found, key=lambda each: each[0].weight)]


def recorder_notes(recorders: Iterable[RecorderStatus]) -> list[Text]:
    """Return how the recorders are, a line each."""
    lines: list[Text] = []
    for each in recorders:
        name = f"recorder {safe(each.id, 63)}".removesuffix(" recorder")
        missed = sum(each.missed.values())
        lost = f", missed {missed:,} messages of keys {safe(kinds_text(each.missed), 240)}" if missed else ""
        if each.problem:
            remedy = "`swiftbot record` starts it again" if each.state == "failed" else "make room, or see its log"
            lines.append(Text(f"✘ {name}: {safe(each.problem)}{lost} → {remedy}", "red"))
        elif each.state == SILENT:
            lines.append(Text(f"▲ {name}: not heard any more{lost} → is `swiftbot record` running?", "yellow"))
        else:
            sign, style = ("▲", "yellow") if missed else ("✔", "dim")
            told = f"{sign} {name}: {counted(each.messages, 'message')} in {safe(each.file, 200)}{lost}"
            lines.append(Text(told, style))
    return lines


CONTAINERS = (
    Column(title="image", width=9, grow=True),
    Column(title="container", width=12),
    Column(title="gateway", width=8, grow=True),
    Column(title="state", width=10),
    Column(title="age", width=5, right=True),
    Column(title="runs", width=4, right=True),
    Column(title="cpu/mem", width=9, right=True),
    Column(title="running now", width=13, grow=True),
    Column(title="cold", width=8, right=True, drop=1),
)


def container_cells(each: ContainerInfo) -> tuple[Cell, ...]:
    """Return the cells of a container on its gateway's own screen."""
    sign = status_styles.container(each.state)
    return (
        (safe(each.id, 12), "bold"),
        safe(each.image.rsplit("/", 1)[-1], 60),
        (sign.text, sign.style),
        str(each.runs),
        milliseconds(each.cold_ms),
        f"{each.cpu:g}/{each.memory_mb}M",
        safe(each.run, 80),
    )


def pool_cells(each: ContainerInfo) -> tuple[Cell, ...]:
    """Return the cells of a container on the screen of all."""
    sign = status_styles.container(each.state)
    return (
        safe(each.image.rsplit("/", 1)[-1], 60),
        (safe(each.id, 12), "bold"),
        safe(each.gateway, 63),
        (sign.text, sign.style),
        age(each.since_ns),
        str(each.runs),
        f"{each.cpu:g}/{each.memory_mb}M",
        safe(each.run, 80),
        milliseconds(each.cold_ms),
    )


Decision = tuple[str, PoolDecision]
"""A gateway and what its pool decided."""
DECISIONS = "decisions"
"""Under which the store keeps the latest of them, newest first."""
_ASK_S = 3.0
_MOST = 40
_SIGNS = {"start": ("◔", "cyan"), "adopt": ("✔", "green"), "retire": ("◌", "magenta"), "fail": ("✘", "red")}


def starts_text(starts: Sequence[Start], width: int) -> Text:
    """Return how the latest starts of runs went: the share served by a warm container, and how long they took."""
    if not starts:
        return Text("no run has started since this screen listens", "dim")
    phases = Counter(start.phase for start in starts)
    warm = sum(count for phase, count in phases.items() if phase is not Phase.COLD)
    times = [start.startup_ms for start in starts]
    # Ten starts a bar: the share of them that found a warm container.
    tens = [starts[index : index + 10] for index in range(0, len(starts), 10)]
    hits = [sum(start.phase is not Phase.COLD for start in ten) / len(ten) for ten in tens]
    room = max(8, min(40, width - 50))
    by_phase = ", ".join(f"{phase or 'not told'} {count}" for phase, count in phases.most_common())
    return Text.assemble(
        ("warm  ", "bold"), (f"{warm / len(starts):4.0%} ", ""), (sparkline(hits, room, span=(0.0, 1.0)), "green"),
        f"  of the last {len(starts)} starts: {by_phase}\n",
        ("start ", "bold"), f"{milliseconds(sorted(times)[len(times) // 2])} ", (sparkline(times, room), "cyan"),
        f"  median; longest {milliseconds(max(times))}",
    )  # fmt: skip


def decision_lines(decisions: Sequence[Decision], most: int, width: int = 0) -> list[Text]:
    """Return what pools decided lately and why, newest first; a reason longer than a line of `width` goes on below."""
    found: list[Text] = []
    for gateway, each in decisions[:most]:
        glyph, style = _SIGNS.get(each.what, ("?", "bold"))
        line = Text.assemble(
            (f"{time_of_day(each.at_ns)} ", "dim"), (f"{glyph} {safe(each.what, 10):<7}", style),
            f"{safe(gateway, 20):<10} {safe(each.image.rsplit('/', 1)[-1], 20):<10} ",
        )  # fmt: skip
        margin = " " * cell_len(line.plain)
        found.append(line.append(hanging(safe(each.why, 300), margin, width).removeprefix(margin)))
    return found


class PoolScreen(FleetScreen):
    """Containers of all gateways, how starts went, and what pools decided."""

    scope = "pool"
    shows = ("containers", "starts", "asked", "gateways")
    BINDINGS = bindings("pool")

    def body(self) -> ComposeResult:
        """Make the parts."""
        yield Grid(CONTAINERS, pool_cells, id="containers", empty="no warm containers")
        yield Static(id="problems")
        yield Static(id="starts")
        yield Static(id="decisions")

    def on_mount(self) -> None:
        """Let ages grow and ask for decisions while the screen is seen."""
        self.set_interval(1.0, self._grow_older)
        self.set_interval(_ASK_S, self._ask)
        self._ask()

    def _grow_older(self) -> None:
        if self.is_current:
            self.query_one("#containers", Grid).redraw()

    def _ask(self) -> None:
        if self.is_current and self.view.steerable and self.store.connection.connected:
            self.run_worker(self._decisions(), group="decisions", exclusive=True)

    async def _decisions(self) -> None:
        try:
            answers, _ = await self.view.orders.pool_decisions(_MOST)
        except SwiftbotError:
            return  # the banner tells what is wrong with the connection; what was heard last stays
        found = [(name, each) for name, answer in answers.items() for each in answer.decisions]
        found.sort(key=lambda each: each[1].at_ns, reverse=True)
        self.store.asked.put(DECISIONS, tuple(found[:_MOST]))

    def draw_body(self, store: Store) -> None:
        """Show the containers by image."""
        held = store.containers
        rows = {key: held[key] for key in sorted(held, key=lambda key: (held[key].image, key))}
        shown = self.filtered(rows, lambda key, each: f"{key} {each.image} {each.state} {each.run}")
        empty = "no container matches the filter" if rows else "no warm containers"
        self.query_one("#containers", Grid).show(shown, empty=empty)
        wrong = gateway_notes((held for held in store.gateways.values() if not held.lost_ns), about="pool")
        self.say("#problems", Text("\n").join(wrong))
        self.say("#starts", starts_text(tuple(store.starts), self.size.width))
        known = store.asked.get(DECISIONS)
        decisions = cast("tuple[Decision, ...]", known) if isinstance(known, tuple) else ()
        lines = decision_lines(decisions, max(3, self.size.height // 4), self.size.width - 2)
        self.say("#decisions", Text("\n").join(lines))

    def chosen(self) -> dict[str, str]:
        """Return the selected container with its image, and the task it serves."""
        each: ContainerInfo | None = self.query_one("#containers", Grid).thing
        if each is None:
            return {}
        found = {"container": each.id, "image": plain_image(each.image), "gateway": each.gateway}
        if each.run:
            found["task"] = each.run.split("/")[0]
            found["subtask"] = "/".join(each.run.split("/")[:2])
        return found


GATEWAY_CONTAINERS = (
    Column(title="container", width=12),
    Column(title="image", width=12, grow=True),
    Column(title="state", width=11),
    Column(title="runs", width=5, right=True),
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
                sign = status_styles.subtask(each.state)
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

    def __init__(self, gateway: str) -> None:
        super().__init__()
        self._gateway = gateway

    def title_of(self) -> str:
        """Return the gateway's name."""
        return self._gateway

    def body(self) -> ComposeResult:
        """Make the parts."""
        yield Static(id="about")
        yield Grid(GATEWAY_CONTAINERS, container_cells, id="containers", empty="no containers")
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
            Text.assemble((f"{time_of_day(each.at_ns)} ", "dim"), (each.text, status_styles.level(each.level).style))
            for each in said
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
    Column(title="ring", width=4, right=True),
    Column(title="version", width=7),
    Column(title="up", width=5, right=True, drop=1),
    Column(title="busy", width=16, drop=2),
    Column(title="robots", width=16, grow=True, drop=3),
)
"""All columns fit at 80 columns, beside a scroll bar."""
_MOST_NOTES = 6


def gateway_cells(gateway: Gateway, now_ns: int = 0) -> tuple[Cell, ...]:
    """Return the cells of a gateway's row."""
    each = gateway.status
    dim = "dim" if gateway.lost_ns else ""
    return (
        (safe(each.id, 63), f"bold {dim}"),
        gateway_state(gateway),
        (f"{each.load:.0%}", dim or hot(each.load)),
        (f"{each.cpu_percent:.0f}%", dim),
        (f"{each.memory_mb:.0f}M", dim),
        (f"{each.ready}/{each.containers}", dim),
        (f"{each.running}+{each.queue}" if each.queue else str(each.running), dim),
        (str(each.tasks), dim),
        ("" if gateway.latency_ms is None else f"{gateway.latency_ms:.1f}ms", dim),
        ("" if gateway.arc is None else f"{gateway.arc:.0%}", dim),
        (safe(each.version, 12), dim),
        (age(each.started_ns, now_ns), dim),
        (bar(each.load, 10), dim or hot(each.load)),
        (safe(", ".join(each.robots), 80), dim),
    )


def hot(load: float) -> str:
    """Return the style of a load, 0 to 1: empty while there is room."""
    return "red" if load >= 0.9 else "yellow" if load >= 0.7 else ""


def gateways_of(store: Store, fleet: str) -> dict[str, Gateway]:
    """Return the gateways by name, also those that only an alert tells of."""
    known = dict(store.gateways.items())
    for each in store.alerts.values():
        # Lost before this terminal UI was opened: its name is all that is known of it.
        if each.kind == "gateway-lost" and each.name not in known:
            known[each.name] = Gateway(status=GatewayStatus(id=each.name, fleet=fleet), lost_ns=each.since_ns)
    return {name: known[name] for name in sorted(known)}


class FleetOverview(FleetScreen):
    """All gateways; Enter shows one whole."""

    scope = "fleet"
    shows = ("gateways", "recorders", "alerts")
    BINDINGS = bindings("fleet")

    def body(self) -> ComposeResult:
        """Make the parts."""
        yield Grid(GATEWAYS, gateway_cells, id="gateways", empty="no gateway is known yet")
        yield Static(id="notes")

    def draw_body(self, store: Store) -> None:
        """Show the gateways by name."""
        rows = gateways_of(store, self.view.fleet)
        shown = self.filtered(rows, _text)
        empty = "no gateway matches the filter" if rows else "no gateway is known yet"
        self.query_one("#gateways", Grid).show(shown, empty=empty)
        acked = store.acked
        lines = gateway_notes(rows.values(), acked=acked)
        more = len(lines) - _MOST_NOTES
        if more > 0:
            lines = [
                *lines[:_MOST_NOTES],
                Text(f"… {more} more of the same kind: Enter on a gateway shows its own", "dim"),
            ]
        lines += recorder_notes(
            store.recorders[name] for name in sorted(store.recorders) if not acked(alert_id("recorder", name))
        )
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
