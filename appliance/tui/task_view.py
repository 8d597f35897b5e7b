"""Tasks and their subtasks as rows and text: state, place, phase, times, progress, results, errors and remedies.

With the reasons why a subtask waits, or ran where it did: what `task why` and `pool why` print. Pure.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
from msgspec import Struct
from rich.text import Text

from appliance.model import PLAIN_PRIORITY, Proposal, SubtaskRecord, SubtaskState, TaskRecord, TaskState
from appliance.model.task_api import AttemptWhy, SubtaskWhy, TaskWhy, Waits
from appliance.tasks.views import status
from appliance.tui import plan_editor, status_styles
from appliance.tui.formatting import Cell, bar, clock, duration, hanging, milliseconds, told
from appliance.tui.plan_editor import params_text
from appliance.tui.safe import safe, safe_lines

# --- tasks -------------------------------------------------------------------------------------------------------


def state_cell(record: TaskRecord) -> tuple[str, str]:
    """Return a task's state with its sign, and its style; that it waits for an operator or is paused comes first."""
    if record.paused:
        return "‖ paused", "magenta"
    if waits(record) is not None:
        return "? approve", "bold yellow"
    if status(record) == "blocked":
        return "▲ blocked", "yellow"
    sign = status_styles.task(record.state)
    return sign.text, sign.style


def waits(record: TaskRecord) -> Proposal | None:
    """Return the plan of a task that waits for an operator, if one does."""
    if record.state.final or record.proposal is None or not record.proposal.waits:
        return None
    return record.proposal


def done(record: TaskRecord) -> str:
    """Return how many of its subtasks have succeeded."""
    return f"{sum(each.state is SubtaskState.SUCCEEDED for each in record.subtasks)}/{len(record.subtasks)}"


def progress(record: TaskRecord) -> float:
    """Return a task's progress, 0 to 1: subtasks that ended, and the shares of those that run."""
    if not record.subtasks:
        return 1.0 if record.state is TaskState.SUCCEEDED else 0.0
    shares = [
        1.0 if each.state is SubtaskState.SUCCEEDED else min(1.0, max(0.0, each.progress)) for each in record.subtasks
    ]
    return sum(shares) / len(shares)


def task_cells(record: TaskRecord) -> tuple[Cell, ...]:
    """Return a task's row: id, state, done, how far, when accepted, by whom, what was asked, what it waits for."""
    what = safe(record.instruction, 300)
    if record.priority != PLAIN_PRIORITY:
        what = f"p{record.priority} {what}"
    return (
        (safe(record.id, 64), "bold"),
        state_cell(record),
        done(record),
        f"{progress(record):.0%}" if record.subtasks else "",
        clock(record.created_ns)[:8],
        safe(record.submitter, 20),
        what,
        (reason(record).removeprefix("waits for "), "yellow"),
    )


def reason(record: TaskRecord) -> str:
    """Return in a sentence why a task does not go on just now; empty when it does or has ended."""
    if record.state.final:
        return ""
    if record.paused:
        return safe(record.paused)
    proposal = waits(record)
    if proposal is not None:
        expires = f"; expires {_expiry(proposal, record)}" if proposal.expires_s else ""
        return f"waits for approval: {safe(proposal.note, 200) or 'an operator is to look at its plan'}{expires}"
    if record.state is TaskState.ACCEPTED:
        return "being planned"
    if record.state is TaskState.CANCELLING:
        word = record.cancelled_by
        return f"its runs are being ended{f', as {safe(word.by, 40)} asked' if word is not None and word.by else ''}"
    if any(each.state is SubtaskState.RUNNING for each in record.subtasks):
        return ""
    notes = [f"{each.subtask.id}: {each.note}" for each in record.subtasks if each.note and not each.state.final]
    return safe("; ".join(notes[:3]) or record.note or _between(record))


def _between(record: TaskRecord) -> str:
    """Return what a task without a word of its own is about to do, by the states of its subtasks."""
    sent = [each for each in record.subtasks if each.state is SubtaskState.DISPATCHED]
    if sent:
        return f"{sent[0].subtask.id}: starts on {sent[0].gateway or 'a gateway'}"
    ready = [each.subtask.id for each in record.subtasks if each.state is SubtaskState.READY]
    return f"{ready[0]}: a gateway for it is chosen" if ready else ""


def _expiry(proposal: Proposal, record: TaskRecord) -> str:
    """Return when a plan that waits expires: the time of day, which stays true however long nothing is heard."""
    if proposal.at_ns > 0:
        return f"at {clock(proposal.at_ns + int(proposal.expires_s * 1e9))[:8]}"
    return f"in {duration(proposal.since_s + proposal.expires_s - record.elapsed_s)}"


def task_text(record: TaskRecord, width: int = 0) -> Text:
    """Draw a task: what was asked, why it waits, its plan as a graph, and what became of each subtask.

    Args:
        record: the task.
        width: cells of a line, for what takes several; 0: not known.
    """
    out = Text.assemble((safe(record.id, 80), "bold"), " ", state_cell(record))
    if record.coordinator:
        out.append(f" · coordinated by {safe(record.coordinator, 63)}")
    if record.submitter:
        out.append(f" · from {safe(record.submitter, 40)}")
    if record.deadline_s and not record.state.final:
        out.append(f" · {duration(record.deadline_s - record.elapsed_s)} to its deadline", "yellow")
    out.append(f"\n{safe(record.instruction, 2000)}\n")
    if why := reason(record):
        out.append(f"… {why}\n", "yellow")
    if record.failure is not None:
        out.append(f"✘ {told(record.failure)}\n", "red")
    for each in record.revisions[-3:]:
        out.append(f"▲ plan changed: {safe(each.note, 200)}\n", "yellow")
    proposal = waits(record)
    if not record.subtasks and proposal is not None:
        out.append_text(plan_lines(proposal.plan.subtasks))
        return out
    for node in nodes(record).values():
        out.append_text(subtask_lines(node.record, node.depth, width))
    return out


def plan_lines(subtasks: Sequence[Any]) -> Text:
    """Draw a plan that does not run: a line a subtask, below what it comes after."""
    level = plan_editor.depths(subtasks)
    by_id = {each.id: each for each in subtasks}
    out = Text()
    for name in plan_editor.ordered(subtasks):
        each = by_id[name]
        out.append(plan_editor.branch(level[name]), "dim")
        out.append(f"{safe(each.id, 40)} ", "bold")
        out.append(safe(each.skill, 60), "cyan")
        out.append(f" {safe(each.robot or 'on a gateway', 63)}")
        if each.params:
            out.append(f"  {safe(params_text(each.params), 200)}", "dim")
        if len(each.after) > 1:
            out.append(f"  after {safe(', '.join(each.after), 80)}", "dim")
        out.append("\n")
    return out


class Node(Struct, frozen=True):
    """A subtask at its place in the graph."""

    record: SubtaskRecord
    depth: int


# --- subtasks ----------------------------------------------------------------------------------------------------


def subtask_lines(record: SubtaskRecord, depth: int, width: int = 0) -> Text:
    """Draw one subtask: what it is and how it stands, where and how long, and why it failed."""
    sign = status_styles.subtask(record.state)
    subtask = record.subtask
    # Not as the style of the whole text: all that follows would be dim as well.
    out = Text.assemble((plan_editor.branch(depth), "dim"))
    out.append(f"{sign.glyph} {safe(subtask.id, 40)} ", f"bold {sign.style}")
    out.append(safe(subtask.skill, 60), "cyan")
    out.append(f" {safe(_robot(record) or 'on a gateway', 63)}")
    if len(subtask.after) > 1:
        out.append(f" after {safe(', '.join(subtask.after), 80)}", "dim")
    out.append(f"  {sign.word}", sign.style)
    if record.state is SubtaskState.RUNNING:
        out.append(f" {bar(record.progress)}", sign.style)
    out.append("\n")
    margin = " " * (len(plan_editor.branch(depth)) + 2)
    facts = _facts(record)
    if facts:
        out.append(f"{hanging(' · '.join(facts), margin, width)}\n", "dim")
    if record.failure is not None and record.state is not SubtaskState.SUCCEEDED:
        out.append(f"{hanging(f'✘ {told(record.failure)}', margin, width)}\n", "red")
    return out


def _robot(record: SubtaskRecord) -> str:
    return ", ".join(record.robots)


def _facts(record: SubtaskRecord) -> Sequence[str]:
    facts = [
        safe(record.gateway, 63),
        str(record.phase or ""),
        f"start {milliseconds(record.startup_ms)}" if record.startup_ms is not None else "",
        f"took {milliseconds(record.duration_ms)}" if record.duration_ms is not None else "",
        f"attempt {record.attempt}" if record.attempt > 1 else "",
        f"is {safe(record.condition, 20)}" if record.condition else "",
        safe(record.note, 200) if not record.state.final else "",
        brief(record.result) if record.state is SubtaskState.SUCCEEDED else "",
    ]
    return [fact for fact in facts if fact]


def subtask_cells(node: Node) -> tuple[Cell, ...]:
    """Return a subtask's row of the graph: id, skill, robot, state, gateway, phase, startup, duration, attempt."""
    record = node.record
    sign = status_styles.subtask(record.state)
    share = f" {min(1.0, max(0.0, record.progress)):.0%}" if record.progress and not record.state.final else ""
    return (
        (f"{plan_editor.branch(node.depth)}{safe(record.subtask.id, 30)}", "bold"),
        (safe(record.subtask.skill, 40), "cyan"),
        safe(_robot(record) or "–", 40),
        (f"{sign.text}{share}", sign.style),
        safe(record.gateway or "–", 63),
        str(record.phase or "–"),
        milliseconds(record.startup_ms, "–"),
        milliseconds(record.duration_ms, "–"),
        str(record.attempt or "–"),
    )


def nodes(record: TaskRecord) -> dict[str, Node]:
    """Return a task's subtasks in the order of its graph, with their depth, by id."""
    subtasks = [each.subtask for each in record.subtasks]
    level = plan_editor.depths(subtasks)
    by_id = {each.subtask.id: each for each in record.subtasks}
    return {name: Node(record=by_id[name], depth=level[name]) for name in plan_editor.ordered(subtasks)}


def brief(result: Mapping[str, Any] | None) -> str:
    """Return a result in few words: files by name, lists by length."""
    parts: list[str] = []
    for key, value in list((result or {}).items())[:20]:
        if isinstance(value, Mapping):
            name: Any = value.get("name")  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]
            parts.append(f"{key}={name}" if name else key)
        elif isinstance(value, list | tuple):
            parts.append(f"{key}: {len(value)}")  # pyright: ignore[reportUnknownArgumentType]
        else:
            parts.append(f"{key}={safe(value, 40)}")
    return safe(" ".join(parts), 160)


def whole(result: Mapping[str, Any], *, most_lines: int = 60) -> Text:
    """Return a result in full, a field a line, as JSON where it is no text; long ones are cut with what is left out."""
    out = Text()
    for number, (key, value) in enumerate(result.items()):
        if number >= most_lines:
            out.append(f"… {len(result) - most_lines} further fields\n", "dim")
            break
        shown = value if isinstance(value, str) else msgspec.json.encode(value).decode(errors="replace")
        lines = safe_lines(shown, most_lines=12, most=400)
        out.append(f"{safe(key, 60)}: ", "cyan")
        out.append("\n    ".join(lines) if lines else "(empty)")
        out.append("\n")
    return out


MOST_CANDIDATES = 12


def of_subtask(found: TaskWhy | None, subtask: str) -> SubtaskWhy | None:
    """Return the reasons of one subtask, if they were told."""
    return next((each for each in found.subtasks if each.id == subtask), None) if found is not None else None


def waits_text(waits: Waits) -> Text:
    """Return what a subtask waits for, its place and when it may start, and who could serve it."""
    out = Text.assemble(("waits for ", "bold"), (safe(waits.reason, 300), "yellow"))
    if waits.at:
        out.append(f" at {safe(waits.at, 63)}")
    if waits.position:
        out.append(f", place {waits.position} of {waits.waiting}")
    if waits.expected_s is not None:
        out.append(f", in about {waits.expected_s:g} s")
    out.append("\n")
    for each in waits.candidates[:MOST_CANDIDATES]:
        text = each.excluded or (f"score {each.score:.2f}" if each.score is not None else "could serve it")
        out.append(f"  {safe(each.gateway, 63)}: {safe(text, 200)}\n", "dim" if each.excluded else "")
    if len(waits.candidates) > MOST_CANDIDATES:
        out.append(f"  … {len(waits.candidates) - MOST_CANDIDATES} further gateways\n", "dim")
    return out


def attempt_text(attempt: AttemptWhy) -> Text:
    """Return one attempt: where, in which container, who decided so and what else was weighed."""
    out = Text.assemble((f"attempt {attempt.number}", "bold"), f" on {safe(attempt.gateway, 63)}")
    if attempt.container:
        out.append(f", container {safe(attempt.container, 12)}, {attempt.phase or 'unknown phase'}")
    out.append("\n")
    if attempt.placed:
        out.append(f"  gateways by coarse score: {safe(attempt.placed, 300)}\n", "dim")
    if attempt.choice is not None:
        choice = attempt.choice
        out.append(f"  {safe(choice.by, 63)} decided: {choice.way}, {safe(choice.why, 300)}\n")
        for each in choice.considered:
            mark = "▸" if each.taken else " "
            cost = milliseconds(each.cost_ms, "–") if each.image else "–"
            line = f"  {mark} {safe(each.gateway, 20)} {each.way} {each.score:.2f} {cost} {safe(each.verdict, 120)}\n"
            out.append(line, "" if each.taken else "dim")
    if attempt.failure is not None:
        out.append(f"  ✘ {told(attempt.failure)}\n", "red")
    return out


def subtask_text(record: SubtaskRecord, reasons: SubtaskWhy | None, *, problem: str = "") -> Text:
    """Return all that is known of one subtask, the most urgent first.

    Args:
        record: the subtask.
        reasons: what its coordinator says; None while it was not asked.
        problem: why the coordinator could not be asked.
    """
    out = Text()
    if record.failure is not None:
        out.append(f"✘ {told(record.failure)}\n", "red")
    if record.note and not record.state.final:
        out.append(f"… {safe(record.note, 300)}\n", "yellow")
    if record.condition:
        out.append(f"▲ is {safe(record.condition, 40)}\n", "yellow")
    running = record.state is SubtaskState.RUNNING
    if reasons is not None and reasons.waits is not None and not running:
        out.append_text(waits_text(reasons.waits))
    elif problem and not record.state.final:
        out.append(f"why it waits is not known: {safe(problem, 300)}\n", "dim")
    if record.subtask.params:
        out.append_text(whole(record.subtask.params))
    if record.result:
        out.append("result\n", "bold")
        out.append_text(whole(record.result))
    elif record.partial:
        out.append("so far\n", "bold")
        out.append_text(whole(record.partial))
    last = record.attempts[-1] if record.attempts else None
    if last is not None and (last.cpu_ms is not None or last.peak_mb is not None):
        peak = f", at most {last.peak_mb:.0f} MB" if last.peak_mb is not None else ""
        out.append(f"{milliseconds(last.cpu_ms, '–')} of CPU{peak}\n", "dim")
    for each in reasons.attempts[::-1] if reasons is not None else ():
        out.append_text(attempt_text(each))
    return out
