"""The recorder: everything that is put under the fleet's keys goes into a file, and logging never slows the plane.

One thread hands over what Zenoh has queued to a bounded intake, another encodes, compresses and syncs. What does
not fit is dropped, counted and written down in the log itself as a gap: a log that lacks something says so.

`Pipeline` runs on the writer thread, a message at a time in the order of arrival: secrets out, holes noticed, incidents
marked, and held back if asked. What is asked of a key (does it have numbers, can it tell of an incident, is it JSON) is
worked out once a key. `Sequences` detects messages that never came by the numbers of those kinds that have one: log
lines of a gateway, events of a run, transitions of a task, frames of a MAVLink component (one byte, so a loss of 256 in
a row does not show).
"""

import asyncio
import contextlib
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterable

import msgspec
import structlog
from msgspec import Struct, structs

from appliance.errors import RecordError
from appliance.model import keyspace
from appliance.model.keys import Keys
from appliance.model.recorder_api import Incident, RecorderStatus
from appliance.plane.backlog import kind_of
from appliance.plane.session import Closer, Session
from appliance.plane.settings import PlaneConfig
from appliance.record.backfill import CatchingUp, Lost, Tail, tail_of
from appliance.record.incidents import Gate, Triggers
from appliance.record.models import LoggedMessage, compile_expression
from appliance.record.redact import Redactor
from appliance.record.segments import NOT_HEARD, PLANE, VEHICLE, About, Attached, LogWriter, file_prefix
from appliance.record.settings import RecordConfig

MOST_SOURCES = 20_000
"""Speakers whose numbers are remembered; the one that was silent for longest is forgotten first."""
_V1, _V2 = 0xFE, 0xFD
_WINDOW = 256
_RESTARTED = 3
"""So many frames in a row that follow each other, and not the last one, are of a component that began again."""
_UNHEARD = (-1, -1, 0)


class _Numbered(Struct):
    """A message's own numbers: what it tells about may have such fields as well."""

    number: int = -1
    sequence: int = -1
    attempt: int = 0
    coordinator: str = ""


class Hole(Struct, frozen=True):
    """So many messages are missing before the one that was just heard."""

    source: str
    missing: int
    key: str


class Sequences:
    """Notices holes in the numbers of one fleet's speakers."""

    def __init__(self, keys: Keys) -> None:
        self._last: OrderedDict[tuple[str, str], tuple[int, int, int]] = OrderedDict()
        """The last number of each, the last one that came behind it, and how many of those came in a row."""
        self._kinds = (
            (compile_expression(keys(keyspace.TRANSITION)), "transition"),
            (compile_expression(keys(keyspace.RUN_EVENT)), "run"),
            (compile_expression(keys(keyspace.LOG)), "log"),
            # Not of what is sent: each peer gets a part of it.
            (compile_expression(keys(keyspace.MAVLINK, "*", "rx")), "mavlink"),
            (compile_expression(keys(keyspace.LINK_FRAMES, "*", "*", "rx")), "mavlink"),
        )
        self.missing: dict[str, int] = {}
        """Messages not heard so far, by kind."""

    def kind_of(self, key: str) -> str:
        """Return which numbers messages of a key have; "" for none. To be asked once a key."""
        return next((kind for pattern, kind in self._kinds if pattern.fullmatch(key)), "")

    def heard(self, kind: str, key: str, payload: bytes) -> Hole | None:
        """Note a message; returns the hole before it, if there is one."""
        if kind == "mavlink":
            return self._frame(key, payload)
        try:
            told = msgspec.json.decode(payload, type=_Numbered)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
            return None
        number, source = (told.sequence, told.coordinator[:80]) if kind == "transition" else (told.number, "")
        if kind == "run":
            source = str(told.attempt)
        if number < 0:
            return None
        last = self._note((key, source), number)
        # A new coordinator goes on from a record, a new process counts from the start: neither is a hole.
        if last is None or number <= last + 1:
            return None
        return self._hole(kind, number - last - 1, key)

    def _frame(self, key: str, payload: bytes) -> Hole | None:
        if len(payload) >= 10 and payload[0] == _V2:
            number, speaker = payload[4], f"{payload[5]}/{payload[6]}"
        elif len(payload) >= 6 and payload[0] == _V1:
            number, speaker = payload[2], f"{payload[3]}/{payload[4]}"
        else:
            return None
        source = (key, speaker)
        last, late, run = self._last.get(source, _UNHEARD)
        ahead = (number - last) % _WINDOW
        if last < 0 or 0 < ahead <= _WINDOW // 2:
            self._note(source, number)
            return self._hole("mavlink", ahead - 1, key) if last >= 0 and ahead > 1 else None
        # Behind: one that was overtaken, or is repeated; or its speaker has begun again, as some in a row show.
        run = run + 1 if number == (late + 1) % _WINDOW else 1
        if run < _RESTARTED:
            self._note(source, last, late=number, run=run)
        else:
            self._note(source, number)
        return None

    def _note(self, source: tuple[str, str], number: int, *, late: int = -1, run: int = 0) -> int | None:
        """Remember what was heard last of a source; returns what was before."""
        last, _, _ = self._last.pop(source, _UNHEARD)
        self._last[source] = (number, late, run)
        if len(self._last) > MOST_SOURCES:
            self._last.popitem(last=False)
        return None if last < 0 else last

    def _hole(self, kind: str, missing: int, key: str) -> Hole:
        self.missing[kind] = self.missing.get(kind, 0) + missing
        return Hole(kind, missing, key)


MOST_KEYS = 50_000
"""Keys whose plan is remembered; beyond, all are worked out each time. Each task has some of its own."""
_PLAN = b'"plan"'


class _Way(Struct, frozen=True):
    """What is to be done with the messages of a key."""

    raw: bool
    numbers: str
    incident: str
    plans: bool


class _Planned(Struct):
    task: str = ""
    sequence: int = 0
    plan: msgspec.Raw = msgspec.Raw()


class Pipeline:
    """What a recorder does with each message.

    Args:
        config: mode and times.
        fleet: whose messages.
        writer: gets what is to be in the log.
        secrets: values that must not be (see `redact`).
        clock: monotonic seconds.
    """

    def __init__(
        self,
        config: RecordConfig,
        *,
        fleet: str,
        writer: LogWriter,
        secrets: Iterable[str] = (),
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        keys = Keys(fleet)
        self.writer = writer
        self.redactor = Redactor(secrets)
        self.gate = Gate(
            always=config.mode == "all",
            before_s=config.before_s,
            after_s=config.after_s,
            ring_bytes=config.ring_bytes,
        )
        self._sequences = Sequences(keys)
        self._triggers = Triggers(keys, config.name)
        self._clock = clock
        self._ways: dict[str, _Way] = {}
        self._raw = tuple(
            map(compile_expression, (keys(keyspace.MAVLINK), keys(keyspace.LINK_FRAMES), keys(keyspace.CAMERA)))
        )
        self._transitions = compile_expression(keys(keyspace.TRANSITION))

    def write(self, message: LoggedMessage) -> None:
        """Take a message on its way."""
        way = self._ways.get(message.key) or self._way_of(message.key)
        payload = message.payload
        clean = self.redactor.text(payload) if way.raw else self.redactor.json(payload)
        if clean is not payload:
            message = LoggedMessage(message.key, message.at_ns, clean, message.encoding, message.deleted)
        # A session that numbers what it puts is followed by those numbers, of whatever key; a vehicle has its own.
        if way.numbers and not message.deleted and (not message.number or way.numbers == VEHICLE):
            hole = self._sequences.heard(way.numbers, message.key, clean)
            if hole is not None:
                self.writer.miss(hole.source, hole.missing, hole.key, message.at_ns)
        incident = self._triggers.incident(way.incident, message) if way.incident else None
        if incident is not None:
            self._happened(incident)
        if self.gate.always or self.gate.take(message, self._clock()):
            self._log(message, way)

    def tick(self) -> None:
        """See to files that are due; end the one of an incident that is over."""
        if not self.gate.open(self._clock()) and self.writer.recording:
            self.writer.close()
        self.writer.tick()

    def _happened(self, incident: Incident) -> None:
        incident, before = self.gate.happened(incident, self._clock())
        for each in before:
            self._log(each, self._ways.get(each.key) or self._way_of(each.key))
        self.writer.mark(incident)

    def _log(self, message: LoggedMessage, way: _Way) -> None:
        if way.plans and _PLAN in message.payload:
            self._attach_plan(message)
        self.writer.write(message)

    def _attach_plan(self, message: LoggedMessage) -> None:
        try:
            told = msgspec.json.decode(message.payload, type=_Planned)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
            return
        if bytes(told.plan) not in (b"", b"null"):
            name = f"plan-{told.task[:80]}-{told.sequence}.json"
            self.writer.attach(Attached(name, "application/json", bytes(told.plan)))

    def _way_of(self, key: str) -> _Way:
        way = _Way(
            raw=any(each.fullmatch(key) for each in self._raw),
            numbers=self._sequences.kind_of(key),
            incident=self._triggers.watches(key),
            plans=self._transitions.fullmatch(key) is not None,
        )
        if len(self._ways) >= MOST_KEYS:
            self._ways.clear()
        self._ways[key] = way
        return way


log = structlog.get_logger(__name__)

_STOP_S = 30.0
"""How long a stop waits for the thread: a slow disk may hold many queued pictures."""
_TICK_S = 0.1
PATIENCE_S = 0.5
"""How long a burst that is faster than the disk waits for room: it is slowed down rather than lost. A disk that stands
still for longer costs messages, since holding back the fleet would cost more."""
_TICK_EVERY = 2_000
"""Messages of one batch between two looks at what is due."""
_STUCK_S = 10.0
"""A writer thread that has not come round for so long is no longer called alive."""


class Drop(Struct, frozen=True):
    """Messages that did not fit: how many, their bytes, and key and time of the last."""

    count: int = 0
    payload_bytes: int = 0
    key: str = ""
    at_ns: int = 0
    keys: dict[str, int] = {}
    """The same count by kind of key (`plane.backlog.kind_of`)."""

    @classmethod
    def of(cls, message: LoggedMessage) -> "Drop":
        """One message that did not fit."""
        return cls(1, len(message.payload), message.key, message.at_ns, {kind_of(message.key): 1})

    def __add__(self, other: "Drop") -> "Drop":
        """Both together; `other` is the later one."""
        keys = self.keys | {kind: count + self.keys.get(kind, 0) for kind, count in other.keys.items()}
        return Drop(
            self.count + other.count,
            self.payload_bytes + other.payload_bytes,
            other.key or self.key,
            other.at_ns,
            keys,
        )


THINNED = "thinned"
"""Reason of a gap in telemetry that made room for everything else."""
_THIN_FROM, _THIN_TO, _ONE_IN = 0.75, 0.875, 4
"""From so full on one in four messages of each telemetry key is kept; from there on none."""


class Intake:
    """Messages between the event loop and the writer thread, bounded by number and by bytes.

    `put` never waits; a message that does not fit is counted and handed over by the next `take`. Telemetry is thinned
    before anything else is lost: when three quarters are full, of each of its keys one message in four is kept, and the
    last eighth is not for it at all. `thins` says of a key whether it is telemetry.
    """

    def __init__(
        self, *, messages: int, payload_bytes: int, thins: Callable[[str], bool] = keyspace.is_telemetry
    ) -> None:
        self._thins = thins
        self._came: dict[str, int] = {}
        """Telemetry key -> its messages since it began to be thinned."""
        self._most, self._most_bytes = messages, payload_bytes
        self._lock = threading.Lock()
        self._some = threading.Event()
        self._room = threading.Event()
        self._stuck = False
        self._waiting: list[LoggedMessage] = []
        self._bytes = 0
        self._drops: dict[str, Drop] = {}

    def put(self, message: LoggedMessage) -> bool:
        """Add a message; False when it was dropped."""
        size, reason = len(message.payload), ""
        with self._lock:
            if not self._fits(1, size, _THIN_FROM) and self._thins(message.key):
                came = self._came[message.key] = self._came.get(message.key, -1) + 1
                reason = "" if came % _ONE_IN == 0 and self._fits(1, size, _THIN_TO) else THINNED
            elif not self._fits(1, size):
                reason = "queue full"
            if not reason:
                self._waiting.append(message)
                self._bytes += size
        if reason:
            self.lose(reason, Drop.of(message))
        self._some.set()
        return not reason

    def put_all(self, messages: list[LoggedMessage]) -> None:
        """Add messages in order. A burst waits a moment for room; what does not fit then is dropped and counted."""
        size = sum(len(each.payload) for each in messages)
        self._make_way(len(messages), size)
        with self._lock:
            fits = self._fits(len(messages), size, _THIN_FROM)
            if fits:
                self._came.clear()
                self._waiting += messages
                self._bytes += size
        if fits:
            self._some.set()
        else:
            for each in messages:
                self.put(each)

    def _fits(self, messages: int, size: int, part: float = 1.0) -> bool:
        """Whether there is room for so many, of so many bytes together, in a part of the queue; under the lock."""
        return len(self._waiting) + messages <= part * self._most and self._bytes + size <= part * self._most_bytes

    def _make_way(self, messages: int, size: int) -> None:
        """Wait until the writer has taken what is there, unless it does not come round: then nothing waits for it."""
        with self._lock:
            if self._stuck or not self._waiting or self._fits(messages, size, _THIN_FROM):
                return
            self._room.clear()
        if not self._room.wait(PATIENCE_S):
            self._stuck = True

    def lose(self, reason: str, drop: Drop) -> None:
        """Count messages that were lost here or before they came here."""
        with self._lock:
            self._drops[reason] = self._drops[reason] + drop if reason in self._drops else drop

    def take(self, wait_s: float) -> tuple[list[LoggedMessage], dict[str, Drop]]:
        """Return all that waits, and what was dropped since the last take, by reason."""
        self._some.wait(wait_s)
        with self._lock:
            self._some.clear()
            out, self._waiting, self._bytes = self._waiting, [], 0
            drops, self._drops = self._drops, {}
            self._stuck = False
            self._room.set()
        return out, drops

    def wake(self) -> None:
        """End a waiting `take`."""
        self._some.set()

    def __len__(self) -> int:
        """Messages waiting."""
        return len(self._waiting)


class Recorder:
    """Records a fleet while it is started.

    Args:
        session: The plane's session; its fleet is what is recorded.
        config: Where and how.
        writer: Takes the place of the file writer in tests.
        about: What the log is to be understood by, and must not hold.
    """

    def __init__(
        self,
        session: Session,
        config: RecordConfig,
        *,
        writer: LogWriter | None = None,
        about: About | None = None,
    ) -> None:
        self._session = session
        self._config = config
        about = about or About()
        fleet = session.keys.fleet
        self._writer = writer or LogWriter(config, fleet=fleet, site=about.site, attached=about.attached)
        self._pipeline = Pipeline(config, fleet=fleet, writer=self._writer, secrets=about.secrets)
        self._intake = Intake(messages=config.queue_messages, payload_bytes=config.queue_bytes)
        self._catching_up = CatchingUp(
            session, put_all=self._intake.put_all, lose=self._lose_unheard, tail=self._recorded_before
        )
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None
        self._subscription: Closer | None = None
        self._token: Closer | None = None
        self._reporting: asyncio.Task[None] | None = None
        self._status = RecorderStatus(id=config.name, fleet=session.keys.fleet, started_ns=time.time_ns())
        self._lost_before: dict[str, int] = {}
        self._moved_at = time.monotonic()
        self.failed = ""
        """Why the writer thread ended by itself; empty while all is well."""

    @property
    def stats(self) -> RecorderStatus:
        """The recorder's account of itself just now."""
        return structs.replace(self._status, queued=len(self._intake), at_ns=time.time_ns())

    async def start(self) -> None:
        """Make the folder, start the thread, subscribe. RecordError when nothing can be written there."""
        await asyncio.to_thread(self._writer.prepare)
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()
        self._catching_up.start()
        self._subscription = await asyncio.to_thread(
            self._session.flood, self._session.keys.everything, LoggedMessage, self._catching_up.take
        )
        self._token = self._session.declare_alive(self._session.keys(keyspace.RECORDER_ALIVE, self._config.name))
        self._reporting = asyncio.create_task(self._report(), name="recorder status")
        log.info("recorder started", directory=str(self._config.folder), fleet=self._session.keys.fleet)

    async def stop(self) -> None:
        """Take no more, write what waits, finish the file."""
        if self._subscription is not None:
            await asyncio.to_thread(self._subscription.close)
            self._subscription = None
            await self._catching_up.close()
        if self._reporting is not None:
            self._reporting.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._reporting
            self._reporting = None
        thread = self._thread
        if thread is None:
            return
        self._look_for_losses()
        self._stopping.set()
        self._intake.wake()
        await asyncio.to_thread(thread.join, _STOP_S)
        if thread.is_alive():
            raise RecordError(
                f"the disk did not take the log within {_STOP_S:g} s",
                remedy="what was flushed is readable: see `swiftbot log info`",
            )
        self._thread = None
        self._publish()
        if self._token is not None:  # after the last word, by which it is known to stop in good order
            self._token.close()
            self._token = None

    def _run(self) -> None:
        try:
            while not (self._stopping.is_set() and not len(self._intake)):
                self._write(*self._intake.take(_TICK_S))
            self._write(*self._intake.take(0))  # drops counted since the last take
            self._writer.close()
            self._snapshot("stopped")
        except Exception as error:  # the thread's one supervision boundary: the status tells, run_recorder ends
            self.failed = f"the log writer failed: {error!r}"
            log.exception("log writer failed")
            self._snapshot("failed", self.failed)

    def _write(self, batch: list[LoggedMessage], drops: dict[str, Drop]) -> None:
        pipeline = self._pipeline
        for number, message in enumerate(batch, start=1):
            pipeline.write(message)
            if number % _TICK_EVERY == 0:
                pipeline.tick()  # a file is flushed and ended when it is due, however much there is to do
        for reason, drop in drops.items():
            if reason == NOT_HEARD:
                self._writer.miss(PLANE, drop.count, drop.key, drop.at_ns, keys=drop.keys)
            else:
                size, at_ns = drop.payload_bytes, drop.at_ns
                self._writer.drop(reason, drop.key, size, at_ns, count=drop.count, keys=drop.keys)
        pipeline.tick()
        self._moved_at = time.monotonic()
        if self._writer.recording or not self._writer.problem:
            self._snapshot("recording" if self._writer.recording or self._pipeline.gate.always else "waiting")
        else:
            self._snapshot("paused")

    def _snapshot(self, state: str, problem: str = "") -> None:
        writer = self._writer
        self._status = structs.replace(
            self._status,
            state=state,
            problem=problem or writer.problem,
            file=writer.file,
            files=len(writer.files),
            messages=writer.messages,
            file_bytes=writer.file_bytes,
            dropped=dict(writer.dropped),
            not_heard=dict(writer.not_heard),
            fetched=self._catching_up.fetched,
            missed=dict(writer.missed),
            missed_at_ns=writer.missed_at_ns,
            redacted=self._pipeline.redactor.count,
            incidents=self._pipeline.gate.incidents,
            last_incident=self._pipeline.gate.last,
            unwritten_incidents=writer.waiting_marks,
            held=self._pipeline.gate.held,
            removed=writer.removed,
            going=writer.going,
        )

    @property
    def stuck_s(self) -> float:
        """How long the writer thread has not come round: a disk that does not answer holds it."""
        return time.monotonic() - self._moved_at

    def _look_for_losses(self) -> None:
        """Count what the session itself dropped before it came here: too large, or faster than this process."""
        large = sum(count for what, count in self._session.refused.items() if what.startswith("oversize"))
        for reason, now in (("queue full", self._session.missed), ("too large", large)):
            fresh = now - self._lost_before.get(reason, 0)
            if fresh > 0:
                self._intake.lose(reason, Drop(fresh, at_ns=time.time_ns()))
            self._lost_before[reason] = now

    def _lose_unheard(self, lost: Lost) -> None:
        at_ns = lost.at_ns or time.time_ns()
        self._intake.lose(NOT_HEARD, Drop(sum(lost.keys.values()), at_ns=at_ns, keys=lost.keys))

    def _recorded_before(self) -> Tail:
        """Return what the files of this recorder have of the last seconds: it may just have been restarted."""
        now_ns = self._status.started_ns
        if self._config.mode != "all":
            return Tail(now_ns)  # what waited in memory for an incident is gone
        prefix = file_prefix(self._session.keys.fleet, self._config.name)
        before = {path.name for path in self._writer.files}
        keep_s = self._session.config.backlog_s
        return tail_of(self._config.folder, prefix, keep_s=keep_s, now_ns=now_ns, but=before)

    async def _report(self) -> None:
        step_s = min(_TICK_S, self._config.status_s)
        while True:
            self._look_for_losses()
            self._publish()
            said = self._status.state, self._status.problem
            for _ in range(round(self._config.status_s / step_s)):
                await asyncio.sleep(step_s)
                if (self._status.state, self._status.problem) != said:
                    break  # told at once

    def _publish(self) -> None:
        self._session.publish(keyspace.RECORDER_STATUS, self.stats, self._config.name)


async def run_recorder(
    config: RecordConfig,
    plane_config: PlaneConfig,
    fleet: str,
    stop: asyncio.Event,
    *,
    alive: Callable[[RecorderStatus], None] | None = None,
    about: About | None = None,
) -> None:
    """Record a fleet until `stop` is set, in a process of its own (`swiftbot record`).

    Args:
        config: Where and how.
        plane_config: How to reach the fleet.
        fleet: Its name.
        stop: Ends it; what waits is written and the file finished.
        alive: Called when it has begun and then every `status_s` while the writer thread moves: a hook for the
            service manager's readiness and watchdog.
        about: What the log is to be understood by, and must not hold.

    Raises:
        ConfigError: a setting cannot work.
        UnreachableError: the network could not be joined.
        RecordError: the folder cannot be written, or the writer failed.
    """
    config.check()
    session = await Session.open(plane_config, fleet)
    try:
        recorder = Recorder(session, config, about=about)
        await recorder.start()
        try:
            while not stop.is_set() and not recorder.failed:
                if alive is not None and recorder.stuck_s < _STUCK_S:
                    alive(recorder.stats)
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(config.status_s):
                        await stop.wait()
        finally:
            await recorder.stop()
        if recorder.failed:
            raise RecordError(recorder.failed, remedy="what was flushed is readable; start the recorder again")
    finally:
        await session.close()
