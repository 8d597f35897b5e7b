"""What a person wants, from key or command line to what came of it: asked, allowed, confirmed, carried out, told."""

import contextlib
import time

import structlog
from textual.css.query import NoMatches
from textual.widgets import Input

from appliance.errors import SwiftbotError, UnreachableError
from appliance.llm.stop_words import stop_request
from appliance.model import TaskRecord
from appliance.tui import actions, grammar, themes
from appliance.tui.data import View
from appliance.tui.dialogs import ConfirmDialog, TextDialog
from appliance.tui.frame import FleetScreen
from appliance.tui.grammar import Command
from appliance.tui.keys import PROMPTS
from appliance.tui.robots.actions import STOP_IN_WORDS
from appliance.tui.safe import safe
from appliance.tui.shell import Shell
from appliance.tui.tasks.facts import state_cell

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
        self.begin(grammar.fill(actions.BY_NAME[name], {}, chosen))

    def run_line(self, line: str) -> None:
        """Do what a command line says."""
        chosen = self.front.chosen() if self.front is not None else {}
        try:
            command = grammar.read(line, chosen)
        except SwiftbotError as error:
            self.tell(error)
            return
        self.begin(command)

    def completions(self, line: str) -> tuple[str, ...]:
        """Return command lines that go on from this one."""
        return grammar.complete(line, self.view.store, {"theme": themes.BY_NAME})

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
            command = grammar.fill(command.action, command.given, {"enquiry": oldest.id})
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
