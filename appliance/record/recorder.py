"""The recorder: everything that is put under the fleet's keys goes into a file, and logging never slows the plane.

One thread hands over what Zenoh has queued to a bounded intake, another encodes, compresses and syncs. What does
not fit is dropped, counted and written down in the log itself as a gap: a log that lacks something says so.
"""

import asyncio
import contextlib
import threading
import time
from collections.abc import Callable

import structlog
from msgspec import Struct, structs

from appliance.errors import RecordError
from appliance.model import encode
from appliance.plane.backlog import kind_of
from appliance.plane.session import Closer, Session
from appliance.plane.settings import PlaneConfig
from appliance.record.about import About
from appliance.record.catching_up import CatchingUp, Tail, tail_of
from appliance.record.facts import LoggedMessage, RecorderStatus
from appliance.record.following import Lost
from appliance.record.pipeline import Pipeline
from appliance.record.settings import RecordConfig
from appliance.record.writer import NOT_HEARD, PLANE, LogWriter, file_prefix

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


class Intake:
    """Messages between the event loop and the writer thread, bounded by number and by bytes.

    `put` never waits; a message that does not fit is counted and handed over by the next `take`.
    """

    def __init__(self, *, messages: int, payload_bytes: int) -> None:
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
        size = len(message.payload)
        with self._lock:
            full = not self._fits(1, size)
            if not full:
                self._waiting.append(message)
                self._bytes += size
        if full:
            self.lose("queue full", Drop.of(message))
        self._some.set()
        return not full

    def put_all(self, messages: list[LoggedMessage]) -> None:
        """Add messages in order. A burst waits a moment for room; what does not fit then is dropped and counted."""
        size = sum(len(each.payload) for each in messages)
        self._make_way(len(messages), size)
        with self._lock:
            fits = self._fits(len(messages), size)
            if fits:
                self._waiting += messages
                self._bytes += size
        if fits:
            self._some.set()
        else:
            for each in messages:
                self.put(each)

    def _fits(self, messages: int, size: int) -> bool:
        """Whether there is room for so many, of so many bytes together; under the lock."""
        return len(self._waiting) + messages <= self._most and self._bytes + size <= self._most_bytes

    def _make_way(self, messages: int, size: int) -> None:
        """Wait until the writer has taken what is there, unless it does not come round: then nothing waits for it."""
        with self._lock:
            if self._stuck or not self._waiting or self._fits(messages, size):
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
            self._session.flood, self._session.keys.everything(), LoggedMessage, self._catching_up.take
        )
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
        while True:
            self._look_for_losses()
            self._publish()
            await asyncio.sleep(self._config.status_s)

    def _publish(self) -> None:
        self._session.put(self._session.keys.recorder_status(self._config.name), encode(self.stats))


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
