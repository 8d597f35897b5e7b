"""What the terminal UI knows just now: the latest value of everything it has heard of, outside the widgets.

Screens look at shelves and at what has changed on them since they last drew. A `Shelf` keeps the latest value of each
thing of one kind. Bounded; without Zenoh and Textual, so that a recorded log can fill it as well as a fleet.
"""

import time
from collections import deque
from collections.abc import Callable, ItemsView, Iterable, Iterator, KeysView, Mapping, ValuesView
from typing import Any, Generic, TypeVar

from msgspec import Struct, structs

from appliance.model import (
    Act,
    ContainerInfo,
    Enquiry,
    GatewayStatus,
    Lifted,
    LogLine,
    Notice,
    Phase,
    RobotInfo,
    RunEvent,
    RunEventKind,
    SoftStop,
    TaskRecord,
)
from appliance.model.alerts import Alert
from appliance.model.closures import Closure
from appliance.model.learn_api import LearnShown
from appliance.model.learning import ClientStatus, RoundRecord, RunRecord
from appliance.model.recorder_api import RecorderStatus
from appliance.plane.dedup import Deduplicator
from appliance.record.models import GONE_S, SILENT, SILENT_S, together
from appliance.robots.authority.soft_stop import Stops
from appliance.tui.safe import safe

T = TypeVar("T")


class Changes(Struct, frozen=True):
    """What has changed: keys with a new value, latest first, and keys that are gone."""

    revision: int
    changed: tuple[str, ...] = ()
    gone: tuple[str, ...] = ()
    whole: bool = False
    """Whether more has changed than is remembered: all is to be looked at."""


class Shelf(Mapping[str, T], Generic[T]):
    """Values by key.

    Args:
        most: values kept. A further one is refused, unless `age` is given.
        age: how old a value is to be thought, higher for newer; the oldest go first then.
    """

    def __init__(self, most: int, *, age: Callable[[T], Any] | None = None) -> None:
        self.most = most
        self.revision = 0
        """Rises with every change."""
        self.arrangement = 0
        """Rises when keys come or go."""
        self.refused = 0
        """Values for which there was no room."""
        self._age = age
        self._values: dict[str, T] = {}
        self._changed: dict[str, int] = {}
        """Key -> revision of its last change, oldest change first; gone ones too, as far as they are remembered."""
        self._from = 0
        """Changes up to this revision are not remembered any more."""

    def __getitem__(self, key: str) -> T:
        return self._values[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    # Mapping's own views ask for each key in Python; these are the dictionary's.

    def keys(self) -> KeysView[str]:
        """Return the keys as they are now and will be."""
        return self._values.keys()

    def values(self) -> ValuesView[T]:
        """Return the values as they are now and will be."""
        return self._values.values()

    def items(self) -> ItemsView[str, T]:
        """Return keys and values as they are now and will be."""
        return self._values.items()

    def put(self, key: str, value: T) -> bool:
        """Set a value; whether anything has changed by it."""
        values = self._values
        if key in values:
            if values[key] is value or values[key] == value:
                return False
        elif len(values) >= self.most and self._age is None:
            self.refused += 1
            return False
        else:
            self.arrangement += 1
        values[key] = value
        self._note(key)
        if len(values) > self.most and self._age is not None:
            self._drop_oldest(self._age)
        return True

    def drop(self, key: str) -> bool:
        """Forget a value; whether there was one."""
        if key not in self._values:
            return False
        del self._values[key]
        self.arrangement += 1
        self._note(key)
        return True

    def clear(self) -> None:
        """Forget all."""
        for key in tuple(self._values):
            self.drop(key)

    def since(self, revision: int) -> Changes:
        """Return what has changed since a revision, each key once."""
        if revision < self._from:
            return Changes(self.revision, tuple(self._values), whole=True)
        changed: list[str] = []
        gone: list[str] = []
        for key in reversed(self._changed):
            if self._changed[key] <= revision:
                break
            (changed if key in self._values else gone).append(key)
        return Changes(self.revision, tuple(changed), tuple(gone))

    def _note(self, key: str) -> None:
        self.revision += 1
        self._changed.pop(key, None)  # so that it stands last
        self._changed[key] = self.revision
        if len(self._changed) > 2 * self.most + 16:
            oldest = next(iter(self._changed))
            self._from = self._changed.pop(oldest)

    def _drop_oldest(self, age: Callable[[T], Any]) -> None:
        """Drop a tenth at once: looking through all for each new one would cost more than the value is worth."""
        keys = sorted(self._values, key=lambda key: age(self._values[key]))
        for key in keys[: max(1, self.most // 10)]:
            self.drop(key)


GATEWAYS = 1000
ROBOTS = 5000
CONTAINERS = 20_000
RECORDERS = 20
"""Most recorders remembered."""
ENQUIRIES = 200
ALERTS = 2000
RUNS = 200
CLIENTS = 10_000
LOST_KEPT_S = 3600.0
"""For how long a gateway that went away is still shown, with since when."""
LOADS = 60
"""Latest reports of a gateway whose load is remembered."""
STARTS = 400
"""Latest starts of runs whose phase and time are remembered."""
KINDS = (
    "gateways",
    "containers",
    "robots",
    "tasks",
    "recorders",
    "enquiries",
    "stops",
    "alerts",
    "closures",
    "runs",
    "rounds",
    "clients",
    "entries",
    "starts",
    "connection",
    "asked",
)
"""What screens may say they show."""

_EVENT_LEVELS = {RunEventKind.FAILED: "error", RunEventKind.PROGRESS: "debug", RunEventKind.PARTIAL: "debug"}


class Connection(Struct, frozen=True, kw_only=True):
    """How the line to the fleet is: `problem` is empty when all is well, else the cause; `remedy` what to do."""

    connected: bool = False
    problem: str = ""
    remedy: str = ""
    since_ns: int = 0
    """Since when it is so, by this machine's clock, for people; 0: not told."""


class Entry(Struct, frozen=True, kw_only=True):
    """A line of the log screen. `serial` numbers them from 1 in the order heard."""

    serial: int
    at_ns: int
    kind: str
    """`notice`, `run`, `log` or `order`."""
    level: str
    source: str
    text: str


class Gateway(Struct, frozen=True, kw_only=True):
    """A gateway: its last report, and since when it cannot be reached."""

    status: GatewayStatus
    lost_ns: int = 0
    """When it went away, by this machine's clock, for people; 0: it is there."""
    latency_ms: float | None = None
    """A question there and its answer back, measured from here; None: not measured."""
    arc: float | None = None
    """Share of the keys that are its own on the ring, 0 to 1; None: not known."""


class Start(Struct, frozen=True):
    """A run whose handler has begun: which phase of selection served it, and how long that took."""

    phase: Phase | None
    startup_ms: float


class Store:
    """The fleet as it is known just now.

    Args:
        tasks: Tasks kept; the oldest go first.
        entries: Log lines kept.
    """

    def __init__(self, *, tasks: int = 2000, entries: int = 2000) -> None:
        self.gateways: Shelf[Gateway] = Shelf(GATEWAYS)
        self.loads: dict[str, deque[float]] = {}
        """The load of each gateway in its last reports, 0 to 1, the newest last."""
        self.containers: Shelf[ContainerInfo] = Shelf(CONTAINERS)
        """By `gateway/container`."""
        self.robots: Shelf[RobotInfo] = Shelf(ROBOTS)
        self.tasks: Shelf[TaskRecord] = Shelf(tasks, age=_age)
        self.recorders: Shelf[RecorderStatus] = Shelf(RECORDERS)
        """By name; one not heard for a while has the state `silent`."""
        self.enquiries: Shelf[Enquiry] = Shelf(ENQUIRIES, age=lambda enquiry: enquiry.at_ns)
        """Questions to people, those that were answered too."""
        self.stops = Stops()
        """Soft stops and their liftings."""
        self.alerts: Shelf[Alert] = Shelf(ALERTS, age=lambda alert: alert.since_ns)
        """Alerts of the fleet, by id; one that is over is gone."""
        self.closures: Shelf[Closure] = Shelf(ALERTS, age=lambda closure: closure.by.at_ns)
        """Places and robots out of use, by id."""
        self.runs: Shelf[RunRecord] = Shelf(RUNS, age=lambda run: (not run.state.final, run.started_ns))
        """Runs of federated learning, by id."""
        self.rounds: Shelf[RoundRecord] = Shelf(RUNS, age=lambda record: not record.closed)
        """The open round of each run, or its last, by the run's id."""
        self.clients: Shelf[ClientStatus] = Shelf(CLIENTS)
        """What the clients of runs are at, by `run/client`."""
        self.asked: Shelf[object] = Shelf(1000)
        """Answers to what a screen has asked for itself, by a key of its own such as `decisions/gw-1`."""
        self.entries: deque[Entry] = deque(maxlen=entries)
        """Log lines, oldest first."""
        self.connection = Connection(problem="connecting", remedy="one moment")
        self.starts: deque[Start] = deque(maxlen=STARTS)
        """Latest starts of runs, oldest first."""
        self._started = 0
        self._serial = 0
        self._connections = 0
        self._stops_heard = 0
        self._heard: dict[str, float] = {}
        self._noticed = Deduplicator()
        self._newest: tuple[int, tuple[str, ...]] = (-1, ())

    # --- what has changed --------------------------------------------------------------------------------------

    def revision(self, kind: str) -> int:
        """Return what rises with every change of one of `KINDS`."""
        if kind == "entries":
            return self._serial
        if kind == "connection":
            return self._connections
        if kind == "starts":
            return self._started
        if kind == "stops":
            return self._stops_heard
        shelf: Shelf[object] = getattr(self, kind)
        return shelf.revision

    def revisions(self, kinds: Iterable[str]) -> tuple[int, ...]:
        """Return the revisions of several kinds: equal when nothing of them has changed."""
        return tuple(map(self.revision, kinds))

    def forget_all(self) -> None:
        """Reset, as when a recorded log is played from another moment."""
        for shelf in (
            self.gateways,
            self.containers,
            self.robots,
            self.tasks,
            self.recorders,
            self.enquiries,
            self.alerts,
            self.closures,
            self.runs,
            self.rounds,
            self.clients,
            self.asked,
        ):
            shelf.clear()
        self.stops = Stops()
        self._stops_heard += 1
        self._heard.clear()
        self.loads.clear()
        self.entries.clear()
        self.starts.clear()
        self._serial += 1
        self._started += 1

    # --- connection and gateways ---------------------------------------------------------------------------------

    def tell(self, connection: Connection) -> None:
        """Note how the line is; `since_ns` stays while the problem does."""
        known = self.connection
        if (known.connected, known.problem) == (connection.connected, connection.problem):
            connection = structs.replace(connection, since_ns=known.since_ns)
        elif not connection.since_ns:
            connection = structs.replace(connection, since_ns=time.time_ns())
        if connection != known:
            self.connection = connection
            self._connections += 1

    def take_gateways(self, present: Mapping[str, GatewayStatus], now_ns: int) -> None:
        """Take the gateways that are there; those that are not any more are kept as lost for a while.

        Args:
            present: their accounts of themselves.
            now_ns: now, Unix nanoseconds.
        """
        for name, status in present.items():
            known = self.gateways.get(name)
            if known is None or known.status is not status:
                self.loads.setdefault(name, deque(maxlen=LOADS)).append(status.load)
            if known is None:
                self.gateways.put(name, Gateway(status=status))
            elif known.status is not status or known.lost_ns:
                self.gateways.put(name, structs.replace(known, status=status, lost_ns=0))
        for name, known in tuple(self.gateways.items()):
            if name in present:
                continue
            if not known.lost_ns:
                self.gateways.put(name, structs.replace(known, lost_ns=now_ns, latency_ms=None, arc=None))
            elif now_ns - known.lost_ns > LOST_KEPT_S * 1e9:
                self.gateways.drop(name)
                self.loads.pop(name, None)

    def measured(self, gateway: str, *, latency_ms: float | None = None, arc: float | None = None) -> None:
        """Note what was measured of a gateway from here; None leaves what is known."""
        known = self.gateways.get(gateway)
        if known is None or known.lost_ns:
            return
        latency_ms = known.latency_ms if latency_ms is None else round(latency_ms, 1)
        self.gateways.put(gateway, structs.replace(known, latency_ms=latency_ms, arc=known.arc if arc is None else arc))

    def take_containers(self, held: Mapping[str, Mapping[str, ContainerInfo]]) -> None:
        """Take the containers of all gateways; others are gone."""
        fresh = {f"{gateway}/{name}": info for gateway, each in held.items() for name, info in each.items()}
        _take(self.containers, fresh)

    def take_robots(self, robots: Mapping[str, RobotInfo]) -> None:
        """Take the robots of the roster; others are gone."""
        _take(self.robots, robots)

    # --- tasks -----------------------------------------------------------------------------------------------------

    def take_task(self, record: TaskRecord) -> bool:
        """Take a task's record unless a later one is known; whether it was taken.

        After a partition the version that stands may have fewer transitions than the one that lost: an end is news.
        """
        known = self.tasks.get(record.id)
        ends = known is not None and record.state.final and not known.state.final
        if known is not None and known.sequence > record.sequence and not ends:
            return False
        return self.tasks.put(record.id, record)

    def take_tasks(self, records: Iterable[TaskRecord]) -> None:
        """Take the answer to a question for all tasks."""
        for record in records:
            self.take_task(record)

    def forget_task(self, task_id: str) -> None:
        """Forget a task whose record was deleted."""
        self.tasks.drop(task_id)

    @property
    def newest(self) -> tuple[str, ...]:
        """Ids of the tasks, newest first."""
        if self._newest[0] != self.tasks.arrangement:
            order = sorted(self.tasks, key=lambda name: _age(self.tasks[name]), reverse=True)
            self._newest = (self.tasks.arrangement, tuple(order))
        return self._newest[1]

    # --- recorders -------------------------------------------------------------------------------------------------

    def take_recorder(self, status: RecorderStatus, now: float) -> None:
        """Take a report of a recorder, received at `now` (monotonic seconds); one that stopped is forgotten."""
        if status.state == "stopped":
            self._heard.pop(status.id, None)
            self.recorders.drop(status.id)
        elif status.id in self.recorders or len(self.recorders) < RECORDERS:
            self._heard[status.id] = now
            self.recorders.put(status.id, status)

    def listen_for_silence(self, now: float) -> None:
        """Mark recorders that were not heard for a while; nothing comes of them that would do so.

        Gateways know of one whose process ended before it is missed here.
        """
        told = together(note for each in self.gateways.values() if not each.lost_ns for note in each.status.recorders)
        gone = {note.id for note in told if note.state == SILENT}
        for name, heard_at in self._heard.items():
            status = self.recorders.get(name)
            patience_s = GONE_S if name in gone else SILENT_S
            if status is not None and status.state != SILENT and now - heard_at >= patience_s:
                self.recorders.put(name, structs.replace(status, state=SILENT))

    def take_stops(self, stops: Iterable[SoftStop] = (), lifted: Iterable[Lifted] = ()) -> None:
        """Take soft stops and liftings, in any order and as often as they come."""
        if self.stops.merge(stops, lifted):
            self.stops.forget()
            self._stops_heard += 1

    def take_alert(self, alert: Alert) -> None:
        """Take an alert as it is now; its acknowledgement is never taken back by an older word."""
        known = self.alerts.get(alert.id)
        if alert.cleared_ns:
            self.alerts.drop(alert.id)
        elif known is None or alert.changed_ns >= known.changed_ns:
            self.alerts.put(alert.id, alert)

    def take_closure(self, closure: Closure) -> None:
        """Take what is out of use, or is in use again; an older word changes nothing."""
        known = self.closures.get(closure.id)
        if known is not None and known.by.at_ns > max(closure.by.at_ns, closure.ended_ns):
            return
        if closure.ended_ns:
            self.closures.drop(closure.id)
        else:
            self.closures.put(closure.id, closure)

    def take_closures(self, closures: Iterable[Closure], *, known: Iterable[str]) -> None:
        """Take the answer to a question for all; of those that were known when it was asked, the others are over."""
        fresh = {each.id: each for each in closures}
        for name in set(known) - set(fresh):
            self.closures.drop(name)
        for each in fresh.values():
            self.take_closure(each)

    def out_of_use(self, kind: str, now_ns: int) -> dict[str, str]:
        """Return the places, or robots, that are out of use, and why."""
        return {each.name: each.text for each in self.closures.values() if each.kind == kind and each.holds(now_ns)}

    def acked(self, alert: str) -> bool:
        """Whether somebody has acknowledged the alert of an id."""
        known = self.alerts.get(alert)
        return known is not None and known.acked is not None

    def take_alerts(self, alerts: Iterable[Alert], *, known: Iterable[str] | None = None) -> None:
        """Take the answer to a question for all alerts.

        Args:
            alerts: those there are.
            known: ids of those that were known when it was asked: of them the others are over. None: all.
        """
        fresh = {each.id: each for each in alerts}
        for name in tuple(self.alerts if known is None else known):
            if name not in fresh:
                self.alerts.drop(name)
        for each in fresh.values():
            self.take_alert(each)

    # --- federated learning ----------------------------------------------------------------------------------------

    def take_learn_run(self, run: RunRecord) -> None:
        """Take a run's record unless a later one is known; of those that go their clients are forgotten."""
        known = self.runs.get(run.id)
        if known is not None and (known.updated_ns, known.round) > (run.updated_ns, run.round):
            return
        self.runs.put(run.id, run)
        if len(self.clients) > CLIENTS // 2:
            for key in [key for key, each in self.clients.items() if each.run not in self.runs]:
                self.clients.drop(key)

    def forget_learn_run(self, run: str) -> None:
        """Forget a run that was removed."""
        self.runs.drop(run)
        self.rounds.drop(run)
        for key in [key for key in self.clients if key.startswith(f"{run}/")]:
            self.clients.drop(key)

    def take_shown(self, shown: LearnShown) -> None:
        """Take the answer to a question for one run."""
        self.take_learn_run(shown.run)
        if shown.round is not None:
            names = {"coordinator": shown.coordinator, "successor": shown.successor, "elapsed_s": shown.elapsed_s}
            self.take_round(structs.replace(shown.round, **names))
        for each in shown.clients:
            self.take_client(each)

    def take_round(self, record: RoundRecord) -> None:
        """Take a round's record unless one of a later round is known, or that it is closed."""
        known = self.rounds.get(record.run)
        if known is None or (known.number, known.closed) <= (record.number, record.closed):
            self.rounds.put(record.run, record)

    def take_client(self, status: ClientStatus) -> None:
        """Take what a client is at unless it is of a round before."""
        key = f"{status.run}/{status.client}"
        known = self.clients.get(key)
        if known is None or known.round <= status.round:
            self.clients.put(key, status)

    # --- the log ---------------------------------------------------------------------------------------------------

    def take_notice(self, notice: Notice) -> None:
        """Take a message to a person; what both sides of a partition have told is one message."""
        if self._noticed.new(notice.id):
            self.add(notice.at_ns, kind="notice", level="info", source=notice.to, text=notice.text)

    def take_log(self, line: LogLine) -> None:
        """Take a log line of a gateway."""
        fields = " ".join(f"{key}={value}" for key, value in line.fields.items())
        text = f"{line.event} {fields}".rstrip()
        self.add(line.at_ns, kind="log", level=line.level.lower(), source=line.source, text=text)

    def take_act(self, act: Act) -> None:
        """Take what an operator ordered, here or elsewhere, and what came of it."""
        why = f" ({act.why})" if act.why else ""
        problem = f": {act.problem}" if act.problem else ""
        text = f"{act.verb} {act.target}{why} → {act.outcome}{problem}"
        level = "info" if act.outcome == "done" else "warning"
        self.add(act.at_ns, kind="order", level=level, source=act.by, text=text)

    def take_run(self, event: RunEvent, at_ns: int) -> None:
        """Take news of a run."""
        if event.kind is RunEventKind.STARTED and event.startup_ms is not None:
            self._started += 1
            self.starts.append(Start(event.phase, event.startup_ms))
        if event.kind is RunEventKind.ALIVE:
            return  # every two seconds of each run: they would push out what tells something
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
        """Add a line to the log screen; foreign text is cleaned, long lines are cut."""
        self._serial += 1
        self.entries.append(
            Entry(
                serial=self._serial,
                at_ns=at_ns,
                kind=kind,
                level=safe(level, 12),
                source=safe(source, 64),
                text=safe(text),
            )
        )


def _age(record: TaskRecord) -> tuple[int, str]:
    return record.created_ns, record.id


def _take(shelf: Shelf[T], fresh: Mapping[str, T]) -> None:
    for key, value in fresh.items():
        if shelf.get(key) is not value:
            shelf.put(key, value)
    if len(shelf) > len(fresh) or shelf.keys() != fresh.keys():
        for key in [key for key in shelf if key not in fresh]:
            shelf.drop(key)
