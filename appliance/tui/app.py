"""The terminal UI itself: the window, its screens and dialogs, what becomes of keys and commands, and how it is run.

`Shell` is Textual's part, nothing else: which screens there are, when the one that is seen is drawn, and in which
colours. It works at 80 columns by 24 lines over SSH, draws a few times a second and only what changed, and never stops
because the network does. `Ordering` takes what a person wants from key or command line to what came of it: asked,
allowed, confirmed, carried out, told. `SwiftbotApp` adds what the UI's own actions do, and the change to a recorded log
and back. `run_tui` runs it in a terminal until the person leaves, `export_picture` without one for a picture of it.
"""

import contextlib
import re
import time
from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import structlog
from rich.console import RenderableType
from textual.app import App, SystemCommand
from textual.css.query import NoMatches
from textual.screen import Screen
from textual.widgets import Input

from appliance.errors import ConfigError, SwiftbotError, UnreachableError
from appliance.llm.stop_words import stop_request
from appliance.model import Approval, TaskRecord
from appliance.model.messages import enums_open
from appliance.plane.settings import PlaneConfig
from appliance.process import gentle_collector
from appliance.tui import actions, command_line, themes
from appliance.tui.actions import PROMPTS, STOP_IN_WORDS, bindings, key_name, keymap, keys_of
from appliance.tui.base_screen import FleetScreen
from appliance.tui.command_line import Command
from appliance.tui.replay import ReplayView
from appliance.tui.safe import safe
from appliance.tui.screens.fleet import FleetOverview, PoolScreen
from appliance.tui.screens.logs import LogScreen
from appliance.tui.screens.models import LearningScreen, LlmScreen
from appliance.tui.screens.replay import ReplayScreen
from appliance.tui.screens.review import ReviewScreen
from appliance.tui.screens.robots import RobotsScreen
from appliance.tui.screens.submit import History, SubmitDialog, default_file
from appliance.tui.screens.takeover import TakeoverScreen
from appliance.tui.screens.tasks import TasksScreen
from appliance.tui.settings import TuiConfig
from appliance.tui.subscriptions import FleetView, View, take_own_log
from appliance.tui.task_view import state_cell
from appliance.tui.widgets import Lines
from appliance.tui.widgets.dialogs import ConfirmDialog, HelpDialog, TextDialog

SCREENS: dict[str, type[FleetScreen]] = {
    "fleet": FleetOverview,
    "tasks": TasksScreen,
    "robots": RobotsScreen,
    "pool": PoolScreen,
    "llm": LlmScreen,
    "learning": LearningScreen,
    "log": LogScreen,
    "replay": ReplayScreen,
}
"""By the name that their action has."""

_FONT = re.compile(r"@font-face \{[^}]*\}\s*")


class Shell(App[None], inherit_bindings=False):
    """A window on a view of a fleet: what is seen of it, when it is drawn, and in which colours.

    Args:
        view: What is shown; closed with the app.
        config: How it looks and how often it is drawn.
        history: Instructions submitted before; kept in memory alone when none is given.
    """

    TITLE = "SwiftBot"
    BINDINGS = bindings()  # pyright: ignore[reportAssignmentType] - Textual wants a list of its own union
    MODES = SCREENS  # pyright: ignore[reportAssignmentType] - of classes, which make themselves
    DEFAULT_MODE = "fleet"
    ENABLE_COMMAND_PALETTE: ClassVar[bool] = False
    """Textual would bind ^p to it for good; it is there all the same, under the keys of the action `palette`."""
    CSS = """
    ModalScreen { align: center middle; }
    .dialog { width: 90%; max-width: 110; height: 80%; border: round $accent; background: $surface; padding: 0 1; }
    .small { height: auto; width: 60; }
    .title { text-style: bold; }
    #plan-box { height: 1fr; scrollbar-size: 1 1; }
    #hint { color: $text-muted; }
    VerticalScroll { scrollbar-size: 1 1; }
    """

    def __init__(self, view: View, config: TuiConfig | None = None, *, history: History | None = None) -> None:
        self.config = config or TuiConfig()
        self.config.check()
        self._own_keys = keymap(self.config.keys)
        if self.config.theme not in themes.BY_NAME:
            known = ", ".join(themes.BY_NAME)
            raise ConfigError(f"tui.theme is {self.config.theme!r}", remedy=f"there are: {known}")
        self._look = ""
        """The theme that styles were worked out for."""
        super().__init__()
        self.use_command_palette = True
        self.view = view
        self.history = history or History(None)
        """Instructions submitted before."""
        self.behind: View | None = None
        """The fleet, while a recorded log is shown instead."""
        self.lines = Lines()
        """Command lines written before."""
        self.unlocked = self.config.write and view.steerable
        """Whether what changes the fleet is allowed."""
        self.under_way: dict[str, None] = {}
        """Orders that have not been answered yet, as command lines."""
        self.wanted_task = ""
        """A task that is to be selected as soon as it is shown."""
        if not self.config.animation:
            self.animation_level = "none"
        for look in themes.LOOKS:
            self.register_theme(look.theme())

    async def on_mount(self) -> None:
        """Begin to listen and to draw."""
        self.set_look(self.config.theme)
        self.set_keymap(self._own_keys)
        await self.view.start()
        if not self.view.steerable:
            self.switch_mode("replay")
        self.set_interval(1 / self.config.refresh_hz, self._tick)

    async def on_unmount(self) -> None:
        """End listening."""
        await self.view.close()
        if self.behind is not None:
            await self.behind.close()

    # --- drawing -----------------------------------------------------------------------------------------

    @property
    def front(self) -> FleetScreen | None:
        """The screen that is seen, behind a dialog if there is one."""
        return next((each for each in reversed(self.screen_stack) if isinstance(each, FleetScreen)), None)

    def _tick(self) -> None:
        # While the app ends, the timer may still fire when parts of the screen are gone.
        with contextlib.suppress(NoMatches):
            self.draw()

    def draw(self, *, force: bool = False) -> None:
        """Draw what is new on the screen that is seen; the others wait until they are."""
        self.view.sync()
        if (front := self.front) is not None:
            front.flush(force=force)

    def delay_update(self, delay: float = 0.05) -> None:
        """Hold painting back while screens change; shorter than Textual does, since ours are drawn at once."""
        super().delay_update(min(delay, 0.005))

    def refresh_css(self, animate: bool = True) -> None:
        """Work out the styles anew when the colours have changed.

        Textual does so whenever a screen is shown for the first time as well, which is styled with these colours as it
        is made: that took longer than all else of showing it.
        """
        screens = [each for each in self.screen_stack if isinstance(each, FleetScreen)]
        for each in screens:
            each.look = each.look or self._look
        if self._look == self.theme and all(each.look == self.theme for each in screens):
            return
        super().refresh_css(animate)
        self._look = self.theme
        for each in screens:
            each.look = self.theme

    def get_theme_variable_defaults(self) -> dict[str, str]:
        """Return variables that themes have beside Textual's: its own theme, until ours is set, lacks them."""
        return {"cursor": themes.LOOKS[0].cursor}

    def set_look(self, name: str) -> None:
        """Change the colours."""
        look = themes.BY_NAME[name]
        self.ansi_theme_dark = self.ansi_theme_light = look.terminal()
        self.theme = name

    # --- what is told -----------------------------------------------------------------------------------------

    def tell(self, error: SwiftbotError) -> None:
        """Show an error with its remedy."""
        remedy = f"\n→ {safe(error.remedy)}" if error.remedy else ""
        self.notify(f"{safe(error.message)}{remedy}", title="Error", severity="error", timeout=10, markup=False)

    def read(self, title: str, content: RenderableType) -> None:
        """Show something to be read at leisure."""
        self.push_screen(TextDialog(title, content))

    def export_svg(self, path: Path) -> None:
        """Write a picture of the screen as it is now, without references to fonts on other machines."""
        path.write_text(_FONT.sub("", self.export_screenshot(title=f"SwiftBot · {self.view.fleet}")))


log = structlog.get_logger(__name__)

_UNSAID = ("stops", "robots", "unknown", "roster")
"""Arguments that nobody has written."""


class Ordering(Shell):
    """A window that takes orders. What an action does here is a method `do_NAME` of a subclass."""

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """Leave the keys of the prompt to whatever is being written, and to dialogs."""
        if action == "act" and parameters and parameters[0] in PROMPTS:
            return not isinstance(self.focused, Input) and isinstance(self.screen, FleetScreen)
        return super().check_action(action, parameters)

    def action_act(self, name: str) -> None:
        """Do an action of the registry on what is selected."""
        chosen = self.front.chosen() if self.front is not None else {}
        self.begin(command_line.fill(actions.BY_NAME[name], {}, chosen))

    def run_line(self, line: str) -> None:
        """Do what a command line says."""
        chosen = self.front.chosen() if self.front is not None else {}
        try:
            command = command_line.read(line, chosen)
        except SwiftbotError as error:
            self.tell(error)
            return
        self.begin(command)

    def completions(self, line: str) -> tuple[str, ...]:
        """Return command lines that go on from this one."""
        return command_line.complete(line, self.view.store, {"theme": themes.BY_NAME})

    @property
    def _steered(self) -> View:
        """Whom a stop is for: the fleet behind a recorded log that is shown, if there is one."""
        return self.behind if self.behind is not None and not self.view.steerable else self.view

    def begin(self, command: Command) -> None:
        """Do an action, unless something is missing, the UI is read-only, or a person says no."""
        action = command.action
        if action.call == "submit" and self.stops_in_words(command.given.get("instruction", "")):
            return
        if action.writes and not (action.always and self._steered.steerable) and not self._allowed():
            return
        if command.missing:
            self._ask_for(command)
        elif action.call:
            method, _, fixed = action.call.partition(" ")
            getattr(self, f"do_{method}")(*([fixed] if fixed else []), command.given)
        elif action.dangerous:
            if action.sees_stops:
                # Before the question: what is stopped while it is open was not seen.
                command.given["stops"] = "/".join(each.id for each in self.view.store.stops.active)

            def answered(yes: bool | None) -> None:
                if yes:
                    self.carry_out(command)

            self.push_screen(ConfirmDialog(safe(action.sentence(command.given))), answered)
        else:
            self.carry_out(command)

    def stops_in_words(self, text: str) -> bool:
        """Carry a text out that is a soft stop, as the stop key does it, read-only as well; False when it is none."""
        view = self._steered
        roster = tuple(view.store.robots)
        if not view.steerable or (stop := stop_request(text, roster)) is None:
            return False
        given = {"robots": "/".join(stop.robots), "unknown": "/".join(stop.unknown), "roster": "/".join(roster)}
        self.carry_out(Command(action=STOP_IN_WORDS, given={**given, "why": text}))
        return True

    def _allowed(self) -> bool:
        if not self.view.steerable:
            self.notify("a recorded log cannot be steered", severity="warning")
        elif not self.unlocked:
            self.notify("read-only: W or `:write` unlocks", severity="warning")
        else:
            return True
        return False

    def _ask_for(self, command: Command) -> None:
        """Have a person write what is missing; what is given stands there already.

        Of the questions that wait the oldest is taken where none is selected, and who asks what is said beside it.
        """
        asked = self.view.store.enquiries
        if any(each.kind == "enquiry" for each in command.missing):
            waiting = [each for each in asked.values() if each.open]
            if not waiting:
                self.notify("nothing is asked")
                return
            oldest = min(waiting, key=lambda each: each.at_ns)
            command = command_line.fill(command.action, command.given, {"enquiry": oldest.id})
        words = [command.action.name]
        for parameter in command.action.takes:
            if parameter.name not in command.given:
                break
            words.append(command.given[parameter.name])
        if self.front is not None:
            note = f"{', '.join(each.name for each in command.missing)}? {command.action.usage}"
            for parameter in command.action.takes:
                if (
                    parameter.kind == "enquiry"
                    and (one := asked.get(command.given.get(parameter.name, ""))) is not None
                ):
                    note = f"{safe(one.robot or one.task or 'a skill', 40)} asks: {safe(one.question, 160)} · {note}"
            self.front.prompt.open(":", " ".join(words) + " ", note)

    def carry_out(self, command: Command) -> None:
        """Ask something of the fleet in the background, and show what comes of it."""
        words = (word for name, word in command.given.items() if name not in _UNSAID)
        line = " ".join([command.action.name, *words])
        if line in self.under_way:
            self.notify(f"{safe(line, 80)}: under way already", severity="warning", markup=False)
            return
        self.under_way[line] = None
        self.run_worker(self._carry_out(command, line), group="orders")

    async def _carry_out(self, command: Command, line: str) -> None:
        action = command.action
        assert action.do is not None  # noqa: S101 - what has no call has this
        view = self._steered if action.always else self.view
        try:
            answer = await action.do(view.orders, command.given, view.operator)
        except SwiftbotError as error:
            if action.always and isinstance(error, UnreachableError):
                error.remedy = "stop the robots by their own means"
            self.note(line, error.message, level="error")
            self.tell(error)
        except Exception as error:  # supervision boundary: one order's defect must not end the UI
            log.exception("an order failed", order=line)
            self.notify(f"internal error: {safe(repr(error), 200)}", severity="error", markup=False)
        else:
            if isinstance(answer, TaskRecord):
                # It is heard as well, but perhaps later than the person looks.
                self.view.store.take_task(answer)
                answer = f"task {answer.id}: {state_cell(answer)[0]}"
            if action.long:
                self.push_screen(TextDialog(f":{safe(line, 80)}", answer))
            else:
                self.note(line, str(answer))
                self.notify(safe(answer), markup=False)
        finally:
            self.under_way.pop(line, None)
            with contextlib.suppress(NoMatches):  # an answer may come while the screen goes
                self.draw()

    def note(self, line: str, outcome: str, *, level: str = "info") -> None:
        """Put an order and what came of it on the log screen."""
        text = f":{line} → {outcome}"
        self.view.store.add(time.time_ns(), kind="order", level=level, source=self.view.operator, text=text)


class SwiftbotApp(Ordering):
    """The terminal UI on a view of a fleet."""

    def do_screen(self, name: str, _given: Mapping[str, str]) -> None:
        """Show a screen; from what was drilled into there, its beginning."""
        if name == self.current_mode:
            while len(self.screen_stack) > 1 and not self.screen.is_modal:
                self.pop_screen()
            return
        self.switch_mode(name)

    def do_here(self, name: str, given: Mapping[str, str]) -> None:
        """Do what the screen that is seen has under this name."""
        method = getattr(self.front, f"do_{name}", None)
        if method is None:
            self.notify("that does nothing on this screen", severity="warning")
        else:
            method(given)

    def do_submit(self, given: Mapping[str, str]) -> None:
        """Ask for an instruction, show its plan, run it when confirmed."""

        def submitted(record: TaskRecord | None) -> None:
            if record is None:
                return
            self.view.store.take_task(record)
            self.note("submit", f"accepted as {record.id}")
            self.notify(f"accepted as {record.id}", markup=False)
            self.show_task(record.id)
            if record.approval is Approval.ALWAYS:
                self.push_screen(ReviewScreen(record.id))

        dialog = SubmitDialog(
            self.view,
            self.history,
            instruction=given.get("instruction", ""),
            own=self.config.keys,
            stops=self.stops_in_words,
        )
        self.push_screen(dialog, submitted)

    def do_review(self, given: Mapping[str, str]) -> None:
        """Look at the plan of a task that waits for approval."""
        self.push_screen(ReviewScreen(given["task"]))

    def do_takeover(self, given: Mapping[str, str]) -> None:
        """Take a robot over, after asking."""
        robot = given["robot"]

        def answered(yes: bool | None) -> None:
            if yes:
                self.push_screen(TakeoverScreen(robot, why=given.get("why", "")))

        question = (
            f"Take {robot} over? It holds and obeys nobody else until you give it back; what it does for a task waits "
            "or fails. It is given back when you leave the screen."
        )
        self.push_screen(ConfirmDialog(safe(question)), answered)

    # --- recorded logs ---------------------------------------------------------------------------------------

    def do_open(self, given: Mapping[str, str]) -> None:
        """Show a recorded log instead of the fleet."""
        self.run_worker(self._open(Path(given["file"]).expanduser()), group="replay", exclusive=True)

    async def _open(self, path: Path) -> None:
        try:
            replay = await ReplayView.open(path, self.config)
        except SwiftbotError as error:
            self.tell(error)
            return
        if isinstance(self.view, ReplayView):
            await self.view.close()
        else:
            # The fleet goes on being heard behind it, so that going back shows it as it is.
            self.behind = self.view
        await self._show_view(replay)
        self.do_screen("replay", {})

    def do_live(self, _given: Mapping[str, str]) -> None:
        """Show the fleet again."""
        if self.behind is None:
            self.notify("no fleet is behind this", severity="warning")
        else:
            self.run_worker(self._close_replay(), group="replay", exclusive=True)

    async def _close_replay(self) -> None:
        live, self.behind = self.behind, None
        if live is None:
            return
        await self.view.close()
        self.view = live
        self.draw(force=True)

    async def _show_view(self, view: ReplayView) -> None:
        self.unlocked = False
        self.view = view
        await view.start()
        self.draw(force=True)

    def show_task(self, task: str) -> None:
        """Show the screen of tasks with one of them selected."""
        self.wanted_task = task
        self.do_screen("tasks", {})
        self.draw(force=True)

    def do_prompt(self, kind: str, _given: Mapping[str, str]) -> None:
        """Open the line for a filter or a command."""
        if self.front is not None:
            self.front.prompt.open(kind, self.front.filter.text if kind == "/" else "")

    def do_back(self, _given: Mapping[str, str]) -> None:
        """End the filter, or leave what was drilled into."""
        front = self.front
        if front is None:
            return
        if front.filter or front.prompt.display:
            front.clear_filter()
        elif len(self.screen_stack) > 1:
            self.pop_screen()

    def do_next_part(self, _given: Mapping[str, str]) -> None:
        """Go to the next part of the screen."""
        self.screen.focus_next()

    def do_previous_part(self, _given: Mapping[str, str]) -> None:
        """Go to the previous part of the screen."""
        self.screen.focus_previous()

    def do_copy(self, _given: Mapping[str, str]) -> None:
        """Copy what is marked; without any text marked, whoever wanted to interrupt is told how to leave."""
        marked = self.screen.get_selected_text()
        if marked:
            self.copy_to_clipboard(marked)
            return
        key = key_name(keys_of(actions.BY_NAME["quit"], self.config.keys)[0])
        self.notify(f"{key} or :quit leaves", markup=False)

    def do_unlock(self, _given: Mapping[str, str]) -> None:
        """Allow what changes the fleet."""
        if not self.view.steerable:
            self.notify("a recorded log cannot be steered", severity="warning")
            return
        self.unlocked = True
        self.clear_notifications()  # one of them said how to do this
        self.draw(force=True)

    def do_lock(self, _given: Mapping[str, str]) -> None:
        """Allow nothing that changes the fleet."""
        self.unlocked = False
        self.draw(force=True)

    def do_theme(self, given: Mapping[str, str]) -> None:
        """Change the colours: to those named, or the next."""
        names = list(themes.BY_NAME)
        wanted = given.get("theme", "")
        if wanted and wanted not in names:
            self.notify(f"no theme {safe(wanted, 40)}\n→ {', '.join(names)}", severity="error", markup=False)
            return
        self.set_look(wanted or names[(names.index(self.theme) + 1) % len(names)])
        self.draw(force=True)

    def do_picture(self, given: Mapping[str, str]) -> None:
        """Write the screen as it is into a file."""
        path = Path(given["file"]).expanduser()
        try:
            self.export_svg(path)
        except OSError as error:
            self.notify(f"{safe(str(path), 200)}: {error.strerror}", severity="error", markup=False)
        else:
            self.notify(f"written: {safe(str(path), 200)}", markup=False)

    def do_command_palette(self, _given: Mapping[str, str]) -> None:
        """Show all actions by name."""
        self.action_command_palette()

    def do_help(self, _given: Mapping[str, str]) -> None:
        """Show keys, commands and signs."""
        scope = self.front.scope if self.front is not None else ""
        self.push_screen(HelpDialog(scope, self.config.keys))

    def do_quit(self, _given: Mapping[str, str]) -> None:
        """Leave; the fleet goes on."""
        self.exit()

    def get_system_commands(self, screen: Screen[Any]) -> Iterable[SystemCommand]:
        """Offer the same actions in the command palette."""
        _ = screen
        for action in actions.ACTIONS:
            keys = f" ({action.shown})" if action.keys else ""

            async def call(name: str = action.name) -> None:
                self.action_act(name)

            yield SystemCommand(action.title, f"{action.help}{keys}", call)


async def export_picture(
    view: View, path: Path, *, keys: tuple[str, ...] = ("2",), size: tuple[int, int] = (100, 30)
) -> None:
    """Run the terminal UI without a terminal on `view`, press `keys`, write its picture to `path` as SVG.

    Args:
        view: What is shown.
        path: SVG file to write.
        keys: Keys pressed first, in Textual's names.
        size: Columns and lines.
    """
    app = SwiftbotApp(view)
    async with app.run_test(size=size) as pilot:
        await pilot.pause()
        await pilot.press(*keys)
        await pilot.pause(0.5)
        app.draw(force=True)
        await pilot.pause()
        app.export_svg(path)


async def run_tui(
    plane_config: PlaneConfig, fleet: str, config: TuiConfig | None = None, *, replay: Path | None = None
) -> None:
    """Run the terminal UI on a fleet, or on a recorded log, until the person leaves (`swiftbot tui`).

    Log lines of this process go to its log screen meanwhile: on the terminal they would spoil the picture.

    Raises:
        ConfigError: a setting cannot work.
        NotFoundError, RecordError: the recorded log cannot be read.
    """
    config = config or TuiConfig()
    config.check()
    view = FleetView(plane_config, fleet, config) if replay is None else await ReplayView.open(replay, config)
    app = SwiftbotApp(view, config, history=History(default_file()))
    before = structlog.get_config()
    structlog.configure(
        processors=[structlog.processors.add_log_level, partial(take_own_log, view.store)],
        cache_logger_on_first_use=False,
    )
    try:
        with enums_open(), gentle_collector():
            await app.run_async()
    finally:
        structlog.configure(**before)
