"""The terminal UI itself: what its own actions do, screens and dialogs, and the change to a recorded log and back."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from textual.app import SystemCommand
from textual.screen import Screen

from appliance.errors import SwiftbotError
from appliance.model import Approval, TaskRecord
from appliance.tui import actions, themes
from appliance.tui.action import key_name
from appliance.tui.dialogs import ConfirmDialog
from appliance.tui.help import HelpDialog
from appliance.tui.keys import keys_of
from appliance.tui.ordering import Ordering
from appliance.tui.replay.source import ReplayView
from appliance.tui.robots.takeover import TakeoverScreen
from appliance.tui.safe import safe
from appliance.tui.tasks.review import ReviewScreen
from appliance.tui.tasks.submit import SubmitDialog


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
