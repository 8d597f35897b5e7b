"""Takes an instruction, with history and completion of names, shows its plan, and submits exactly that plan.

The history is the instructions that were submitted from this account: kept in a file, newest last, for the arrow keys.
A file that cannot be read or written costs the history and nothing else: the cause is shown once, as a sentence.
Completed are robots, places and skills of this fleet, case ignored.
"""

import contextlib
import os
import tempfile
import uuid
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import msgspec
from rich.text import Text
from textual import on, work
from textual.app import ComposeResult
from textual.binding import Binding
from textual.containers import Vertical
from textual.screen import ModalScreen
from textual.widgets import Input, Label, Static

from appliance.errors import PlanError, SwiftbotError
from appliance.model import Approval, RobotInfo, Site, TaskRecord, TaskRequest
from appliance.model.task_api import PlanAnswer
from appliance.tui import plan_editor
from appliance.tui.actions import DIALOG_KEYS, key_name
from appliance.tui.command_line import PLACES
from appliance.tui.safe import safe
from appliance.tui.subscriptions import View
from appliance.tui.task_view import plan_lines
from appliance.tui.widgets import Field, Pane

MOST_WORDS = 4
"""Words of a name that may have been written already: "the north cold store"."""


def completions(text: str, names: Iterable[str], *, most: int = 20) -> tuple[str, ...]:
    """Return texts that complete the end of `text` by a name, the likeliest first; none when nothing is begun there.

    Names of several words ("dock 3") are completed from any of their words on. A name that stands there whole already
    is none.
    """
    if not text or text[-1].isspace():
        return ()
    known = sorted(set(names), key=lambda each: (len(each), each))
    words = text.split(" ")
    found: list[str] = []
    # The longest beginning first: what was written of "cold st" means the cold store rather than the station.
    for count in range(min(MOST_WORDS, len(words)), 0, -1):
        begun = " ".join(words[-count:])
        bare = begun.lstrip("(\"'")
        before = text[: len(text) - len(bare)]
        for name in known:
            if bare and name.lower().startswith(bare.lower()) and len(name) > len(bare):
                made = before + name
                if made not in found:
                    found.append(made)
    return tuple(found[:most])


def common(found: Iterable[str]) -> str:
    """Return the longest beginning that all of them share, by which Tab goes on when there are several."""
    found = list(found)
    if not found:
        return ""
    low, high = min(found), max(found)
    for place, each in enumerate(low):
        if place >= len(high) or each != high[place]:
            return low[:place]
    return low


MOST = 500
MOST_BYTES = 2**20


def default_file() -> Path:
    """Where the history is: under XDG_STATE_HOME."""
    state = os.environ.get("XDG_STATE_HOME") or str(Path.home() / ".local" / "state")
    return Path(state) / "swiftbot" / "instructions.json"


class History:
    """The instructions, and a place among them while the arrow keys are used."""

    def __init__(self, file: Path | None = None) -> None:
        self.file = file
        self.problem = ""
        """Why it was not read or kept; empty when all is well."""
        self.entries: list[str] = self._read()
        self._at = len(self.entries)
        self._begun = ""

    def _read(self) -> list[str]:
        if self.file is None:
            return []
        try:
            with self.file.open("rb") as stream:
                data = stream.read(MOST_BYTES + 1)
            if len(data) > MOST_BYTES:
                self.problem = f"{self.file} is larger than {MOST_BYTES} bytes: the history starts empty"
                return []
            return msgspec.json.decode(data, type=list[str])[-MOST:]
        except FileNotFoundError:
            return []
        except (OSError, msgspec.MsgspecError) as error:
            self.problem = f"{self.file} cannot be read: {error}"
            return []

    def add(self, instruction: str) -> None:
        """Keep an instruction as the newest; the same one is kept once."""
        instruction = instruction.strip()
        if not instruction:
            return
        self.entries = [*(each for each in self.entries if each != instruction), instruction][-MOST:]
        self.rewind()
        self._write()

    def _write(self) -> None:
        if self.file is None:
            return
        temporary = ""
        try:
            self.file.parent.mkdir(parents=True, exist_ok=True)
            # Instructions may name people and places: for this account alone (mkstemp makes it 0600).
            handle, temporary = tempfile.mkstemp(dir=self.file.parent, prefix=".instructions-")
            with os.fdopen(handle, "wb") as stream:
                stream.write(msgspec.json.encode(self.entries))
            Path(temporary).replace(self.file)
        except OSError as error:
            self.problem = f"{self.file} cannot be written: {error.strerror}"
            if temporary:
                with contextlib.suppress(OSError):
                    Path(temporary).unlink()

    # --- going through it ---------------------------------------------------------------------------------------

    def rewind(self) -> None:
        """Stand after the newest again."""
        self._at = len(self.entries)
        self._begun = ""

    def older(self, text: str) -> str:
        """Return the instruction before; `text` is what is written now, which comes back at the end."""
        if self._at == len(self.entries):
            self._begun = text
        self._at = max(0, self._at - 1)
        return self.entries[self._at] if self.entries else text

    def newer(self, text: str) -> str:
        """Return the instruction after, at the end what had been begun."""
        if self._at >= len(self.entries):
            return text
        self._at += 1
        return self.entries[self._at] if self._at < len(self.entries) else self._begun


_ASK = "Enter plans it · Tab completes names · ↑ earlier ones · Esc leaves"
_REVIEW = "Enter runs this plan · {key} edits it first · Esc leaves"
INSTRUCTION_LIMIT = 2000
"""Characters of an instruction; a gateway refuses longer ones as well."""


class InstructionInput(Field):
    """The line: Tab completes, the arrows bring back earlier instructions; pasted lines are orders of their own."""

    def joined(self, lines: Sequence[str]) -> str:
        """Return pasted lines as one instruction, each an order that ends where its line does."""
        ended = [line if line[-1] in ".,;!" else f"{line};" for line in lines]
        return " ".join(ended).removesuffix(";")

    BINDINGS = [
        Binding("tab", "complete", show=False),
        Binding("up", "recall(-1)", show=False),
        Binding("down", "recall(1)", show=False),
    ]

    def __init__(self, text: str, history: History, *, id: str) -> None:  # noqa: A002 - Textual's name
        super().__init__(
            text,
            placeholder="an order, such as ROBOT: go to PLACE",
            max_length=INSTRUCTION_LIMIT,
            select_on_focus=False,
            id=id,
        )
        # Over a slow link a blinking cursor is traffic, and nothing else.
        self.cursor_blink = False
        self.names: tuple[str, ...] = ()
        """Names that are completed."""
        self._history = history
        self._found: tuple[str, ...] = ()
        self._turn = -1

    def action_complete(self) -> None:
        """Go on with what all completions have in common; once there, one after the other."""
        if self._turn >= 0 and self.value in self._found:
            self._turn = (self._turn + 1) % len(self._found)
            self._put(self._found[self._turn])
            return
        self._found, self._turn = completions(self.value, self.names), -1
        shared = common(self._found)
        if len(shared) > len(self.value):
            self._put(shared)
        elif self._found:
            self._turn = 0
            self._put(self._found[0])

    def action_recall(self, step: int) -> None:
        """Bring back another instruction."""
        self._put(self._history.older(self.value) if step < 0 else self._history.newer(self.value))

    def _put(self, text: str) -> None:
        self.value = text
        self.cursor_position = len(text)


def answer_text(answer: PlanAnswer) -> Text:
    """Draw the answer to a question for a plan: the plan, and what each tier that was asked made of it."""
    plan = answer.plan
    holds = plan.provenance.confirm if plan.provenance is not None else ()
    count = len(plan.subtasks)
    out = Text()
    out.append(
        f"{safe(plan.domain, 40)}: {count} subtask{'s' if count != 1 else ''}, {plan_editor.at_once(plan)} at once · "
        f"{plan.tier} tier, {plan.confidence:.0%} sure, {plan.latency_ms:.0f} ms\n",
        "bold",
    )
    out.append_text(plan_lines(plan.subtasks))
    for why in holds:
        out.append(f"! {safe(why, 300)}\n", "bold yellow")
    for attempt in answer.attempts:
        if not attempt.ok:
            out.append(f"{attempt.tier} tier: {safe('; '.join(attempt.problems), 300)}\n", "dim")
    return out


def names_of(robots: Iterable[str], site: Site | None) -> tuple[str, ...]:
    """Return the names that an instruction may have: robots, places with their aliases, objects."""
    places = site.places.items() if site is not None else ()
    found = [*robots, *(name for key, place in places for name in (key, *place.aliases))]
    found += [each.name for each in site.objects] if site is not None else []
    return tuple(dict.fromkeys(found))


def example(robots: Iterable[RobotInfo], site: Site | None) -> str:
    """Return an instruction that this fleet can plan, to be shown before one is written.

    Args:
        robots: of the fleet.
        site: its map; None while it is not known.
    """
    able = [each for each in robots if each.online and "goto" in each.verbs]
    robot = min(able, key=lambda each: (each.flies, "camera" not in each.uses, each.id), default=None)
    if robot is None or site is None or not site.places:
        return "an order, such as ROBOT: go to PLACE"
    thing = site.objects[0] if site.objects and "camera" in robot.uses and not robot.flies else None
    place = thing.at if thing is not None else min(site.places)
    go = f"e.g. {robot.id}: {'fly' if robot.flies else 'go'} to {place}"
    return f"{go}, then photograph the {thing.name}" if thing is not None else go


class SubmitDialog(ModalScreen[TaskRecord | None]):
    """Takes an instruction, shows its plan, and submits exactly that plan when it is confirmed."""

    BINDINGS = [
        Binding("escape", "leave", "Leave", priority=True),
        Binding(DIALOG_KEYS["edit-first"], "review", "Edit first", id="edit-first", priority=True),
    ]

    def __init__(
        self,
        view: View,
        history: History,
        *,
        instruction: str = "",
        own: Mapping[str, str] | None = None,
        stops: Callable[[str], bool] = lambda _: False,
        begins: Callable[[str], bool] = lambda _: False,
    ) -> None:
        """Make the dialog.

        Args:
            view: the fleet.
            history: earlier instructions.
            instruction: its first content.
            own: the operator's own keys.
            stops: carries a text out that is a soft stop; False when it is none.
            begins: begins what a text asks for that is no plan, such as a run of federated learning or a standing rule;
                False when it asks for none.
        """
        super().__init__()
        self._stops, self._begins = stops, begins
        key = (own or {}).get("edit-first", DIALOG_KEYS["edit-first"]).split(",")[0].strip()
        self._may = _REVIEW.format(key=key_name(key))
        self._view = view
        self._history = history
        self._first = instruction
        # The id is made here, so that submitting again after a lost answer is the same task.
        self._task_id = f"t-{uuid.uuid4().hex[:10]}"
        self._answer: PlanAnswer | None = None
        self._planned = ""
        """The instruction that `_answer` is the plan of."""
        self._busy = False

    def compose(self) -> ComposeResult:
        """Make the dialog."""
        with Vertical(classes="dialog"):
            yield Label("Instruction", classes="title")
            yield InstructionInput(self._first, self._history, id="instruction")
            with Pane(id="plan-box"):
                yield Static(id="plan")
            yield Static(_ASK, id="hint")

    def on_mount(self) -> None:
        """Learn the names, begin to write."""
        field = self.query_one(InstructionInput)
        field.focus()
        field.names = names_of(sorted(self._view.store.robots), None)
        field.placeholder = example(self._view.store.robots.values(), None)
        self._learn()
        if self._history.problem:
            self._show(Text(safe(self._history.problem), "yellow"), _ASK)

    @work(group="names")
    async def _learn(self) -> None:
        """Ask for the names of places; without an answer those of robots must do."""
        try:
            site = await self._view.orders.site()
        except SwiftbotError:
            return
        self._view.store.asked.put(PLACES, site)
        if self.is_mounted:
            field = self.query_one(InstructionInput)
            field.names = names_of(sorted(self._view.store.robots), site)
            field.placeholder = example(self._view.store.robots.values(), site)

    @on(Input.Changed, "#instruction")
    def edited(self, event: Input.Changed) -> None:
        """The shown plan is of another instruction: it must not be run any more."""
        if self._answer is not None and event.value.strip() != self._planned:
            self._answer = None
            self._show(Text(), _ASK)

    @on(Input.Submitted, "#instruction")
    def entered(self, event: Input.Submitted) -> None:
        """Plan the instruction, or run the plan that is shown for it; a stop is carried out at once."""
        instruction = event.value.strip()
        if self._stops(instruction) or (not self._busy and self._begins(instruction)):
            self.action_leave()
        elif self._busy:
            pass
        elif not instruction:
            self._show(Text("Write an instruction first.", "yellow"), _ASK)
        elif self._answer is None:
            self._plan(instruction)
        else:
            self._submit(self._planned, self._answer, Approval.NEVER)

    def action_review(self) -> None:
        """Submit the plan so that it waits: it is edited and approved on a screen of its own."""
        if self._answer is not None and not self._busy:
            self._submit(self._planned, self._answer, Approval.ALWAYS)

    @work(exclusive=True)
    async def _plan(self, instruction: str) -> None:
        self._busy = True
        self._show(Text("planning …", "dim"), "nothing runs yet · Esc leaves")
        try:
            answer = await self._view.orders.plan(instruction)
        except SwiftbotError as error:
            self._fail(error)
        else:
            if self.query_one("#instruction", Input).value.strip() == instruction:
                self._answer, self._planned = answer, instruction
                self._show(answer_text(answer), self._may)
            else:
                self._show(Text("The instruction was edited meanwhile.", "yellow"), _ASK)
        finally:
            self._busy = False

    @work(exclusive=True)
    async def _submit(self, instruction: str, answer: PlanAnswer, approval: Approval) -> None:
        self._busy = True
        self.query_one("#hint", Static).update("submitting …")
        request = TaskRequest(
            instruction=instruction,
            id=self._task_id,
            submitter=self._view.operator,
            plan=answer.plan,
            approval=approval,
        )
        try:
            record = await self._view.orders.submit(request)
        except SwiftbotError as error:
            # The plan stays confirmed under the same task id: Enter again cannot make a second task.
            text = answer_text(answer)
            text.append(f"✘ {safe(error.message)}\n→ {safe(error.remedy)}", "red")
            self._show(text, "Enter tries again · Esc leaves")
        else:
            self._history.add(instruction)
            self.dismiss(record)
        finally:
            self._busy = False

    def _fail(self, error: SwiftbotError) -> None:
        text = Text(f"✘ {safe(error.message)}\n", "red")
        if isinstance(error, PlanError):
            for problem in error.problems:
                text.append(f"  · {safe(problem)}\n", "red")
        if error.remedy:
            text.append(f"→ {safe(error.remedy)}", "yellow")
        self._show(text, _ASK)

    def _show(self, text: Text, hint: str) -> None:
        self.query_one("#plan", Static).update(text)
        self.query_one("#hint", Static).update(hint)

    def action_leave(self) -> None:
        """Leave without running anything more."""
        self._history.rewind()
        self.dismiss(None)
