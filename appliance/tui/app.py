"""The application of the terminal UI: its screens, what keys and commands do, and how it is run.

It works at 80 columns by 24 lines over SSH, draws a few times a second and only what changed, and never stops because
the network does. An operation goes from key, command line or palette to its outcome: arguments asked for, allowed,
confirmed, carried out, shown. `run_tui` runs it in a terminal until the person leaves. Styles are in
`app.tcss`.
"""

import contextlib
import re
import sys
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import ClassVar, cast

import structlog
from rich.console import Group, RenderableType
from rich.text import Text
from textual import work
from textual.app import App
from textual.command import DiscoveryHit, Hit, Hits, Provider
from textual.css.query import NoMatches
from textual.driver import Driver
from textual.notifications import SeverityLevel
from textual.screen import Screen
from textual.widgets import Input

from appliance.alerts.rules import ordered
from appliance.errors import ConfigError, PayloadError, SwiftbotError, UnreachableError
from appliance.llm.rule_words import rule_words
from appliance.llm.stop_words import stop_request
from appliance.llm.training_words import training_request
from appliance.model import Approval, Site, TaskRecord
from appliance.model.alerts import Alert, AlertLevel, Subject
from appliance.model.messages import enums_open
from appliance.model.roles import lacks
from appliance.operations import STOP_IN_WORDS, Operation, read_rule
from appliance.plane.settings import PlaneConfig
from appliance.process import gentle_collector
from appliance.schedules import due
from appliance.tui import actions, command_line, task_view, themes
from appliance.tui.actions import PROMPTS, bindings, key_name, keymap, keys_of, shown
from appliance.tui.ascii_terminal import driver_for, in_browser
from appliance.tui.base_screen import FleetScreen
from appliance.tui.command_line import Command
from appliance.tui.replay import ReplayView, faster, rate_of, slower
from appliance.tui.safe import clip, safe
from appliance.tui.screens.alerts import AlertsScreen
from appliance.tui.screens.fleet import FleetOverview, GatewayScreen, PoolScreen
from appliance.tui.screens.learning import LearningScreen
from appliance.tui.screens.logs import LogScreen
from appliance.tui.screens.models import LlmScreen
from appliance.tui.screens.overview import OverviewScreen
from appliance.tui.screens.replay import ReplayScreen
from appliance.tui.screens.review import ReviewScreen
from appliance.tui.screens.robots import RobotScreen, RobotsScreen
from appliance.tui.screens.schedules import SchedulesScreen
from appliance.tui.screens.submit import History, SubmitDialog, default_file
from appliance.tui.screens.takeover import TakeoverScreen
from appliance.tui.screens.tasks import TaskScreen, TasksScreen
from appliance.tui.settings import TuiConfig
from appliance.tui.subscriptions import FleetView, View, take_own_log
from appliance.tui.task_view import state_cell
from appliance.tui.widgets import Lines
from appliance.tui.widgets.dialogs import ConfirmDialog, HelpDialog, TextDialog
from appliance.tui.widgets.simulation import SimulationDialog, command_of

SCREENS: dict[str, type[FleetScreen]] = {
    "overview": OverviewScreen,
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


log = structlog.get_logger(__name__)

NOTICE_CELLS = 180
"""Of a line of a notice: three lines of a window of 80 columns. The log screen has all of it."""
REPLAY_STEP_S = 10.0
"""How far a key goes in a recorded log."""
_UNSAID = ("stops", "alerts", "robots", "unknown", "roster")
"""Arguments that no person writes."""


def screen_of(alert: Alert) -> Screen[None] | None:
    """Return the screen of what an alert is about; None where there is none of its own."""
    match alert.subject:
        case Subject.GATEWAY:
            return GatewayScreen(alert.name)
        case Subject.ROBOT:
            return RobotScreen(alert.name)
        case Subject.TASK:
            return ReviewScreen(alert.name) if alert.kind == "plan-waits" else TaskScreen(alert.name)
        case _:
            return None


class OperationProvider(Provider):
    """Offers every operation of the registry in the command palette."""

    async def discover(self) -> Hits:
        """Yield all of them, in the order of the help."""
        for operation in actions.ACTIONS:
            yield DiscoveryHit(operation.title, self._call(operation), help=_palette_help(operation))

    async def search(self, query: str) -> Hits:
        """Yield those whose title or help matches."""
        matcher = self.matcher(query)
        for operation in actions.ACTIONS:
            text = _palette_help(operation)
            score = max(matcher.match(operation.title), matcher.match(text) / 2)
            if score > 0:
                yield Hit(score, matcher.highlight(operation.title), self._call(operation), help=text)

    def _call(self, operation: Operation) -> Callable[[], None]:
        return partial(cast("SwiftbotApp", self.app).action_act, operation.name)


def _palette_help(operation: Operation) -> str:
    keys = f" ({shown(operation)})" if operation.keys else ""
    return f"{operation.help}{keys} · {operation.role}"


class SwiftbotApp(App[None], inherit_bindings=False):
    """The terminal UI on a view of a fleet. What an action of its own does is a method `do_NAME`.

    Args:
        view: What is shown; closed with the app.
        config: How it looks and how often it is drawn.
        history: Instructions submitted before; kept in memory alone when none is given.
        driver: What writes to the terminal, if not Textual's own.
    """

    TITLE = "SwiftBot"
    BINDINGS = bindings()  # pyright: ignore[reportAssignmentType] - Textual wants a list of its own union
    MODES = SCREENS  # pyright: ignore[reportAssignmentType] - of classes, which make themselves
    DEFAULT_MODE = "overview"
    ENABLE_COMMAND_PALETTE: ClassVar[bool] = False
    """Textual would bind ^p to it for good; it is there all the same, under the keys of the action `palette`."""
    COMMANDS = {OperationProvider}  # pyright: ignore[reportAssignmentType] - of one class
    # Absolute: Textual looks beside the module of a subclass otherwise.
    CSS_PATH = Path(__file__).with_name("app.tcss")

    def __init__(
        self,
        view: View,
        config: TuiConfig | None = None,
        *,
        history: History | None = None,
        driver: type[Driver] | None = None,
    ) -> None:
        self.config = config or TuiConfig()
        self.config.check()
        self._own_keys = keymap(self.config.keys)
        if self.config.theme not in themes.BY_NAME:
            known = ", ".join(themes.BY_NAME)
            raise ConfigError(f"tui.theme is {self.config.theme!r}", remedy=f"there are: {known}")
        self._look = ""
        """The theme that styles were worked out for."""
        super().__init__(driver_class=driver)
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
        self._signalled: set[str] = set()
        """Critical alerts that the terminal has rung for, or would have."""
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
        self.signal_alerts()

    def draw(self, *, force: bool = False) -> None:
        """Draw what is new on the screen that is seen; the others wait until they are."""
        self.view.sync()
        if (front := self.front) is not None:
            front.flush(force=force)

    def signal_alerts(self) -> None:
        """Have the terminal ring, or notify the desktop, of critical alerts that were not there before."""
        open_now = {
            each.id: each
            for each in self.view.store.alerts.values()
            if each.level is AlertLevel.CRITICAL and each.acked is None
        }
        new = [each for name, each in open_now.items() if name not in self._signalled]
        self._signalled = set(open_now)
        if not new or not self.view.steerable:
            return  # a recorded log calls nobody
        if "bell" in self.config.signals:
            self.write_terminal("\a")
        if "notification" in self.config.signals:
            more = f" and {len(new) - 1} more" if len(new) > 1 else ""
            self.write_terminal(f"\x1b]9;{safe(f'SwiftBot {self.view.fleet}: {new[0].what}{more}', 200)}\a")

    def write_terminal(self, sequence: str) -> None:
        """Send a control sequence to the terminal."""
        if self._driver is not None and not self.is_headless:
            self._driver.write(sequence)

    def delay_update(self, delay: float = 0.05) -> None:
        """Hold painting back while screens change; shorter than Textual does, since ours are drawn at once."""
        super().delay_update(min(delay, 0.005))

    def refresh_css(self, animate: bool = True) -> None:
        """Work out the styles again when the colours have changed.

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

    # --- messages --------------------------------------------------------------------------------------------

    def tell(self, error: SwiftbotError) -> None:
        """Show an error with its remedy; the log screen keeps it."""
        self.view.store.add(time.time_ns(), kind="order", level="error", source="tui", text=str(error))
        remedy = f"\n→ {safe(error.remedy)}" if error.remedy else ""
        self.notify(f"✘ {safe(error.message)}{remedy}", severity="error", timeout=10, markup=False)

    def notify(
        self,
        message: str,
        *,
        title: str = "",
        severity: SeverityLevel = "information",
        timeout: float | None = None,
        markup: bool = True,
    ) -> None:
        """Show a notice; of more than there is room for the latest are seen, and of long ones the beginning."""
        message = "\n".join(clip(line, NOTICE_CELLS) for line in message.splitlines()[:4])
        super().notify(message, title=title, severity=severity, timeout=timeout, markup=markup)
        self.call_later(self._drop_notices)

    def _drop_notices(self) -> None:
        """Take away those that there is no room for, the oldest first."""
        for older in list(self._notifications)[: -max(2, self.size.height // 10)]:
            self._unnotify(older)

    def read(self, title: str, content: RenderableType) -> None:
        """Show something to be read at leisure."""
        self.push_screen(TextDialog(title, content))

    def export_svg(self, path: Path) -> None:
        """Write a picture of the screen as it is now, without references to fonts on other machines."""
        path.write_text(_FONT.sub("", self.export_screenshot(title=f"SwiftBot · {self.view.fleet}")))

    # --- orders --------------------------------------------------------------------------------------------------

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """Leave the keys of the prompt to whatever is being written, and to dialogs."""
        if action == "act" and parameters and (found := actions.BY_NAME.get(str(parameters[0]))) is not None:
            front = self.front
            if found.recorded and self.view.steerable and (front is None or front.scope != "replay"):
                return False  # the key is whatever else there is
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
        if action.writes and (own := self.view.role) is not None and lacks(own, action.role):
            self.notify(
                f"{action.name} needs the role {action.role}; your certificate is a {own}'s", severity="warning"
            )
            return
        if action.writes and not (action.always and self._steered.steerable) and not self._allowed():
            return
        if command.missing:
            self._ask_for(command)
        elif action.call:
            method, _, fixed = action.call.partition(" ")
            getattr(self, f"do_{method}")(*([fixed] if fixed else []), command.given)
        elif action.dangerous:
            # Before the question: what is stopped, or begins, while it is open was not seen.
            command.given.update({name: self._seen(name) for name in action.seen})

            def answered(yes: bool | None) -> None:
                if yes:
                    self.carry_out(command)

            self.push_screen(ConfirmDialog(safe(action.sentence(command.given))), answered)
        else:
            self.carry_out(command)

    def _seen(self, what: str) -> str:
        store = self.view.store
        if what == "stops":
            return "/".join(each.id for each in store.stops.active)
        return "/".join(each.id for each in ordered(store.alerts.values()) if each.acked is None)

    def stops_in_words(self, text: str) -> bool:
        """Carry a text out that is a soft stop, as the stop key does it, read-only as well; False when it is none."""
        view = self._steered
        roster = tuple(view.store.robots)
        if not view.steerable or (stop := stop_request(text, roster)) is None:
            return False
        given = {"robots": "/".join(stop.robots), "unknown": "/".join(stop.unknown), "roster": "/".join(roster)}
        self.carry_out(Command(action=STOP_IN_WORDS, given={**given, "why": text}))
        return True

    def trains_in_words(self, text: str) -> bool:
        """Ask about the run of federated learning that a text asks for, then start it; False when it is none.

        One on robots that there are not is left to the planner, which refuses it with the command.
        """
        training = training_request(text, tuple(self.view.store.robots))
        if training is None or training.unknown:
            return False
        given = {"recipe": training.recipe, "robots": ",".join(training.robots), "why": text}
        if training.rounds is not None:
            given["rounds"] = str(training.rounds)
        self.call_later(self.begin, command_line.fill(actions.BY_NAME["learn-start"], given, {}))
        return True

    def rules_in_words(self, text: str) -> bool:
        """Read the standing rule back that a text says, then add it if it is meant; False when it says none.

        While the site's places are not known the planner refuses it, with the command.
        """
        site = self.view.store.asked.get(command_line.PLACES)
        found = rule_words(text, list(self.view.store.robots.values()), site if isinstance(site, Site) else None)
        if found is None or found.rule is None:
            return False
        self.call_later(self.begin, command_line.fill(actions.BY_NAME["add-rule"], {"text": text}, {}))
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
        view = self._steered if action.always else self.view
        try:
            outcome = await action.run(view.orders, command.given)
        except SwiftbotError as error:
            if action.always and isinstance(error, UnreachableError):
                error.remedy = "stop the robots by their own means"
            self.note(line, error.message, level="error")
            self.tell(error)
        except Exception as error:  # supervision boundary: one order's defect must not end the UI
            log.exception("an order failed", order=line)
            self.notify(f"internal error: {safe(repr(error), 200)}", severity="error", markup=False)
        else:
            text = outcome.text
            if isinstance(outcome.value, TaskRecord):
                # It is heard as well, but perhaps later than the person looks.
                self.view.store.take_task(outcome.value)
                text = text or f"task {outcome.value.id}: {state_cell(outcome.value)[0]}"
            if action.long:
                body = Text(text) if isinstance(text, str) else text
                notes = (Text(note, "yellow") for note in outcome.notes)
                self.push_screen(TextDialog(f":{safe(line, 80)}", Group(body, *notes)))
            else:
                text = "; ".join((str(text), *outcome.notes))
                self.note(line, text)
                self.notify(safe(text), markup=False)
        finally:
            self.under_way.pop(line, None)
            with contextlib.suppress(NoMatches):  # an answer may come while the screen goes
                self.draw()

    def note(self, line: str, outcome: str, *, level: str = "info") -> None:
        """Put an order and what came of it on the log screen."""
        text = f":{line} → {outcome}"
        self.view.store.add(time.time_ns(), kind="order", level=level, source=self.view.operator, text=text)

    # --- what its own actions do ---------------------------------------------------------------------------------

    def do_screen(self, name: str, _given: Mapping[str, str]) -> None:
        """Show a screen; from what was drilled into there, its beginning."""
        if name == self.current_mode:
            while len(self.screen_stack) > 1 and not self.screen.is_modal:
                self.pop_screen()
            return
        self.switch_mode(name)

    def do_alerts(self, _given: Mapping[str, str]) -> None:
        """Show the alerts, over whatever is seen; where they are shown already, go to the most urgent."""
        if isinstance(self.screen, AlertsScreen):
            self.screen.go_to_first()
        else:
            self.push_screen(AlertsScreen())

    def do_schedules(self, _given: Mapping[str, str]) -> None:
        """Show schedules and what is out of use, over whatever is seen."""
        if not isinstance(self.screen, SchedulesScreen):
            self.push_screen(SchedulesScreen())

    def show_alert(self, name: str) -> None:
        """Open what an alert is about; a question is answered in the prompt."""
        alert = self.view.store.alerts.get(name)
        if alert is None:
            return
        if alert.subject is Subject.QUESTION:
            self.run_line(f"answer {alert.name}")
        elif (found := screen_of(alert)) is not None:
            self.push_screen(found)
        else:
            if isinstance(self.screen, AlertsScreen):
                self.pop_screen()  # else it waits there, on this alert, until somebody comes back to that screen
            self.run_line("fleet")

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
            begins=lambda text: self.trains_in_words(text) or self.rules_in_words(text),
        )
        self.push_screen(dialog, submitted)

    @work(group="orders")
    async def do_rule(self, given: Mapping[str, str]) -> None:
        """Read back the rule that a text says; it is added once a person says that it is meant."""
        try:
            rule = await read_rule(self.view.orders, given["text"], due.local_zone())
        except SwiftbotError as error:
            self.tell(error)
            return
        command = Command(action=actions.BY_NAME["add-rule"], given={"text": rule.text})

        def answered(yes: bool | None) -> None:
            if yes:
                self.carry_out(command)

        self.push_screen(ConfirmDialog(safe(command.action.sentence(command.given))), answered)

    def do_review(self, given: Mapping[str, str]) -> None:
        """Look at the plan of a task that waits for approval: of the selected task, else the one that waits longest."""
        tasks = self.view.store.tasks
        record = tasks.get(given["task"])
        if record is not None and task_view.waits(record) is None:
            waiting = [each for each in tasks.values() if task_view.waits(each) is not None]
            if not waiting:
                self.notify(f"no plan of {safe(record.id, 64)} waits for approval", markup=False)
                return
            record = min(waiting, key=lambda each: (each.created_ns, each.id))
            self.notify(f"this is the plan of {safe(record.id, 64)}, which waits longest", markup=False)
        self.push_screen(ReviewScreen(record.id if record is not None else given["task"]))

    def do_simulate(self, given: Mapping[str, str]) -> None:
        """Run the plan of a task on simulated robots, and show how it goes."""
        task = given["task"]
        try:
            command = command_of(task, self.view.orders.endpoint)
        except SwiftbotError as error:
            self.tell(error)
        else:
            self.push_screen(SimulationDialog(task, command))

    def do_takeover(self, given: Mapping[str, str]) -> None:
        """Take a robot over, after asking."""
        robot = given["robot"]

        def answered(yes: bool | None) -> None:
            if yes:
                self.push_screen(TakeoverScreen(robot, why=given.get("why", "")))

        question = (
            f"Take {robot} over? It holds and obeys only you until you release it; what it does for a task waits "
            "or fails. It is released when you leave the screen."
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

    def do_replay(self, name: str, given: Mapping[str, str]) -> None:
        """Play, pause, seek or change the rate of the log that is shown, on whichever screen."""
        replay = self.view
        if not isinstance(replay, ReplayView):
            self.notify(
                "no log is open\n→ Enter on a file of screen 8, or :open FILE", severity="warning", markup=False
            )
            return
        try:
            match name:
                case "play":
                    replay.play()
                case "ahead" | "behind":
                    replay.step(REPLAY_STEP_S if name == "ahead" else -REPLAY_STEP_S)
                case "faster" | "slower":
                    replay.change_rate(faster if name == "faster" else slower)
                case "rate":
                    rate = rate_of(given["rate"])
                    replay.change_rate(lambda _: rate)
                case _:
                    replay.seek(given["time"])
        except PayloadError as error:
            self.notify(f"{safe(error.message)}\n→ {error.remedy}", severity="error", markup=False)
        self.draw(force=True)

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
        """Copy what is marked; without any text marked, show how to leave."""
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


async def run_tui(
    plane_config: PlaneConfig, fleet: str, config: TuiConfig | None = None, *, replay: Path | None = None
) -> None:
    """Run the terminal UI on a fleet, or on a recorded log, until the person leaves (`swiftbot tui`).

    Log lines of this process go to its log screen meanwhile: on the terminal they would spoil the picture.

    Raises:
        ConfigError: a setting cannot work, or there is no terminal.
        NotFoundError, RecordError: the recorded log cannot be read.
    """
    config = config or TuiConfig()
    config.check()
    if not (in_browser() or (sys.stdin.isatty() and sys.stdout.isatty())):
        raise ConfigError(
            "the terminal UI needs a terminal: standard input or output is a file or a pipe",
            remedy="run it in a terminal, or `swiftbot tui --serve` for browsers",
        )
    view = FleetView(plane_config, fleet, config) if replay is None else await ReplayView.open(replay, config)
    app = SwiftbotApp(view, config, history=History(default_file()), driver=driver_for(config))
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
