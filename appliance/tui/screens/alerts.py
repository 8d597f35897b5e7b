"""The screen of alerts: what is wrong or waits for a person, the most urgent first. Enter opens what one is about."""

import time

from rich.text import Text
from textual import on
from textual.app import ComposeResult
from textual.widgets import Static

from appliance.alerts.rules import ordered
from appliance.model.alerts import Alert, AlertLevel, Subject
from appliance.reasons import time_of_day
from appliance.tui.actions import bindings
from appliance.tui.base_screen import FleetScreen
from appliance.tui.formatting import Cell, age, duration
from appliance.tui.safe import safe
from appliance.tui.store import Store
from appliance.tui.widgets.grid import Column, Grid

ALERTS = (
    Column(title="severity", width=10),
    Column(title="since", width=5, right=True),
    Column(title="where", width=13, grow=True),
    Column(title="what", width=31, grow=True),
    Column(title="acked by", width=9),
)
"""All columns fit at 80 columns, beside a scroll bar."""


def alert_cells(alert: Alert) -> tuple[Cell, ...]:
    """Return the cells of an alert's row."""
    critical = alert.level is AlertLevel.CRITICAL
    word = "✘ critical" if critical else "▲ warning"
    style = "dim" if alert.acked is not None else "red" if critical else "yellow"
    by = safe(alert.acked.by, 40) if alert.acked is not None else ""
    return (
        (word, style),
        (age(alert.since_ns), "dim" if alert.acked is not None else ""),
        (safe(alert.name, 63), "bold" if alert.acked is None else "dim"),
        (f"{left(alert)}{safe(alert.what, 300)}", "" if alert.acked is None else "dim"),
        (by, "dim"),
    )


def left(alert: Alert) -> str:
    """Return how long there is to do something about it, before its words; empty without such a time."""
    left_s = (alert.until_ns - time.time_ns()) / 1e9
    return f"{duration(left_s)} left: " if alert.until_ns and left_s > 0 else ""


def about(alert: Alert) -> Text:
    """Return an alert in full: what it is, what to do, who has acknowledged it."""
    out = Text.assemble((safe(alert.id, 200), "bold"), f" since {time_of_day(alert.since_ns)}\n", safe(alert.what, 600))
    if alert.until_ns:
        out.append(f"\nuntil {time_of_day(alert.until_ns)}", "yellow")
    if alert.remedy:
        out.append(f"\n→ {safe(alert.remedy, 400)}", "cyan")
    if alert.acked is not None:
        why = f": {safe(alert.acked.why, 300)}" if alert.acked.why else ""
        out.append(f"\nacknowledged by {safe(alert.acked.by, 80)} at {time_of_day(alert.acked.at_ns)}{why}", "dim")
    return out


def chosen_of(alert: Alert) -> dict[str, str]:
    """Return an alert, and what it is about."""
    kind = "enquiry" if alert.subject is Subject.QUESTION else str(alert.subject)
    return {"alert": alert.id, kind: alert.name}


class AlertsScreen(FleetScreen):
    """All alerts."""

    scope = "alerts"
    shows = ("alerts",)
    BINDINGS = bindings("alerts")

    def title_of(self) -> str:
        """Return what it is: it has no number."""
        return "alerts"

    def body(self) -> ComposeResult:
        """Make the parts."""
        yield Grid(ALERTS, alert_cells, id="alerts", empty="no alerts")
        yield Static(id="about")

    def on_mount(self) -> None:
        """Let ages grow while the screen is seen."""
        self.set_interval(1.0, self._grow_older)

    def _grow_older(self) -> None:
        if self.is_current:
            self.query_one("#alerts", Grid).redraw()

    def draw_body(self, store: Store) -> None:
        """Show them, the most urgent first."""
        rows = {each.id: each for each in ordered(store.alerts.values())}
        shown = self.filtered(rows, lambda name, each: f"{name} {each.level} {each.what}")
        self.query_one("#alerts", Grid).show(shown, empty="no alert matches the filter" if rows else "no alerts")
        self._draw_about()

    @on(Grid.Moved)
    def _draw_about(self) -> None:
        if self.ready:
            alert: Alert | None = self.query_one("#alerts", Grid).thing
            self.say("#about", Text() if alert is None else about(alert))

    def go_to_first(self) -> None:
        """Put the cursor on the most urgent."""
        self.query_one("#alerts", Grid).action_edge(0)

    @on(Grid.Picked)
    def drill(self, event: Grid.Picked) -> None:
        """Show what it is about."""
        event.stop()
        self.host.show_alert(event.key)

    def chosen(self) -> dict[str, str]:
        """Return the selected alert, and what it is about."""
        alert: Alert | None = self.query_one("#alerts", Grid).thing
        return {} if alert is None else chosen_of(alert)
