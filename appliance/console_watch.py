"""How a task's stream and the revisions of its plan look in a terminal."""

import time
from collections.abc import Iterator

from rich.text import Text

from appliance.model import TaskRecord
from appliance.tasks.lines import Line, LineKind

_STYLES = {
    LineKind.STATE: "",
    LineKind.MONITOR: "bold yellow",
    LineKind.PROGRESS: "dim",
    LineKind.LOG: "",
    LineKind.GATEWAY: "dim",
    LineKind.PARTIAL: "dim",
    LineKind.CHECKPOINT: "dim",
    LineKind.METRICS: "cyan",
    LineKind.NOTICE: "bold",
    LineKind.DROPPED: "bold red",
}
_LEVELS = {"warning": "yellow", "error": "red", "critical": "red"}
_FIGURES = (("startup_ms", "startup"), ("duration_ms", "took"), ("cpu_ms", "cpu"), ("peak_mb", "peak"))


def stream_line(line: Line) -> Text:
    """One line of a stream: time, gateway, subtask/attempt, what it is, what it says."""
    at = time.strftime("%H:%M:%S", time.localtime(line.at_ns / 1e9)) + f".{line.at_ns // 1_000_000 % 1000:03d}"
    which = f"{line.subtask}/{line.attempt}" if line.attempt else line.subtask or "–"
    style = _LEVELS.get(line.level, _STYLES[line.kind])
    text = line.text
    if line.kind is LineKind.PROGRESS:
        text = f"{line.fields.get('progress', 0.0):.0%} {line.text}"
    elif line.kind is LineKind.METRICS:
        text = f"{line.text}{_figures(line)}"
    elif line.fields and line.kind in (LineKind.LOG, LineKind.GATEWAY, LineKind.PARTIAL):
        text = f"{line.text} {' '.join(f'{name}={value}' for name, value in line.fields.items())}"
    return Text.assemble((f"{at} ", "dim"), f"{line.gateway or '–':<8} {which:<8} {line.kind:<10} ", (text, style))


def _figures(line: Line) -> str:
    told: list[str] = []
    for name, word in _FIGURES:
        value = line.fields.get(name)
        if isinstance(value, int | float) and name != "startup_ms":
            told.append(f"{word} {value:g} {'MB' if name == 'peak_mb' else 'ms'}")
    where = " ".join(str(line.fields[name])[:12] for name in ("container", "phase") if name in line.fields)
    return f" ({', '.join([*told, where] if where else told)})" if told or where else ""


def revision_lines(record: TaskRecord) -> Iterator[Text]:
    """What was changed about a task's plan, and why; what waits for an operator, and what operators ordered."""
    if record.paused:
        yield Text(f"  {record.paused}", style="bold yellow")
    if record.cancelled_by is not None and record.cancelled_by.by:
        said = f": {record.cancelled_by.why}" if record.cancelled_by.why else ""
        yield Text(f"  cancelled by {record.cancelled_by.by}{said}", style="magenta")
    if record.retried_by is not None:
        said = f": {record.retried_by.why}" if record.retried_by.why else ""
        yield Text(f"  tried again by {record.retried_by.by or 'an operator'}{said}", style="dim")
    if (decision := record.decision) is not None:
        did = "approved" if decision.approved else "turned down"
        edited = ", edited" if decision.edited else ""
        said = f": {decision.why}" if decision.why else ""
        yield Text(f"  plan {did}{edited} by {decision.by or 'an operator'}{said}", style="dim")
    for each in record.revisions:
        yield Text(f"  revision {each.number} ({each.kind}): {each.note}", style="yellow")
        if each.why:
            yield Text(f"    since {each.subtask} failed: {each.why}", style="dim")
        changes = [f"{one.id} ({one.skill}) {one.state}" for one in each.dropped]
        if changes or each.added:
            yield Text(f"    out: {', '.join(changes) or 'none'}; in: {', '.join(each.added) or 'none'}", style="dim")
    if record.proposal is not None:
        short = record.proposal.hash[:12]
        waits = (
            f"\n  waits for `swiftbot task approve {record.id} --hash {short}` or `task reject {record.id}`"
            if record.proposal.waits
            else ""
        )
        yield Text(f"  proposed: {record.proposal.note}{waits}", style="bold yellow")
        for each in record.proposal.plan.subtasks:
            after = f" after {', '.join(each.after)}" if each.after else ""
            yield Text(f"    {each.id} {each.skill} {each.robot or '–'} {each.params}{after}")
    for each in record.subtasks:
        if each.condition:
            yield Text(f"  {each.subtask.id} is {each.condition}: {each.note}", style="yellow")
