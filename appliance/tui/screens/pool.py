"""The screen of warm containers: by image, state, age, hits and size, on all gateways; how starts went; decisions.

What pools decided is asked of the gateways every few seconds while the screen is seen, since it is put nowhere.
"""

from collections import Counter
from collections.abc import Sequence
from typing import cast

from rich.cells import cell_len
from rich.text import Text
from textual.app import ComposeResult
from textual.widgets import Static

from appliance.errors import SwiftbotError
from appliance.model import ContainerInfo, Phase
from appliance.pool.api import PoolDecision
from appliance.tui import signs
from appliance.tui.drawing import Cell, age, clock, hanging, milliseconds, sparkline
from appliance.tui.frame import FleetScreen
from appliance.tui.grammar import plain_image
from appliance.tui.grid import Column, Grid
from appliance.tui.keys import bindings
from appliance.tui.safe import safe
from appliance.tui.screens.condition import gateway_notes
from appliance.tui.store import Start, Store

CONTAINERS = (
    Column(title="image", width=9, grow=True),
    Column(title="container", width=12),
    Column(title="gateway", width=8, grow=True),
    Column(title="state", width=10),
    Column(title="age", width=5, right=True),
    Column(title="hits", width=4, right=True),
    Column(title="cpu/mem", width=9, right=True),
    Column(title="running now", width=13, grow=True),
    Column(title="cold", width=8, right=True, drop=1),
)


def container_cells(each: ContainerInfo) -> tuple[Cell, ...]:
    """Return the cells of a container on its gateway's own screen."""
    sign = signs.container(each.state)
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
    sign = signs.container(each.state)
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
        ("warm  ", "bold"), (f"{warm / len(starts):4.0%} ", ""), (sparkline([*hits, 0.0, 1.0], room + 2)[:-2], "green"),
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
            (f"{clock(each.at_ns)} ", "dim"), (f"{glyph} {safe(each.what, 10):<7}", style),
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
    DEFAULT_CSS = """
    PoolScreen #starts { height: auto; padding: 0 1; border-top: solid $foreground 30%; }
    PoolScreen #problems { height: auto; max-height: 4; padding: 0 1; }
    PoolScreen #decisions { height: auto; max-height: 40%; padding: 0 1; }
    """

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
