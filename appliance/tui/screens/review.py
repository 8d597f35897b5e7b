"""A plan that waits for an operator: looked at, edited, checked again, approved or rejected.

What is approved is bound to the plan that was looked at: its hash goes along, and a gateway refuses when another plan
waits by then, or another operator was faster. An edited plan can only be approved once a gateway has validated it.
"""

from collections.abc import Callable, Mapping

from rich.text import Text
from textual import on, work
from textual.app import ComposeResult
from textual.widgets import Static

from appliance.errors import ConflictError, PayloadError, PlanError, SwiftbotError
from appliance.model import Plan, Proposal, Subtask, TaskRecord
from appliance.tui import plan_editor
from appliance.tui.actions import bindings
from appliance.tui.base_screen import FleetScreen
from appliance.tui.formatting import Cell, told
from appliance.tui.plan_editor import Draft, difference_text, params_text
from appliance.tui.safe import safe
from appliance.tui.store import Store
from appliance.tui.task_view import reason, state_cell, waits
from appliance.tui.widgets import Pane
from appliance.tui.widgets.dialogs import ConfirmDialog
from appliance.tui.widgets.grid import Column, Grid

SUBTASKS = (
    Column(title="subtask", width=10, grow=True),
    Column(title="skill", width=12),
    Column(title="robot", width=10),
    Column(title="parameters", width=20, grow=True),
    Column(title="after", width=10),
)

Given = Mapping[str, str]


def step_cells(node: tuple[Subtask, int]) -> tuple[Cell, ...]:
    """Return the row of a subtask of a draft."""
    subtask, depth = node
    return (
        (f"{plan_editor.branch(depth)}{safe(subtask.id, 30)}", "bold"),
        (safe(subtask.skill, 40), "cyan"),
        safe(subtask.robot or "a gateway", 63),
        safe(params_text(subtask.params), 200),
        safe(", ".join(subtask.after), 80),
    )


class ReviewScreen(FleetScreen):
    """The plan of a task that waits for approval."""

    scope = "review"
    tab = "tasks"
    shows = ("tasks", "robots")
    BINDINGS = bindings("review")

    def __init__(self, task: str) -> None:
        super().__init__()
        self.task_id = task
        self.draft: Draft | None = None
        """The plan as edited; None until there is one to look at."""
        self._hash = ""
        """Of the proposed plan that the draft began with: what approval is bound to."""
        self._checked: Plan | None = None
        """The edited plan that a gateway has looked at last."""
        self._problems: tuple[str, ...] = ()
        self._note = ""
        self._busy = False

    def title_of(self) -> str:
        """Return the task."""
        return f"{self.task_id} review"

    def body(self) -> ComposeResult:
        """Make the parts."""
        yield Static(id="about")
        yield Grid(SUBTASKS, step_cells, id="steps", empty="no plan waits")
        with Pane(id="changes-box"):
            yield Static(id="changes")

    # --- drawing ---------------------------------------------------------------------------------------------------

    @property
    def record(self) -> TaskRecord | None:
        """The task as it is now."""
        return self.store.tasks.get(self.task_id)

    @property
    def proposal(self) -> Proposal | None:
        """The plan that waits now."""
        record = self.record
        return waits(record) if record is not None else None

    @property
    def superseded(self) -> bool:
        """Whether another plan waits by now than the one that is looked at."""
        proposal = self.proposal
        return proposal is not None and bool(self._hash) and proposal.hash != self._hash

    def draw_body(self, store: Store) -> None:
        """Show the draft, what it changes, and whether it may run."""
        _ = store
        proposal = self.proposal
        if self.draft is None and proposal is not None:
            self.draft, self._hash = Draft.of(proposal.plan), proposal.hash
        self.query_one("#about", Static).update(self._about(proposal))
        if self.draft is None:
            self.query_one("#steps", Grid).show({})
            self.query_one("#changes", Static).update(Text())
            return
        level = plan_editor.depths(self.draft.subtasks)
        by_id = {each.id: each for each in self.draft.subtasks}
        rows = {name: (by_id[name], level[name]) for name in plan_editor.ordered(self.draft.subtasks)}
        self.query_one("#steps", Grid).show(rows)
        self.query_one("#changes", Static).update(self._changes(self.draft))

    def _about(self, proposal: Proposal | None) -> Text:
        record = self.record
        if record is None:
            return Text(f"task {safe(self.task_id, 80)} is not known (any more)", "yellow")
        out = Text.assemble(state_cell(record), f" · {safe(record.instruction, 300)}")
        if proposal is None:
            word = record.decision
            said = (
                f"{'approved' if word.approved else 'rejected'} by {safe(word.by or 'an operator', 60)}"
                f"{f': {safe(word.why, 120)}' if word.why else ''}"
                if word is not None
                else told(record.failure) or "no plan of it waits"
            )
            out.append(f"\n▲ {said}; Esc leaves", "yellow")
        elif self.superseded:
            out.append("\n▲ another plan waits by now: :edit-reload looks at that one", "bold yellow")
        else:
            out.append(f"\n… {reason(record)}", "yellow")
            out.append(f"\nplan {safe(proposal.hash, 16)}", "dim")
        return out

    def _changes(self, draft: Draft) -> Text:
        out = Text()
        if self._busy:
            out.append("… asking a gateway\n", "dim")
        elif not draft.changed:
            out.append("as proposed: the gateway has checked it\n", "green")
        elif self._checked != draft.plan:
            out.append("… not checked yet\n", "yellow")
        elif self._problems:
            out.append("✘ invalid plan\n", "red")
            for problem in self._problems:
                out.append(f"  · {safe(problem, 300)}\n", "red")
        else:
            out.append("✔ checked: it may run\n", "green")
        if self._note:
            out.append(f"{safe(self._note, 400)}\n", "yellow")
        if draft.changed:
            out.append_text(difference_text(draft.proposed, draft.plan))
        return out

    def chosen(self) -> dict[str, str]:
        """Return the task and the selected subtask of the draft."""
        selected = self.query_one("#steps", Grid).selected
        return {"task": self.task_id} | ({"step": selected} if selected is not None else {})

    @on(Grid.Picked)
    def _picked(self, event: Grid.Picked) -> None:
        event.stop()
        self.do_edit_params({"step": event.key})

    # --- edits -----------------------------------------------------------------------------------------------------

    def _edit(self, make: Callable[[Draft], Draft]) -> None:
        """Take another draft, or say why it is none; then have it checked."""
        self._note = ""
        if self.draft is None:
            return
        try:
            draft = make(self.draft)
        except PayloadError as error:
            self._note = f"{error.message} → {error.remedy}"
            self.flush(force=True)
            return
        self.draft = draft
        self.flush(force=True)
        if draft.changed:
            self._check(draft.plan)

    def do_edit_robot(self, given: Given) -> None:
        """Have another robot do the subtask."""
        self._edit(lambda draft: draft.with_robot(given["step"], given["robot"]))

    def do_edit_params(self, given: Given) -> None:
        """Give the subtask other parameters; without any, they are written to be changed."""
        step = given["step"]
        if "parameters" in given:
            self._edit(lambda draft: draft.with_params(step, given["parameters"]))
        elif self.draft is not None and step in self.draft.ids:
            text = params_text(self.draft.of_id(step).params)
            self.prompt.open(":", f"edit-params {step} {text}", 'name=value name="two words"')

    def do_edit_after(self, given: Given) -> None:
        """Have the subtask begin after others; without any, at once."""
        step = given["step"]
        if "others" not in given:
            if self.draft is not None and step in self.draft.ids:
                text = " ".join(self.draft.of_id(step).after) or "-"
                self.prompt.open(":", f"edit-after {step} {text}", "ids of subtasks that it comes after, or -")
            return
        others = [] if given["others"] == "-" else given["others"].replace(",", " ").split()
        self._edit(lambda draft: draft.with_after(step, others))

    def do_edit_out(self, given: Given) -> None:
        """Take the subtask out."""
        self._edit(lambda draft: draft.without(given["step"]))

    def do_edit_up(self, given: Given) -> None:
        """Have the subtask come before the one it comes after."""
        self._edit(lambda draft: draft.moved(given["step"], -1))

    def do_edit_down(self, given: Given) -> None:
        """Have the subtask come after the one that follows it."""
        self._edit(lambda draft: draft.moved(given["step"], 1))

    def do_edit_undo(self, _given: Given) -> None:
        """Go back one edit."""
        self._edit(lambda draft: draft.undone())

    def do_edit_reload(self, _given: Given) -> None:
        """Look at the plan that waits now, without the edits."""
        self.draft = None
        self._hash = self._note = ""
        self._checked = None
        self.flush(force=True)

    @work(exclusive=True, group="check")
    async def _check(self, plan: Plan) -> None:
        """Have a gateway look at the edited plan."""
        self._busy = True
        self.flush(force=True)
        try:
            answer = await self.view.orders.check_plan(plan, task=self.task_id)
        except SwiftbotError as error:
            self._checked = None
            self._note = f"it could not be checked: {error.message} → {error.remedy or 'try again'}"
        else:
            self._checked, self._problems = plan, answer.problems
        finally:
            self._busy = False
            if self.ready:
                self.flush(force=True)

    # --- the word --------------------------------------------------------------------------------------------------

    def do_approve(self, given: Given) -> None:
        """Let the plan run as it stands here, after asking."""
        draft = self.draft
        if draft is None or self.proposal is None or self.superseded:
            self._note = "there is nothing to approve here any more"
        elif draft.changed and self._checked != draft.plan:
            self._note = "the edited plan has not been checked yet: it is asked for"
            self._check(draft.plan)
        elif draft.changed and self._problems:
            self._note = "invalid plan: correct it, or undo edits"
        else:
            count = len(draft.subtasks)
            what = "the edited plan" if draft.changed else "the plan"
            robots = sorted({each.robot for each in draft.subtasks if each.robot})
            question = f"Approve {what} of {self.task_id}? {count} subtask{'s' if count != 1 else ''} will run"
            question += f", on {', '.join(robots)}." if robots else " on gateways."

            def answered(yes: bool | None) -> None:
                if yes:
                    self._approve(given.get("why", ""))

            self.application.push_screen(ConfirmDialog(safe(question)), answered)
            return
        self.flush(force=True)

    @work(exclusive=True, group="word")
    async def _approve(self, why: str) -> None:
        draft = self.draft
        if draft is None:
            return
        plan = draft.plan if draft.changed else None
        try:
            record = await self.view.orders.approve(self.task_id, plan_hash=self._hash, plan=plan, why=why)
        except PlanError as error:
            self._checked, self._problems = draft.plan, error.problems or (error.message,)
            self.flush(force=True)
        except SwiftbotError as error:
            self._told(error)
        else:
            self._done(record, "approved")

    def do_reject(self, given: Given) -> None:
        """Turn the plan down, after asking."""
        if self.proposal is None:
            self._note = "there is nothing to reject here any more"
            self.flush(force=True)
            return
        question = f"Reject the plan of {self.task_id}? Nothing of it runs, and the task ends."

        def answered(yes: bool | None) -> None:
            if yes:
                self._reject(given.get("why", ""))

        self.application.push_screen(ConfirmDialog(safe(question)), answered)

    @work(exclusive=True, group="word")
    async def _reject(self, why: str) -> None:
        try:
            record = await self.view.orders.reject(self.task_id, plan_hash=self._hash, why=why)
        except SwiftbotError as error:
            self._told(error)
        else:
            self._done(record, "rejected")

    def _told(self, error: SwiftbotError) -> None:
        """Show the outcome; of two operators, the slower one sees who was faster."""
        faster = "another operator was faster: " if isinstance(error, ConflictError) else ""
        self._note = f"{faster}{error.message} → {error.remedy or 'look at the task again'}"
        self.notify(safe(self._note), severity="error", markup=False)
        self.flush(force=True)

    def _done(self, record: TaskRecord, what: str) -> None:
        self.store.take_task(record)
        self.notify(safe(f"{what}: {record.id} is {record.state}"), markup=False)
        if self.is_current:
            self.application.pop_screen()
