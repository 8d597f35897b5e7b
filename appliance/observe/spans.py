"""One task, one trace, over all gateways that have to do with it. Pure: what happened in, spans out.

The IDs of a trace and of its spans are digests of the fleet's, the task's and the part's names. So every gateway knows
the trace of a task, and the span that its own hang below, from the names that each message has anyway: nothing is added
to messages, and a task keeps its trace over the loss of its coordinator, a restart and a retry.

| span | told by | from | to |
| --- | --- | --- | --- |
| `task` | coordinator | accepted | ended |
| `plan` | coordinator | accepted | a plan is there, or there is none |
| `approval` | coordinator | the plan waits | approved or rejected |
| `attempt SKILL` | coordinator | the subtask could start | its attempt has ended |
| `place` | coordinator | the subtask could start | it is sent to a gateway |
| `start PHASE` | executing gateway | the order is there | first line of the handler |
| `run` | executing gateway | first line of the handler | result or failure |
| `command VERB`, `ask`, ... | executing gateway | the handler calls | the robot's or person's answer |
"""

import hashlib
from collections import OrderedDict
from collections.abc import Mapping
from typing import Literal

from msgspec import Struct

from appliance.model import Failure, Plan, RunEvent, RunEventKind, TaskRecord, TaskState
from appliance.model.transitions import Transition, TransitionKind
from appliance.pool.pool import Call

MOST_TASKS = 5000
"""Tasks and runs that are followed at once; of the one that was heard of longest ago the spans are left out."""
_EFFECTIVE = (TransitionKind.PLANNED, TransitionKind.APPROVED, TransitionKind.REBOUND, TransitionKind.SUBSTITUTED,
              TransitionKind.REPLANNED)  # fmt: skip
CANCELLED = Failure(code="cancelled", message="cancelled")
_ENDS = (TransitionKind.SUCCEEDED, TransitionKind.ATTEMPT_FAILED, TransitionKind.HELD, TransitionKind.MOVED)


class Span(Struct, frozen=True, kw_only=True):
    """A span as it is told, once, when it has ended."""

    name: str
    task: str
    part: str
    """What of the task it is; empty: the task itself."""
    parent: str | None = ""
    """The part that it hangs below; None: it is the root."""
    start_ns: int
    end_ns: int
    kind: Literal["internal", "client", "server"] = "internal"
    """A `client` waits for a `server` on another gateway, or for a robot."""
    failure: Failure | None = None
    attributes: Mapping[str, str | int | float | bool] = {}
    texts: Mapping[str, str] = {}
    """Attributes that people and robots have written."""


def trace_of(fleet: str, task: str) -> int:
    """Return the ID of a task's trace, 128 bits: the first 16 bytes of SHA-256 of `FLEET/TASK`, big-endian."""
    return int.from_bytes(hashlib.sha256(f"{fleet}/{task}".encode()).digest()[:16], "big") or 1


def span_of(fleet: str, task: str, part: str) -> int:
    """Return the ID of a span of it, 64 bits."""
    return int.from_bytes(hashlib.sha256(f"{fleet}/{task}#{part}".encode()).digest()[:8], "big") or 1


class _Task:
    """What the coordinator knows of when things began."""

    def __init__(self, since_ns: int) -> None:
        self.since_ns = since_ns
        """When it was accepted, or adopted here."""
        self.waits_ns = 0
        self.ready_ns = since_ns
        """When the plan took effect that is in force."""
        self.plan: Plan | None = None
        self.ended_ns: dict[str, int] = {}
        """When the last attempt of each subtask ended."""
        self.open: dict[tuple[str, int], tuple[int, Transition]] = {}
        """Attempts under way, by subtask and number: when it could have begun, and its dispatch."""


class Spans:
    """The spans of one gateway."""

    def __init__(self, *, most: int = MOST_TASKS) -> None:
        self._most = most
        self._tasks: OrderedDict[str, _Task] = OrderedDict()
        self._runs: OrderedDict[str, int] = OrderedDict()
        """When each run that is under way here began."""

    def of_transition(self, event: Transition) -> list[Span]:
        """Take what happened to a task that is coordinated here; returns what has ended by it."""
        known = self._tasks.get(event.task)
        if known is None:
            if event.kind is TransitionKind.HEALED:  # also of a task that has ended, and that stays so
                return []
            known = self._tasks[event.task] = _Task(event.at_ns)
            if len(self._tasks) > self._most:
                self._tasks.popitem(last=False)
        self._tasks.move_to_end(event.task)
        found: list[Span] = []
        match event.kind:
            case TransitionKind.PLANNED | TransitionKind.PROPOSED | TransitionKind.PLAN_FAILED if not known.waits_ns:
                found.append(_plan_span(event, known.ended_ns.get(event.subtask, known.since_ns)))
                if event.waits:
                    known.waits_ns = event.at_ns
                if not event.subtask:
                    known.plan = event.plan
            case TransitionKind.APPROVED | TransitionKind.REJECTED | TransitionKind.PLAN_FAILED if known.waits_ns:
                found.append(_approval_span(event, known.waits_ns))
                known.waits_ns = 0
            case TransitionKind.DISPATCHED:
                ready_ns = self._ready(known, event.subtask)
                known.open[event.subtask, event.attempt] = ready_ns, event
                found.append(_place_span(event, ready_ns))
            case kind if kind in _ENDS:
                found += _attempt_span(known, event)
                known.ended_ns[event.subtask] = event.at_ns
            case _:
                pass
        if event.kind in _EFFECTIVE:
            known.plan, known.ready_ns = event.plan or known.plan, event.at_ns
        return found

    @staticmethod
    def _ready(known: _Task, subtask: str) -> int:
        """When a subtask could have begun: its plan is in force, those before it and its last attempt have ended."""
        plan = known.plan
        before = next((each.after for each in plan.subtasks if each.id == subtask), ()) if plan is not None else ()
        return max(known.ready_ns, *(known.ended_ns.get(each, 0) for each in (subtask, *before)))

    def of_record(self, record: TaskRecord) -> list[Span]:
        """Take the record of a task that is coordinated here; returns its own span, once, when it has ended."""
        known = self._tasks.get(record.id)
        if known is None:
            return []
        known.plan = record.plan or known.plan  # also of a task that was adopted
        if not record.state.final:
            return []
        del self._tasks[record.id]
        found = [
            _left_span(record, ready_ns, sent, f"{subtask}/{attempt}")
            for (subtask, attempt), (ready_ns, sent) in known.open.items()
        ]
        again = f"retry {record.retries}" if record.retries else ""
        found.append(
            Span(
                name=again or "task",
                task=record.id,
                part=again,
                parent="" if again else None,
                start_ns=known.since_ns if again else record.created_ns,
                end_ns=record.updated_ns,
                kind="server",
                failure=record.failure or (CANCELLED if record.state is TaskState.CANCELLED else None),
                attributes={
                    "swiftbot.task.state": str(record.state),
                    "swiftbot.task.priority": record.priority,
                    "swiftbot.task.subtasks": len(record.subtasks),
                    "swiftbot.task.replans": record.replans,
                },
                texts={"swiftbot.task.instruction": record.instruction, "swiftbot.task.submitter": record.submitter},
            )
        )
        return found

    def of_event(self, event: RunEvent) -> list[Span]:
        """Take what a run here has told."""
        run = f"{event.subtask}/{event.attempt}"
        name = f"{event.task}/{run}"
        if event.kind is RunEventKind.STARTED:
            self._runs[name] = event.at_ns
            if len(self._runs) > self._most:
                self._runs.popitem(last=False)
            took_ns = int((event.startup_ms or 0.0) * 1e6)
            where = {"swiftbot.start.phase": str(event.phase or ""), "swiftbot.container": event.container}
            return [
                Span(
                    name=f"start {event.phase or ''}".rstrip(), task=event.task, part=f"{run}/start", parent=run,
                    start_ns=event.at_ns - took_ns, end_ns=event.at_ns, kind="server", attributes=where,
                )
            ]  # fmt: skip
        if event.kind not in (RunEventKind.SUCCEEDED, RunEventKind.FAILED):
            return []
        began_ns = self._runs.pop(name, None)
        if began_ns is None:
            return []
        figures = {"swiftbot.run.cpu_ms": event.cpu_ms, "swiftbot.run.peak_mb": event.peak_mb}
        return [
            Span(
                name="run", task=event.task, part=f"{run}/run", parent=run, start_ns=began_ns, end_ns=event.at_ns,
                kind="server", failure=event.failure,
                attributes={key: value for key, value in figures.items() if value is not None}
                | {"swiftbot.container": event.container},
            )
        ]  # fmt: skip


def of_call(call: Call, *, start_ns: int, end_ns: int, failure: Failure | None = None) -> Span:
    """Return the span of what a handler asked for: a command to a robot, a question to people, a file."""
    run = call.run
    verb = str(call.args.get("verb", ""))[:40] if call.name == "command" else ""
    attributes = {"swiftbot.robot": run.robot or "", "swiftbot.command": f"{run.task}/{run.subtask}/{call.number}"}
    at = f"{run.subtask}/{run.attempt}"
    return Span(
        name=f"{call.name[:40]} {verb}".rstrip(), task=run.task, part=f"{at}/call {call.number}", parent=f"{at}/run",
        start_ns=start_ns, end_ns=end_ns, kind="client", failure=failure,
        attributes=attributes if verb else {},
    )  # fmt: skip


def _plan_span(event: Transition, start_ns: int) -> Span:
    plan = event.plan
    attributes: dict[str, str | int | float] = {}
    if plan is not None:
        attributes = {
            "swiftbot.plan.tier": str(plan.tier), "swiftbot.plan.confidence": plan.confidence,
            "swiftbot.plan.ms": plan.latency_ms, "swiftbot.plan.subtasks": len(plan.subtasks),
        }  # fmt: skip
    return Span(
        name="plan", task=event.task, part=f"plan {event.subtask}".rstrip(), start_ns=start_ns, end_ns=event.at_ns,
        attributes=attributes, failure=event.failure,
    )  # fmt: skip


def _approval_span(event: Transition, start_ns: int) -> Span:
    said = event.decision
    return Span(
        name="approval", task=event.task, part=f"approval {start_ns}", start_ns=start_ns, end_ns=event.at_ns,
        attributes={"swiftbot.approved": event.kind is TransitionKind.APPROVED}, failure=event.failure,
        texts={"swiftbot.approval.by": said.by, "swiftbot.approval.why": said.why} if said is not None else {},
    )  # fmt: skip


def _place_span(event: Transition, start_ns: int) -> Span:
    run = f"{event.subtask}/{event.attempt}"
    return Span(
        name="place", task=event.task, part=f"{run}/place", parent=run, start_ns=start_ns, end_ns=event.at_ns,
        attributes={"swiftbot.gateway": event.gateway, "swiftbot.robot": event.robot or ""},
        texts={"swiftbot.placed": event.placed},
    )  # fmt: skip


def _attempt_span(known: _Task, event: Transition) -> list[Span]:
    """The attempt that has ended; of one that another coordinator sent, from when this one took over."""
    number = event.attempt
    if event.kind is TransitionKind.MOVED:  # told with the number of the attempt that is left
        found = known.open.pop((event.subtask, number), None)
        if found is not None:
            known.open[event.subtask, number + 1] = event.at_ns, event
    else:
        found = known.open.pop((event.subtask, number), None)
        if found is None and number == 0:
            return []  # given up before it could be sent anywhere
    start_ns, sent = found or (known.since_ns, event)
    subtask = next((each for each in known.plan.subtasks if each.id == event.subtask), None) if known.plan else None
    return [
        Span(
            name=f"attempt {subtask.skill if subtask is not None else ''}".rstrip(),
            task=event.task,
            part=f"{event.subtask}/{number}",
            start_ns=start_ns,
            end_ns=event.at_ns,
            kind="client",
            failure=event.failure,
            attributes={
                "swiftbot.subtask": event.subtask, "swiftbot.attempt": number,
                "swiftbot.gateway": sent.gateway, "swiftbot.robot": sent.robot or "",
                "swiftbot.outcome": str(event.kind),
            },
        )
    ]  # fmt: skip


def _left_span(record: TaskRecord, start_ns: int, sent: Transition, run: str) -> Span:
    return Span(
        name="attempt", task=record.id, part=run, start_ns=start_ns, end_ns=record.updated_ns, kind="client",
        failure=CANCELLED, attributes={"swiftbot.subtask": sent.subtask, "swiftbot.gateway": sent.gateway},
    )  # fmt: skip
