"""The screen of language models: the model's slot of each gateway, its tiers, and how sure plans were."""

from collections import Counter
from collections.abc import Iterable

from rich.text import Text
from textual import on
from textual.app import ComposeResult
from textual.widgets import Static

from appliance.model import Plan, PlannerStatus, SlotStatus
from appliance.tui.actions import bindings
from appliance.tui.base_screen import FleetScreen
from appliance.tui.formatting import Cell, bar, counted, milliseconds
from appliance.tui.safe import safe
from appliance.tui.store import Gateway, Store
from appliance.tui.widgets.grid import Column, Grid

GATEWAYS = (
    Column(title="gateway", width=12, grow=True),
    Column(title="slot", width=10),
    Column(title="queue", width=5, right=True),
    Column(title="tok/s", width=6, right=True),
    Column(title="plans", width=6, right=True),
    Column(title="escalated", width=9, right=True),
    Column(title="share of tiers asked", width=20, grow=True),
    Column(title="model", width=14, grow=True, drop=1),
    Column(title="mem", width=6, right=True, drop=2),
)
_STATES = {
    "ready": ("✔ ready", "green"),
    "loading": ("◔ loading", "cyan"),
    "swapping": ("◔ swapping", "cyan"),
    "down": ("✘ down", "red"),
}


def slot_state(slot: SlotStatus | None) -> tuple[str, str]:
    """Return the state of a model's slot with sign and style."""
    if slot is None:
        return "· none", "dim"
    return _STATES.get(slot.state) or (f"? {safe(slot.state, 20)}", "bold")


def shares(planner: PlannerStatus) -> str:
    """Return which part of what was asked went to which tier."""
    asked = {name: tier.asked for name, tier in planner.tiers.items() if tier.asked > 0}
    if not (total := sum(asked.values())):
        return "nothing asked yet"
    return ", ".join(f"{safe(name, 12)} {count / total:.0%}" for name, count in asked.items())


def model_cells(gateway: Gateway) -> tuple[Cell, ...]:
    """Return the cells of a gateway's row."""
    planner, name = gateway.status.planner, (safe(gateway.status.id, 63), "bold")
    if planner is None:
        return name, ("not told", "dim"), "", "", "", "", safe(" → ".join(gateway.status.models), 200), "", ""
    slot = planner.slot
    waiting = planner.waiting + (slot.queue if slot is not None else 0)
    return (
        name,
        slot_state(slot),
        (str(waiting), "yellow" if waiting else ""),
        f"{slot.tokens_s:.0f}" if slot is not None else "",
        str(planner.planned),
        f"{planner.escalated / planner.planned:.0%}" if planner.planned > 0 else "",
        shares(planner),
        safe(slot.model, 60) if slot is not None else "",
        f"{slot.memory_mb:.0f}M" if slot is not None else "",
    )


def about(gateway: Gateway) -> Text:
    """Return all that one gateway tells of its planner."""
    status, planner = gateway.status, gateway.status.planner
    head = Text.assemble((safe(status.id, 63), "bold"), f": asks {safe(' → '.join(status.models) or 'not told', 200)}")
    if planner is None:
        return Text("\n").join((head, Text("it does not tell how its planner does", "dim")))
    lines = [head]
    for name, tier in planner.tiers.items():
        threshold = planner.thresholds.get(name)
        sure = f", taken from {threshold:.0%} sure" if threshold is not None else ""
        failed = f", {tier.failed} without a plan" if tier.failed else ""
        lines.append(Text(f"  {safe(name, 12):<9} asked {tier.asked}{failed}, p50 {milliseconds(tier.p50_ms)}{sure}"))
    if (slot := planner.slot) is not None:
        lines.append(
            Text(
                f"  slot      {slot.queue} of {slot.queue_most} places taken, {slot.answered} answered, "
                f"{slot.refused} refused, {slot.cancelled} broken off, {slot.restarts} restarts, "
                f"{slot.reused_tokens} tokens reused"
            )
        )
        if slot.problem:
            remedy = "m has it plan with another model; the other tiers answer meanwhile"
            lines.append(Text(f"  ✘ {safe(slot.problem)} → {remedy}", "red"))
    cache = planner.cache
    looked = cache.hits + cache.misses
    hit = bar(cache.hits / looked if looked > 0 else 0.0, 10)
    lines.append(Text(f"  cache     {counted(cache.entries, 'plan')}, hit {hit} of {looked}"))
    if (upstream := planner.upstream) is not None:
        until = f", tried again in {upstream.retry_after_s:.0f} s" if upstream.retry_after_s > 0 else ""
        budget = f" of {upstream.budget:g}" if upstream.budget > 0 else ""
        lines.append(
            Text(
                f"  upstream  breaker {safe(upstream.state, 20)}{until}; today {upstream.requests} requests, "
                f"{upstream.spent:g}{budget} spent; {upstream.withheld} kept here for privacy",
                "" if upstream.state == "closed" else "yellow",
            )
        )
    if planner.refused:
        lines.append(Text(f"  ▲ {planner.refused} instructions refused: the planner's queue was full", "yellow"))
    return Text("\n").join(lines)


def confidences(plans: Iterable[Plan]) -> Text:
    """Return who made the plans of the tasks that are known, and how sure those tiers were."""
    by_tier: dict[str, list[float]] = {}
    for plan in plans:
        by_tier.setdefault(safe(plan.tier, 20), []).append(plan.confidence)
    total = sum(map(len, by_tier.values()))
    if not total:
        return Text("no plans of known tasks yet", "dim")
    order = Counter({tier: len(found) for tier, found in by_tier.items()}).most_common()
    parts = [
        f"{tier} {count / total:.0%}, {sorted(by_tier[tier])[count // 2]:.0%} sure (median)" for tier, count in order
    ]
    return Text(f"plans of {counted(total, 'known task')}: {'; '.join(parts)}")


class LlmScreen(FleetScreen):
    """The planners of all gateways, the selected one whole, and whose plans are carried out."""

    scope = "llm"
    shows = ("gateways", "tasks")
    BINDINGS = bindings("llm")

    def body(self) -> ComposeResult:
        """Make the parts."""
        yield Grid(GATEWAYS, model_cells, id="models", empty="no gateway is known yet")
        yield Static(id="about")
        yield Static(id="share")

    def draw_body(self, store: Store) -> None:
        """Show gateways by name, and who made the plans of the tasks that are known."""
        rows = {name: each for name, each in sorted(store.gateways.items()) if not each.lost_ns}
        shown = self.filtered(rows, _text)
        self.query_one("#models", Grid).show(
            shown, empty="no gateway matches the filter" if rows else "no gateway is known yet"
        )
        self._draw_about()
        self.say("#share", confidences(each.plan for each in store.tasks.values() if each.plan is not None))

    @on(Grid.Moved)
    def _draw_about(self) -> None:
        gateway: Gateway | None = self.query_one("#models", Grid).thing
        self.say("#about", Text() if gateway is None else about(gateway))

    def chosen(self) -> dict[str, str]:
        """Return the selected gateway."""
        selected = self.query_one("#models", Grid).selected
        return {} if selected is None else {"gateway": selected}


def _text(name: str, gateway: Gateway) -> str:
    return " ".join(
        [name, *gateway.status.models, slot_state(gateway.status.planner and gateway.status.planner.slot)[0]]
    )
