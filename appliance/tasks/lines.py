"""The lines of a task's stream, made of what gateways say: transitions, run events, log lines, notices.

Each has the gateway that said it, the number by which that source counts, and that gateway's time. Lines of one source
are in the order of their numbers, whatever clocks say; a number that is missing is a line that was missed.
"""

from typing import Any

from appliance.model import LogLine, Notice, RunEvent, RunEventKind
from appliance.model.task_api import Line, LineKind
from appliance.model.transitions import Transition, TransitionKind
from appliance.tasks.records import clean

MAX_TEXT = 500
MAX_FIELDS = 24
MAX_FIELD = 200


_MONITORED = frozenset(
    {
        TransitionKind.NOTICED,
        TransitionKind.REBOUND,
        TransitionKind.SUBSTITUTED,
        TransitionKind.PROPOSED,
        TransitionKind.REPLANNED,
        TransitionKind.REPLAN_FAILED,
        TransitionKind.MOVED,
    }
)
_TOLD_BY_RUNS = frozenset({TransitionKind.PROGRESS, TransitionKind.PARTIAL, TransitionKind.CHECKPOINT})
"""Transitions that repeat what a run's own event has told."""


def of_transition(event: Transition) -> Line | None:
    """Return the line of a transition; None for one that a run's own event tells better."""
    if event.kind in _TOLD_BY_RUNS and (event.kind is not TransitionKind.PROGRESS or event.gateway or not event.note):
        return None
    fields: dict[str, Any] = {"what": str(event.kind)}
    for name in ("robot", "container", "condition", "give_up", "replan", "waits"):
        if value := getattr(event, name):
            fields[name] = value
    if event.phase is not None:
        fields["phase"] = str(event.phase)
    if event.failure is not None:
        fields["code"] = event.failure.code
    text = event.note or (event.failure.message if event.failure is not None else "") or event.instruction
    if event.plan is not None and event.kind is not TransitionKind.ACCEPTED:
        fields["plan"] = [f"{each.id} {each.skill} {each.robot or '-'}" for each in event.plan.subtasks]
    bad = event.failure is not None or event.kind is TransitionKind.REPLAN_FAILED
    return Line(
        kind=LineKind.MONITOR if event.kind in _MONITORED else LineKind.STATE,
        task=event.task,
        at_ns=event.at_ns,
        # Its coordinator speaks, of whichever gateway the subtask is on.
        gateway=event.coordinator,
        subtask=event.subtask,
        attempt=event.attempt,
        level="warning" if bad or event.condition else "info",
        text=clean(f"{event.kind}: {text}" if text else str(event.kind), MAX_TEXT),
        fields=_small(fields | ({"on": event.gateway} if event.gateway else {})),
        source="record",
        number=event.sequence,
    )


def of_event(event: RunEvent) -> Line | None:
    """Return the line of a run's event; None for a mere sign of life."""
    fields: dict[str, Any] = {}
    text, level = event.note, "info"
    match event.kind:
        case RunEventKind.ALIVE:
            return None
        case RunEventKind.STARTED:
            kind = LineKind.METRICS
            text = f"started in {_ms(event.startup_ms)}" if event.startup_ms is not None else "started"
        case RunEventKind.PROGRESS:
            kind = LineKind.PROGRESS
            fields["progress"] = round(event.progress, 4)
        case RunEventKind.LOG:
            kind = LineKind.LOG
            fields |= event.result or {}
        case RunEventKind.PARTIAL:
            kind = LineKind.PARTIAL
            text = "partial result"
            fields |= event.result or {}
        case RunEventKind.CHECKPOINT:
            kind, text = LineKind.CHECKPOINT, "checkpoint kept"
        case RunEventKind.SUCCEEDED | RunEventKind.FAILED:
            kind = LineKind.METRICS
            text = f"{event.kind} after {_ms(event.duration_ms)}" if event.duration_ms is not None else str(event.kind)
            if event.failure is not None:
                text, level = f"{text}: {event.failure.message}", "warning"
                fields["code"] = event.failure.code
    if kind is LineKind.METRICS:
        for name in ("startup_ms", "duration_ms", "cpu_ms", "peak_mb"):
            if (value := getattr(event, name)) is not None:
                fields[name] = round(value, 2)
        if event.container:
            fields["container"] = event.container
        if event.phase is not None:
            fields["phase"] = str(event.phase)
    return Line(
        kind=kind,
        task=event.task,
        at_ns=event.at_ns,
        gateway=event.gateway,
        subtask=event.subtask,
        attempt=event.attempt,
        level=level,
        text=clean(text, MAX_TEXT),
        fields=_small(fields),
        source=f"run {event.subtask}/{event.attempt}",
        number=event.number,
    )


def of_log(gateway: str, line: LogLine) -> Line | None:
    """Return the line of a gateway's log line that is about a task; None for any other."""
    known = dict(line.fields)
    run = known.get("run")
    if "task" not in known and isinstance(run, str) and (parts := run.split("/"))[2:] and parts[2].isdecimal():
        # What pools and executors log names the run: task/subtask/attempt.
        known |= {"task": parts[0], "subtask": parts[1], "attempt": int(parts[2][:6])}
    task, attempt, subtask = known.get("task"), known.get("attempt"), known.get("subtask")
    if not isinstance(task, str) or not task:
        return None
    rest = {name: value for name, value in known.items() if name not in ("task", "subtask", "attempt", "gateway")}
    return Line(
        kind=LineKind.GATEWAY,
        task=task,
        at_ns=line.at_ns,
        gateway=gateway,
        subtask=subtask if isinstance(subtask, str) else "",
        attempt=attempt if isinstance(attempt, int) else 0,
        level=line.level,
        text=clean(line.event, MAX_TEXT),
        fields=_small(rest),
        source="log",
        number=line.number,
    )


def of_notice(notice: Notice) -> Line:
    """Return the line of a message to a person."""
    return Line(
        kind=LineKind.NOTICE,
        task=notice.task,
        at_ns=notice.at_ns,
        gateway=notice.gateway,
        text=clean(f"to {notice.to}: {notice.text}", MAX_TEXT),
        source=f"notice {notice.id}",
    )


def _ms(value: float | None) -> str:
    if value is None:
        return "?"
    return f"{value:.1f} ms" if value < 1000 else f"{value / 1000:.2f} s"


def _small(fields: dict[str, Any]) -> dict[str, Any]:
    """Fields cut to size: a stream is for people; all of it is in the record and the log."""
    found: dict[str, Any] = {}
    for name, value in list(fields.items())[:MAX_FIELDS]:
        if isinstance(value, bool | int | float) or value is None:
            found[name] = value
        else:
            text = value if isinstance(value, str) else str(value)
            found[name] = clean(text, MAX_FIELD)
    return found
