"""What the terminal UI knows just now, built up from what it hears; bounded, without Zenoh and without Textual.

The screen draws `Snapshot`s: facts at one moment. `Board.revision` rises with every change, so that nothing is
drawn when nothing has changed.
"""

from collections import deque
from collections.abc import Iterable

from msgspec import Struct, structs

from appliance.model import (
    ContainerInfo,
    GatewayStatus,
    LogLine,
    Notice,
    RobotInfo,
    RunEvent,
    RunEventKind,
    TaskRecord,
)
from appliance.record.facts import RecorderStatus


class Connection(Struct, frozen=True, kw_only=True):
    """How the line to the fleet is: `problem` is empty when all is well, else the cause; `remedy` what to do."""

    connected: bool = False
    problem: str = ""
    remedy: str = ""


class Entry(Struct, frozen=True, kw_only=True):
    """A line of the log screen. `serial` numbers them from 1 in the order heard."""

    serial: int
    at_ns: int
    kind: str
    """`notice`, `run` or `log`."""
    level: str
    source: str
    text: str


class Snapshot(Struct, frozen=True, kw_only=True):
    """The fleet as the terminal UI sees it at one moment. Gateways, containers, robots by name; tasks newest first."""

    fleet: str
    connection: Connection = Connection()
    gateways: tuple[GatewayStatus, ...] = ()
    containers: tuple[ContainerInfo, ...] = ()
    robots: tuple[RobotInfo, ...] = ()
    tasks: tuple[TaskRecord, ...] = ()
    entries: tuple[Entry, ...] = ()
    recorders: tuple[RecorderStatus, ...] = ()
    """Recorders by name; one not heard for a while has the state `silent`."""

    def task(self, task_id: str) -> TaskRecord | None:
        """Return a task's record, or None when it is not known (any more)."""
        return next((record for record in self.tasks if record.id == task_id), None)


RECORDERS = 20
"""Most recorders remembered."""
RECORDER_SILENT_S = 5.0
"""A recorder tells of itself every second; without word for so long something is wrong with it."""
SILENT = "silent"

_EVENT_LEVELS = {RunEventKind.FAILED: "error", RunEventKind.PROGRESS: "debug", RunEventKind.PARTIAL: "debug"}


class Board:
    """Keeps tasks and log lines.

    Args:
        tasks: Tasks kept; the oldest go first.
        entries: Log lines kept.
    """

    def __init__(self, *, tasks: int, entries: int) -> None:
        self.revision = 0
        self._most_tasks = tasks
        self._tasks: dict[str, TaskRecord] = {}
        self._entries: deque[Entry] = deque(maxlen=entries)
        self._serial = 0
        self._recorders: dict[str, tuple[float, RecorderStatus]] = {}

    def take_task(self, record: TaskRecord) -> bool:
        """Take a task's record unless a later one is known; whether it was taken."""
        known = self._tasks.get(record.id)
        if known is not None and (known.sequence > record.sequence or known == record):
            return False
        self._tasks[record.id] = record
        if len(self._tasks) > self._most_tasks:
            del self._tasks[min(self._tasks.values(), key=_age).id]
        self.revision += 1
        return True

    def forget_task(self, task_id: str) -> None:
        """Forget a task whose record was deleted."""
        if self._tasks.pop(task_id, None) is not None:
            self.revision += 1

    def take_tasks(self, records: Iterable[TaskRecord]) -> None:
        """Take the answer to a question for all tasks."""
        for record in records:
            self.take_task(record)

    def take_recorder(self, status: RecorderStatus, now: float) -> None:
        """Take a recorder's account of itself, heard at `now` (monotonic seconds); one that stopped is forgotten."""
        if status.state == "stopped":
            self._recorders.pop(status.id, None)
        elif status.id in self._recorders or len(self._recorders) < RECORDERS:
            self._recorders[status.id] = (now, status)
        self.revision += 1

    def recorders(self, now: float) -> tuple[RecorderStatus, ...]:
        """Return recorders by name, those not heard for a while as `silent`."""
        return tuple(
            status if now - heard_at < RECORDER_SILENT_S else structs.replace(status, state=SILENT)
            for _, (heard_at, status) in sorted(self._recorders.items())
        )

    def take_notice(self, notice: Notice) -> None:
        """Take a message to a person."""
        self.add(notice.at_ns, kind="notice", level="info", source=notice.to, text=notice.text)

    def take_log(self, line: LogLine) -> None:
        """Take a log line of a gateway."""
        fields = " ".join(f"{key}={value}" for key, value in line.fields.items())
        text = f"{line.event} {fields}".rstrip()
        self.add(line.at_ns, kind="log", level=line.level.lower(), source=line.source, text=text)

    def take_run(self, event: RunEvent, at_ns: int) -> None:
        """Take news of a run."""
        parts = [f"{event.task}/{event.subtask}", str(event.kind)]
        if event.attempt > 1:
            parts.append(f"attempt {event.attempt}")
        if event.phase is not None:
            parts.append(str(event.phase))
        if event.startup_ms is not None:
            parts.append(f"start {event.startup_ms:.1f} ms")
        if event.duration_ms is not None:
            parts.append(f"took {event.duration_ms / 1000:.1f} s")
        if event.kind is RunEventKind.PROGRESS:
            parts.append(f"{event.progress:.0%}")
        if event.note:
            parts.append(event.note)
        if event.failure is not None:
            parts.append(f"{event.failure.message} {event.failure.remedy}".rstrip())
        level = _EVENT_LEVELS.get(event.kind, "info")
        self.add(at_ns, kind="run", level=level, source=event.gateway, text=" · ".join(parts))

    def add(self, at_ns: int, *, kind: str, level: str, source: str, text: str) -> None:
        """Add a line to the log screen; long ones are cut."""
        self._serial += 1
        one_line = " ".join(text.split())[:500]
        self._entries.append(
            Entry(serial=self._serial, at_ns=at_ns, kind=kind, level=level, source=source, text=one_line)
        )
        self.revision += 1

    @property
    def tasks(self) -> tuple[TaskRecord, ...]:
        """Tasks, newest first."""
        return tuple(sorted(self._tasks.values(), key=_age, reverse=True))

    @property
    def entries(self) -> tuple[Entry, ...]:
        """Log lines, oldest first."""
        return tuple(self._entries)


def _age(record: TaskRecord) -> tuple[int, str]:
    return record.created_ns, record.id
