"""The screens of federated learning: all runs, and one run with its clients.

Both show of a run its round with who coordinates it and who is next, what it waits for, the curves of loss and
accuracy, and what rounds took beside what waiting for all of their clients would have taken.
"""

from collections.abc import Mapping, Sequence

from msgspec import Struct
from rich.text import Text
from textual import on, work
from textual.app import ComposeResult
from textual.widgets import Static

from appliance.errors import SwiftbotError
from appliance.learn.status import statuses
from appliance.learn.tables import number, seconds, speed
from appliance.model.learning import Activity, ClientStatus, RoundRecord, RunRecord
from appliance.tui import status_styles
from appliance.tui.actions import bindings
from appliance.tui.base_screen import FleetScreen
from appliance.tui.formatting import Cell, counted
from appliance.tui.safe import safe
from appliance.tui.store import Store
from appliance.tui.widgets.grid import Column, Grid
from appliance.tui.widgets.plot import Series, plot

RUNS = (
    Column(title="run", width=16, grow=True),
    Column(title="state", width=11),
    Column(title="model", width=9, drop=3),
    Column(title="mode", width=8, drop=2),
    Column(title="round", width=7, right=True),
    Column(title="clients", width=7, right=True, drop=1),
    Column(title="accuracy", width=8, right=True),
    Column(title="loss", width=6, right=True),
    Column(title="why", width=20, grow=True, drop=4),
)
CLIENTS = (
    Column(title="client", width=10, grow=True),
    Column(title="state", width=15),
    Column(title="gateway", width=7),
    Column(title="samples", width=7, right=True),
    Column(title="speed", width=6, right=True),
    Column(title="ETA", width=7, right=True),
    Column(title="late", width=4, right=True),
    Column(title="rounds", width=6, right=True, drop=1),
    Column(title="loss", width=6, right=True, drop=2),
    Column(title="why", width=12, grow=True),
)
"""Why stands below the table too, of the selected one: narrow windows cut it."""
_NONE = "no runs yet: `swiftbot learn start clips` begins one"
_HIGH = 40
"""Lines of a window in which plots are higher."""
_GAP = 2
"""Cells between two plots."""
_TIMES = 33
"""Cells that the title of the plot of times takes."""


class Shown(Struct, frozen=True):
    """A run with its open round: what a row stands for."""

    run: RunRecord
    round: RoundRecord | None


def accuracy(run: RunRecord) -> float | None:
    """Return the last accuracy that was measured."""
    return next((line.accuracy for line in reversed(run.history) if line.accuracy is not None), None)


def loss(run: RunRecord) -> float | None:
    """Return the mean training loss of the last closed round."""
    return run.history[-1].loss if run.history else None


def run_cells(shown: Shown) -> tuple[Cell, ...]:
    """Return the cells of a run's row."""
    run, sign = shown.run, status_styles.run(shown.run.state)
    taking_part = sum(not client.excluded for client in run.clients)
    waits = shown.round.waits if shown.round is not None and not run.state.final else ""
    return (
        (safe(run.id, 63), "bold"),
        (sign.text, sign.style),
        safe(run.recipe.model, 20),
        safe(run.recipe.mode, 12),
        f"{run.round}/{run.recipe.rounds.count}",
        str(taking_part),
        number(accuracy(run)),
        number(loss(run)),
        safe(run.why or waits, 200),
    )


def client_cells(status: ClientStatus) -> tuple[Cell, ...]:
    """Return the cells of a client's row."""
    sign = status_styles.client(status.state)
    at_work = status.state in (Activity.TRAINING, Activity.LATE)
    progress = f" {status.progress:.0%}" if at_work else ""
    parts = f"{counted(status.parts, 'part')} elsewhere" if status.parts else ""
    return (
        (safe(status.client, 63), "bold"),
        (f"{sign.text}{progress}", sign.style),
        safe(status.gateway, 20),
        f"{status.samples:,}" if status.samples else "–",
        speed(status),
        seconds(status.eta_s) if status.eta_s is not None else "–",
        (str(status.staleness or ""), "yellow"),
        str(status.rounds),
        number(status.loss),
        "; ".join(part for part in (parts, safe(status.why, 300)) if part),
    )


def about(shown: Shown) -> Text:
    """Return what a run is at: its state, its round, who coordinates it, what it waits for."""
    run, record, sign = shown.run, shown.round, status_styles.run(shown.run.state)
    out = Text.assemble((sign.text, sign.style), f" {safe(run.recipe.model, 40)}, {safe(run.recipe.mode, 20)}")
    if run.why:
        out.append(f": {safe(run.why, 200)}")
    holders = ", ".join(run.model.gateways)
    out.append(f"\nmodel {run.model.number} {safe(run.model.digest[:12], 12)}", "dim")
    out.append(f" on {safe(holders, 100)}" if holders else " on no gateway yet", "dim")
    if record is not None and record.number == run.round and not run.state.final:
        deadline = f" of {seconds(record.deadline_s)} to the deadline" if record.deadline_s is not None else ""
        out.append(f"\nround {record.number}/{run.recipe.rounds.count}, {seconds(record.elapsed_s)}{deadline}")
        coordinator, successor = safe(record.coordinator, 40) or "not known", safe(record.successor, 40) or "none"
        out.append(f", coordinator {coordinator}, next {successor}")
        if record.waits:
            out.append(f"\nwaits for {safe(record.waits, 200)}", "yellow")
    return out


def curves(run: RunRecord, width: int, rows: int) -> Text:
    """Return loss, accuracy, and what rounds took, as plots side by side with their last values above."""
    lines = run.history
    if not lines:
        return Text("no round is closed yet", "dim")
    took, everybody = [line.took_s for line in lines], [line.all_s for line in lines]
    target = f"/{run.recipe.rounds.target:g}" if run.recipe.rounds.target is not None else ""
    titles = (
        f"loss {number(loss(run))}",
        f"accuracy {number(accuracy(run))}{target}",
        f"round {seconds(took[-1])}, all {seconds(everybody[-1])}{_ratio(took, everybody)}",
    )
    drawn = (
        [Series(tuple(line.loss for line in lines), "yellow")],
        [Series(tuple(line.accuracy for line in lines), "green")],
        [Series(tuple(everybody), "dim"), Series(tuple(took), "cyan")],
    )
    room = max(3, width - _GAP * 2)
    times = max(room // 3, min(_TIMES, room // 2))
    widths = ((room - times) // 2, (room - times) // 2, times)
    out = Text(no_wrap=True)
    for title, columns in zip(titles, widths, strict=True):
        out.append(f"{title[:columns]:<{columns}}{' ' * _GAP}", "bold")
    plots = [plot(series, columns, rows) for series, columns in zip(drawn, widths, strict=True)]
    for row in range(rows):
        out.append("\n")
        for each in plots:
            for text, style in each[row].pieces:
                out.append(text, style)
            out.append(" " * _GAP)
    return out


def _ratio(took: Sequence[float], everybody: Sequence[float]) -> str:
    """What the rounds took, as a share of what waiting for all would have taken; empty where that is not known."""
    both = [(one, every) for one, every in zip(took, everybody, strict=True) if every > 0]
    whole = sum(every for _, every in both)
    return f" ({sum(one for one, _ in both) / whole:.2f}x)" if whole > 0 else ""


def clients_of(store: Store, shown: Shown) -> Mapping[str, ClientStatus]:
    """Return what the clients of a run are at, as its coordinator told last, else by the records."""
    told = statuses(shown.run, shown.round, ())
    found: dict[str, ClientStatus] = {}
    for each in told:
        known = store.clients.get(f"{shown.run.id}/{each.client}")
        by_record = known is None or known.round < shown.run.round or each.state in (Activity.EXCLUDED, Activity.ENDED)
        found[each.client] = each if by_record or known is None else known
    return found


class LearningScreen(FleetScreen):
    """All runs, those that go on first; the selected one with its curves. Enter opens it."""

    scope = "learning"
    shows = ("runs", "rounds")
    BINDINGS = bindings("learning")

    def body(self) -> ComposeResult:
        """Make the parts."""
        yield Grid(RUNS, run_cells, id="runs", empty=_NONE)
        yield Static(id="about")
        yield Static(id="curves")

    def draw_body(self, store: Store) -> None:
        """Show the runs, newest first, and those that have ended last."""
        runs = sorted(store.runs.values(), key=lambda run: (run.state.final, -run.started_ns, run.id))
        rows = {run.id: Shown(run, store.rounds.get(run.id)) for run in runs}
        shown = self.filtered(rows, _text)
        self.query_one("#runs", Grid).show(shown, empty="no run matches the filter" if rows else _NONE)
        self._draw_about()

    @on(Grid.Moved)
    def _draw_about(self) -> None:
        if not self.ready:
            return
        shown: Shown | None = self.query_one("#runs", Grid).thing
        rows = 6 if self.size.height >= _HIGH else 3
        self.say("#about", Text() if shown is None else about(shown))
        self.say("#curves", Text() if shown is None else curves(shown.run, self.size.width - 2, rows))

    @on(Grid.Picked)
    def _open(self, event: Grid.Picked) -> None:
        event.stop()
        self.application.push_screen(RunScreen(event.key))

    def chosen(self) -> dict[str, str]:
        """Return the selected run."""
        selected = self.query_one("#runs", Grid).selected
        return {} if selected is None else {"run": selected}


def _text(name: str, shown: Shown) -> str:
    return f"{name} {shown.run.state} {shown.run.recipe.model} {shown.run.why}"


class RunScreen(FleetScreen):
    """One run: its round, its curves, its clients."""

    scope = "run"
    tab = "learning"
    shows = ("runs", "rounds", "clients")
    BINDINGS = bindings("run")

    def __init__(self, run: str) -> None:
        super().__init__()
        self.run_id = run
        self._rows: Mapping[str, ClientStatus] = {}

    def title_of(self) -> str:
        """Return the run."""
        return self.run_id

    def body(self) -> ComposeResult:
        """Make the parts."""
        yield Static(id="about")
        yield Static(id="curves")
        yield Grid(CLIENTS, client_cells, id="clients", empty="")
        yield Static(id="why")

    def on_mount(self) -> None:
        """Ask for it as it is: what was put before is not put again while it stays so."""
        super().on_mount()
        if self.view.steerable:
            self._ask()

    @work(exclusive=True, group="shown")
    async def _ask(self) -> None:
        try:
            self.store.take_shown(await self.view.orders.learn_show(self.run_id))
        except SwiftbotError as error:
            self.say("#why", Text(f"{error.message} {error.remedy}".rstrip(), "yellow"))
        self.flush()

    def draw_body(self, store: Store) -> None:
        """Show the run as it is now."""
        run = store.runs.get(self.run_id)
        grid = self.query_one("#clients", Grid)
        if run is None:
            self.say("#about", Text(f"run {safe(self.run_id, 80)} is not known (any more)", "yellow"))
            self.say("#curves", Text())
            grid.show({})
            return
        shown = Shown(run, store.rounds.get(run.id))
        self.say("#about", about(shown))
        self.say("#curves", curves(run, self.size.width - 2, 8 if self.size.height >= _HIGH else 3))
        fresh = clients_of(store, shown)
        # A client that is as it was stays the same thing, so that its line is not drawn again.
        self._rows = {
            name: known if (known := self._rows.get(name, each)) == each else each for name, each in fresh.items()
        }
        rows = self.filtered(dict(self._rows), lambda name, each: f"{name} {each.state} {each.gateway} {each.why}")
        grid.show(rows, empty="no client matches the filter")
        self._draw_why()

    @on(Grid.Moved)
    def _draw_why(self) -> None:
        if not self.ready:
            return
        status: ClientStatus | None = self.query_one("#clients", Grid).thing
        text = Text()
        if status is not None and status.why:
            sign = status_styles.client(status.state)
            text = Text.assemble((f"{safe(status.client, 63)} {sign.word}: ", "bold"), safe(status.why, 300))
        self.say("#why", text)

    def chosen(self) -> dict[str, str]:
        """Return the run, and the selected client."""
        selected = self.query_one("#clients", Grid).selected
        return {"run": self.run_id} | ({} if selected is None else {"client": selected})
