"""Why a subtask waits, or ran where it did, as text beside the graph: what `task why` and `pool why` print."""

from rich.text import Text

from appliance.model import SubtaskRecord, SubtaskState
from appliance.tasks.why import AttemptWhy, SubtaskWhy, TaskWhy, Waits
from appliance.tui.drawing import milliseconds, told
from appliance.tui.safe import safe
from appliance.tui.tasks.facts import whole

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
