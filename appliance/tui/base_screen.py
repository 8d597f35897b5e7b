"""What all screens have in common: header with connection, body, prompt, footer; when it is drawn; what is chosen.

A screen shows shelves of the store. It is drawn a few times a second at most, only while it is seen, and only when
something on those shelves has changed.
"""

from collections.abc import Callable, Iterable
from typing import ClassVar, Protocol, TypeVar, cast

from rich.cells import cell_len
from rich.style import Style
from rich.text import Text
from textual import on
from textual.app import App, ComposeResult
from textual.containers import Vertical
from textual.screen import Screen
from textual.widget import Widget
from textual.widgets import Static

from appliance.alerts.rules import open_counts
from appliance.errors import SwiftbotError
from appliance.model.roles import lacks
from appliance.operations import Operation
from appliance.reasons import time_of_day
from appliance.tui import actions
from appliance.tui.actions import key_name, keys_of
from appliance.tui.command_line import Filter
from appliance.tui.formatting import counted
from appliance.tui.safe import safe
from appliance.tui.settings import TuiConfig
from appliance.tui.store import Store
from appliance.tui.subscriptions import View
from appliance.tui.widgets import Bar, Lines, Prompt

T = TypeVar("T")


class Host(Protocol):
    """What a screen needs of the application."""

    view: View
    config: TuiConfig
    lines: Lines
    unlocked: bool
    under_way: Iterable[str]
    wanted_task: str

    def run_line(self, line: str) -> None:
        """Do what a command line says."""
        ...

    def completions(self, line: str) -> tuple[str, ...]:
        """Return command lines that go on from this one."""
        ...

    def show_alert(self, name: str) -> None:
        """Open what an alert is about."""
        ...

    def tell(self, error: SwiftbotError) -> None:
        """Show an error with its remedy."""
        ...


class FleetScreen(Screen[None], inherit_bindings=False):
    """A screen of the terminal UI. Subclasses say what they are and show, and make and draw their body."""

    scope: ClassVar[str] = ""
    """Its name, as actions have it."""
    tab: ClassVar[str] = ""
    """The screen whose name is lit in the header; empty: its own."""
    shows: ClassVar[tuple[str, ...]] = ()
    """Kinds of the store that it shows."""

    # Textual's own choice, on a screen without tables, is the hidden prompt: keys would be written there unseen.
    AUTO_FOCUS = "#body *"

    def __init__(self) -> None:
        super().__init__()
        self.filter = Filter()
        """Which rows are shown."""
        self.look = ""
        """The theme that it is styled for; empty until it has been made."""
        self._ready = False
        """Whether its parts are there."""
        self._drawn: object = None
        self._said: object = None
        self._counted: tuple[object, int, str] = (None, 0, "")
        """Of which revisions tasks that go on, and what waits for people or is stopped, were counted."""
        self._texts: dict[str, Text] = {}
        """What parts of the body say, by selector."""

    # --- what subclasses make ------------------------------------------------------------------------------------

    def body(self) -> ComposeResult:
        """Make the parts between header and footer."""
        yield from ()

    def draw_body(self, store: Store) -> None:
        """Show what the store knows now."""
        raise NotImplementedError

    def chosen(self) -> dict[str, str]:
        """Return what is selected, by kind: `gateway`, `task`, `subtask` (`task/subtask`), `robot`, `image`, ..."""
        return {}

    @property
    def ready(self) -> bool:
        """Whether its parts are there to be drawn."""
        return self._ready

    def title_of(self) -> str:
        """Return the text beside the screen's name in the header, such as what was drilled into."""
        return ""

    # --- what they use ---------------------------------------------------------------------------------------------

    @property
    def application(self) -> App[object]:
        """The application, as Textual has it."""
        return cast("App[object]", self.app)  # pyright: ignore[reportUnknownMemberType]

    @property
    def host(self) -> Host:
        """The application."""
        return cast("Host", self.application)

    @property
    def view(self) -> View:
        """The line to the fleet."""
        return self.host.view

    @property
    def store(self) -> Store:
        """What is known of the fleet."""
        return self.host.view.store

    # --- parts -----------------------------------------------------------------------------------------------------

    def compose(self) -> ComposeResult:
        """Make the screen."""
        yield Bar(id="head")
        yield Static(id="banner")
        with Vertical(id="body"):
            yield from self.body()
        yield Prompt(self.host.completions, self.host.lines)
        yield Bar(id="foot")

    @property
    def prompt(self) -> Prompt:
        """The line for filters and commands."""
        return self.query_one(Prompt)

    def on_mount(self) -> None:
        """Draw at once."""
        self._ready = True
        self.query_one("#banner", Static).display = False
        self.flush(force=True)

    def on_screen_resume(self) -> None:
        """Draw what has happened while it was not seen."""
        self.flush()

    def on_resize(self) -> None:
        """Fit header and footer to the window."""
        self._said = None
        self.flush()

    # --- drawing ---------------------------------------------------------------------------------------------------

    def flush(self, *, force: bool = False) -> None:
        """Draw what is new; nothing when nothing is."""
        if not self._ready:
            return
        store = self.store
        # Textual resumes a screen twice when it is first shown: what is as it was is not drawn again.
        drawn = (store, store.revisions(self.shows), self.filter, self.application.theme, self.size.width)
        with self.application.batch_update():
            if force or drawn != self._drawn:
                self._drawn = drawn
                self.draw_body(store)
            self._draw_frame(store, force=force)

    def _draw_frame(self, store: Store, *, force: bool) -> None:
        running, pressing = self._count(store)
        present = sum(not gateway.lost_ns for gateway in store.gateways.values())
        host = self.host
        said = (
            store.connection, present, len(store.robots), running, host.unlocked, tuple(host.under_way),
            self.size.width, self.title_of(), tuple(self.chosen()), pressing, host.view.moment,
            open_counts(store.alerts.values()),
        )  # fmt: skip
        if said == self._said and not force:
            return
        self._said = said
        lost = len(store.gateways) - present
        gateways = f"{present} gw{f' ({lost} lost)' if lost else ''}"
        counts = f"{gateways} · {counted(len(store.robots), 'robot')} · {running} active"
        # Of fixed height: no layout pass is needed for them.
        self.query_one("#head", Bar).update(self._head(counts, pressing), layout=False)
        self.query_one("#foot", Bar).update(self._foot(), layout=False)
        self._draw_banner(store)

    def _count(self, store: Store) -> tuple[int, str]:
        """Return how many tasks go on, and in words what must not be overlooked on any screen."""
        seen = (
            store,
            store.revisions(("tasks", "enquiries", "stops", "recorders", "alerts")),
            store.robots.arrangement,
        )
        if self._counted[0] != seen:
            active = [record for record in store.tasks.values() if not record.state.final]
            waiting = sum(record.proposal is not None and record.proposal.waits for record in active)
            waiting += sum(each.open for each in store.enquiries.values())
            parts = [f"◇ {waiting} wait{'s' if waiting == 1 else ''}"] if waiting else []
            if store.stops.active:
                held = sum(store.stops.of(name) is not None for name in store.robots)
                parts.insert(0, "■ ALL STOPPED" if held == len(store.robots) else f"■ {held} stopped")
            unacked = [each for name, each in store.recorders.items() if not store.acked(f"recorder.{name}")]
            if missed := sum(sum(each.missed.values()) for each in unacked):
                parts.append(f"▲ log misses {missed:,}")
            self._counted = (seen, len(active), " · ".join(parts))
        return self._counted[1], self._counted[2]

    def _head(self, counts: str, pressing: str) -> Text:
        host, width = self.host, max(20, self.size.width)
        mode = "[W] unlocked" if host.unlocked else "[R] read-only"
        if not host.view.steerable:
            mode = "[R] recorded"
        alerts = self._alerts()
        pending = "".join(f" · … {each}" for each in host.under_way)
        # What presses takes the place of the name: at 80 columns there is no room for both.
        name = f" {pressing} · " if pressing else " SwiftBot "
        style = "bold yellow" if pressing else "bold"
        if host.view.moment:
            # What was must not be taken for what is, on whichever screen.
            name, style = f" RECORDED {host.view.moment} ", "bold reverse"
        rest = f"{safe(host.view.fleet, 40)} · {counts}{safe(pending, 60)}"
        first = Text.assemble((name, style), rest, no_wrap=True)
        first.truncate(max(0, width - len(mode) - 2 - cell_len(alerts.plain)), overflow="ellipsis", pad=True)
        first.append_text(alerts)
        first.append(f" {mode} ", "bold yellow" if host.unlocked else "bold")
        first.truncate(width)
        return Text("\n").join((first, self._tabs(width)))

    def _alerts(self) -> Text:
        """Return how many alerts nobody has acknowledged, with the key to them; empty when there are none."""
        critical, warnings = open_counts(self.store.alerts.values())
        if not critical and not warnings:
            return Text()
        click = Style(meta={"@click": "app.act('alerts')"})
        key = key_name(keys_of(actions.BY_NAME["alerts"], self.host.config.keys)[0])
        out = Text(f" {key}", Style(bold=True) + click)
        if critical:
            out.append(f" ✘{critical} ", Style.parse("bold reverse red") + click)
        if warnings:
            out.append(f" ▲{warnings} ", Style.parse("bold reverse yellow") + click)
        return out

    def _tabs(self, width: int) -> Text:
        lit = self.tab or self.scope
        whole = sum(len(title) + 3 for title, _ in actions.SCREENS.values()) + len(self.title_of()) + 3 <= width
        line = Text(no_wrap=True)
        for number, (name, (title, _)) in enumerate(actions.SCREENS.items()):
            here = name == lit
            words = f" {number} {title} " if here else f" {number} {title}" if whole else f" {number} "
            click = Style(meta={"@click": f"app.act('{name}')"})
            line.append(words, (Style(reverse=True, bold=True) if here else Style()) + click)
            if here and self.title_of():
                line.append(f"› {safe(self.title_of(), 40)} ", "bold")
        if lit not in actions.SCREENS and self.title_of():
            line.append(f" › {safe(self.title_of(), 40)} ", "bold reverse")
        line.truncate(width, overflow="ellipsis")
        return line

    def _foot(self) -> Text:
        """Return the keys that do something here, as many as there is room for; the screen's own first."""
        own, host = self.host.config.keys, self.host
        line = Text(no_wrap=True)
        room = self.size.width
        for action in self._offered():
            keys = keys_of(action, own)
            if not keys:
                continue
            key, title = key_name(keys[0]), action.title
            if room < len(key) + len(title) + 3:
                break
            room -= len(key) + len(title) + 3
            usable = not action.writes or host.unlocked or action.always
            usable = usable and not lacks(host.view.role, action.role)
            click = Style(meta={"@click": f"app.act('{action.name}')"})
            line.append(f" {key}", Style.parse("bold cyan" if usable else "dim") + click)
            line.append(f" {title} ", (Style() if usable else Style(dim=True)) + click)
        return line

    def _offered(self) -> list[Operation]:
        live = self.host.view.steerable and self.scope != "replay"
        shown = [action for action in actions.ACTIONS if action.footer and not (action.recorded and live)]
        last = [action for action in shown if not action.screens and action.name in ("help", "stop")]
        ours = [action for action in shown if self.scope in action.screens]
        common = [action for action in shown if not action.screens and action not in last]
        common.sort(key=lambda action: not action.recorded)
        return [*last, *ours, *common]

    def _draw_banner(self, store: Store) -> None:
        banner, connection = self.query_one("#banner", Static), store.connection
        banner.display = not connection.connected
        if not connection.connected:
            since = f", since {time_of_day(connection.since_ns)}" if connection.since_ns else ""
            banner.update(
                Text.assemble(
                    (f"✘ {safe(connection.problem, 200)}{since}", "bold"), f" → {safe(connection.remedy, 200)}"
                )
            )

    # --- filter and prompt -------------------------------------------------------------------------------------------

    def filtered(self, rows: dict[str, T], text: Callable[[str, T], str]) -> dict[str, T]:
        """Return the rows whose text the filter lets through.

        Args:
            rows: by key.
            text: makes the text of a row from its key and thing.
        """
        if not self.filter:
            return rows
        return {key: thing for key, thing in rows.items() if self.filter.matches(text(key, thing))}

    def say(self, which: str, text: Text) -> None:
        """Show a text in a part of the body, hidden while it is empty; laid out again only when its lines change."""
        if self._texts.get(which) == text:
            return
        before, self._texts[which] = self._texts.get(which), text
        part = self.query_one(which, Static)
        part.display = bool(text)
        part.update(text, layout=before is None or not _same_lines(before, text, part.content_size.width))

    def set_filter(self, text: str) -> None:
        """Show only what matches."""
        self.filter = Filter(text)
        self.flush()

    def clear_filter(self) -> None:
        """Show all again."""
        self.set_filter("")
        self.prompt.close()
        self.focus_body()

    def focus_body(self) -> None:
        """Go back to the body."""
        for widget in self.query("#body *").results(Widget):
            if widget.focusable and widget.display:
                widget.focus()
                return
        self.set_focus(None)

    @on(Prompt.Typed)
    def _typed(self, event: Prompt.Typed) -> None:
        event.stop()
        if event.kind == "/":
            self.set_filter(event.text)
            self.prompt.hint(self.filter.note)

    @on(Prompt.Entered)
    def _entered(self, event: Prompt.Entered) -> None:
        event.stop()
        if event.kind == "/":
            self.set_filter(event.text)
            if not self.filter:
                self.prompt.close()
        else:
            self._end_command()
        self.focus_body()
        if event.kind == ":" and event.text.strip():
            self.host.run_line(event.text)

    @on(Prompt.Left)
    def _left(self, event: Prompt.Left) -> None:
        event.stop()
        if event.kind == "/":
            self.clear_filter()
        else:
            self._end_command()
            self.focus_body()

    def _end_command(self) -> None:
        """Hide the prompt, or show the filter in it again."""
        if self.filter:
            prompt = self.prompt
            prompt.kind = "/"
            prompt.field.value = self.filter.text
            prompt.hint("")
        else:
            self.prompt.close()


def _same_lines(one: Text, other: Text, width: int) -> bool:
    """Whether two texts take as many lines at a width for certain: line by line they are the same, or both fit."""
    first, second = one.plain.split("\n"), other.plain.split("\n")
    return len(first) == len(second) and all(
        a == b or (cell_len(a) <= width and cell_len(b) <= width) for a, b in zip(first, second, strict=True)
    )
