"""Why a task waits and why each attempt was served where it was, for people: `task why` and `pool why`, 80 columns."""

from collections.abc import Iterator
from datetime import datetime

from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from appliance.model import PLAIN_PRIORITY, Choice
from appliance.model.task_api import AttemptWhy, TaskWhy, Waits


def milliseconds(value: float | None) -> str:
    """A duration for people."""
    if value is None:
        return "–"
    return f"{value:.1f} ms" if value < 1000 else f"{value / 1000:.1f} s"


def time_of_day(at_ns: int) -> str:
    """Return the time of day for people; dashes for none, or one that no calendar has."""
    try:
        return datetime.fromtimestamp(at_ns / 1e9).astimezone().strftime("%H:%M:%S") if at_ns > 0 else "--:--:--"
    except (OverflowError, OSError, ValueError):
        return "--:--:--"


def why_text(found: TaskWhy) -> Group:
    """Why each attempt was served where it was: who decided, and a table of what was weighed. Fits 80 columns."""
    parts: list[RenderableType] = [
        Text.assemble(("task ", "bold"), found.id, f" {found.state}  coordinated by {found.coordinator}"),
        *_task_text(found),
        *([Text(f"blocked: {found.waits}", style="bold yellow")] if found.waits else []),
        *([Text(found.done)] if found.done else []),
    ]
    for each in found.subtasks:
        waits = f"  {each.note}" if each.note and not each.attempts and each.waits is None else ""
        parts.append(Text.assemble("\n", (each.id, "bold"), f" {each.skill}  {each.state}{waits}"))
        for attempt in each.attempts:
            parts.extend(_attempt_text(attempt))
        if each.waits is not None:
            parts.extend(_waits_text(each.waits))
    return Group(*parts)


def _attempt_text(attempt: AttemptWhy) -> Iterator[RenderableType]:
    served = f", container {attempt.container[:12]}, {attempt.phase}" if attempt.container else ""
    yield Text(f"  attempt {attempt.number} on {attempt.gateway}{served}")
    if attempt.placed:
        yield Padding(Text(f"gateways by coarse score: {attempt.placed}", style="dim"), (0, 0, 0, 4))
    if attempt.choice is not None:
        choice = attempt.choice
        yield Padding(Text(f"{choice.by} decided: {choice.way}, {choice.why}"), (0, 0, 0, 4))
        if choice.considered:
            yield Padding(_considered_table(choice), (0, 0, 0, 4))
    elif not attempt.failure:
        yield Padding(Text("how its container was chosen is not known (yet)", style="dim"), (0, 0, 0, 4))
    if attempt.failure is not None:
        yield Padding(Text(f"failed: {attempt.failure.message}", style="red"), (0, 0, 0, 4))


def _considered_table(choice: Choice) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold dim", padding=(0, 1, 0, 0))
    table.add_column("")
    table.add_column("gateway", overflow="fold", max_width=14)
    table.add_column("container", no_wrap=True)
    table.add_column("way", no_wrap=True)
    table.add_column("score", justify="right", no_wrap=True)
    table.add_column("cost", justify="right", no_wrap=True)
    table.add_column("verdict", overflow="fold")
    for each in choice.considered:
        table.add_row(
            "▸" if each.taken else "",
            each.gateway,
            each.container[:8] or "–",
            str(each.way),
            f"{each.score:.2f}" if each.container else "–",
            milliseconds(each.cost_ms) if each.image else "–",
            each.verdict,
            style="" if each.taken else "dim",
        )
    return table


def _task_text(found: TaskWhy) -> Iterator[RenderableType]:
    """What holds for all subtasks: the order of things, the group, what was to be expected."""
    told: list[str] = []
    if found.priority != PLAIN_PRIORITY:
        told.append(f"priority {found.priority}")
    if found.deadline_s:
        left = "" if found.left_s is None else f", {max(0.0, found.left_s):.0f} s left"
        told.append(f"deadline {found.deadline_s:g} s{left}")
    if found.submitter:
        told.append(f"from {found.submitter}")
    if told:
        yield Text(", ".join(told))
    if found.group is not None:
        group = found.group
        yield Text(f"group {group.number}: {', '.join(group.members)}; root {group.root}")
        yield Padding(Text(group.why, style="dim"), (0, 0, 0, 4))
    if found.note:
        yield Text(found.note, style="yellow")


def _waits_text(waits: Waits) -> Iterator[RenderableType]:
    """What a subtask waits for, its place, and who could serve it."""
    place = f", place {waits.position} of {waits.waiting}" if waits.position else ""
    when = f", expected to start in about {waits.expected_s:g} s" if waits.expected_s is not None else ""
    yield Text(f"  waits for: {waits.reason}{place}{when}")
    for each in waits.candidates:
        text = each.excluded or (f"score {each.score:.2f}" if each.score is not None else "could serve it")
        yield Padding(Text(f"{each.gateway}: {text}", style="dim" if each.excluded else ""), (0, 0, 0, 4))
