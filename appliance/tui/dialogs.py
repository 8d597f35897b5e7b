"""What the terminal UI asks: an instruction and whether its plan is wanted, whether to cancel, and the help."""

from rich.table import Table
from rich.text import Text
from textual import on, work
from textual.app import ComposeResult
from textual.binding import Binding
from textual.containers import Vertical, VerticalScroll
from textual.screen import ModalScreen
from textual.widgets import Input, Label, Static

from appliance.errors import PlanError, SwiftbotError
from appliance.model import TaskRecord
from appliance.tasks.api import PlanAnswer
from appliance.tui import drawing
from appliance.tui.actions import ACTIONS
from appliance.tui.data import View

_ASK = "Enter plans it · Esc leaves"
_REVIEW = "Enter runs this plan · edit for another · Esc leaves"
INSTRUCTION_LIMIT = 2000
"""Characters of an instruction; a gateway refuses longer ones as well."""


class SubmitDialog(ModalScreen[TaskRecord | None]):
    """Takes an instruction, shows its plan, and submits exactly that plan when it is confirmed."""

    BINDINGS = [Binding("escape", "leave", "Leave")]

    def __init__(self, view: View, *, task_id: str) -> None:
        super().__init__()
        self._view = view
        self._task_id = task_id
        self._answer: PlanAnswer | None = None
        self._planned = ""
        """The instruction that `_answer` is the plan of."""
        self._busy = False

    def compose(self) -> ComposeResult:
        """Make the dialog."""
        with Vertical(classes="dialog"):
            yield Label("What shall the robots do?", classes="title")
            yield Input(
                placeholder="e.g. drone-1: fly to the gate and take a picture",
                id="instruction",
                max_length=INSTRUCTION_LIMIT,
            )
            with VerticalScroll(id="plan-box"):
                yield Static(id="plan")
            yield Static(_ASK, id="hint")

    @on(Input.Changed, "#instruction")
    def edited(self, event: Input.Changed) -> None:
        """The shown plan is of another instruction: it must not be run any more."""
        if self._answer is not None and event.value.strip() != self._planned:
            self._answer = None
            self._show(Text(), _ASK)

    @on(Input.Submitted, "#instruction")
    def entered(self, event: Input.Submitted) -> None:
        """Plan the instruction, or run the plan that is shown for it."""
        instruction = event.value.strip()
        if self._busy:
            return
        if not instruction:
            self._show(Text("Write an instruction first.", "yellow"), _ASK)
        elif self._answer is None:
            self._plan(instruction)
        else:
            self._submit(self._planned, self._answer)

    @work(exclusive=True)
    async def _plan(self, instruction: str) -> None:
        self._busy = True
        self._show(Text("planning …", "dim"), "nothing runs yet · Esc leaves")
        try:
            answer = await self._view.plan(instruction)
        except SwiftbotError as error:
            self._fail(error)
        else:
            if self.query_one("#instruction", Input).value.strip() == instruction:
                self._answer, self._planned = answer, instruction
                self._show(drawing.answer_text(answer), _REVIEW)
            else:
                self._show(Text("The instruction was edited meanwhile.", "yellow"), _ASK)
        finally:
            self._busy = False

    @work(exclusive=True)
    async def _submit(self, instruction: str, answer: PlanAnswer) -> None:
        self._busy = True
        self.query_one("#hint", Static).update("submitting …")
        try:
            record = await self._view.submit(instruction, plan=answer.plan, task_id=self._task_id)
        except SwiftbotError as error:
            # The plan stays confirmed under the same task id: Enter again cannot make a second task.
            text = drawing.answer_text(answer)
            text.append(f"✘ {error.message}\n{error.remedy}", "red")
            self._show(text, "Enter tries again · Esc leaves")
        else:
            self.dismiss(record)
        finally:
            self._busy = False

    def _fail(self, error: SwiftbotError) -> None:
        text = Text(f"✘ {error.message}\n", "red")
        if isinstance(error, PlanError):
            for problem in error.problems:
                text.append(f"  · {problem}\n", "red")
        if error.remedy:
            text.append(f"→ {error.remedy}", "yellow")
        self._show(text, _ASK)

    def _show(self, text: Text, hint: str) -> None:
        self.query_one("#plan", Static).update(text)
        self.query_one("#hint", Static).update(hint)

    def action_leave(self) -> None:
        """Leave without running anything more."""
        self.dismiss(None)


class ConfirmDialog(ModalScreen[bool]):
    """Asks yes or no; no is the answer of every key but y and Enter."""

    BINDINGS = [
        Binding("y,enter", "answer(True)", "Yes"),
        Binding("n,escape,q", "answer(False)", "No"),
    ]

    def __init__(self, question: str) -> None:
        super().__init__()
        self._question = question

    def compose(self) -> ComposeResult:
        """Make the dialog."""
        with Vertical(classes="dialog small"):
            yield Static(Text(self._question), classes="title")
            yield Static("y or Enter: yes · n or Esc: no", id="hint")

    def action_answer(self, yes: bool) -> None:
        """Give the answer."""
        self.dismiss(yes)


class HelpDialog(ModalScreen[None]):
    """All actions with their keys, and what the signs mean."""

    BINDINGS = [Binding("escape,q,question_mark,enter", "leave", "Leave")]

    def compose(self) -> ComposeResult:
        """Make the dialog out of the list of actions."""
        table = Table(box=None, pad_edge=False, show_header=False)
        for action in ACTIONS:
            table.add_row(Text(action.shown, "bold cyan"), Text(action.title), Text(action.help, "dim"))
        table.add_row(Text("^p", "bold cyan"), Text("Palette"), Text("All of these by name", "dim"))
        with VerticalScroll(classes="dialog"):
            yield Label("Keys", classes="title")
            yield Static(table, id="keys")
            yield Static("· waiting  ○ ready  ◔ sent  ● running  ✔ succeeded  ✘ failed  ⊘ cancelled", id="signs")
            yield Static("Esc leaves", id="hint")

    def action_leave(self) -> None:
        """Close the help."""
        self.dismiss(None)
