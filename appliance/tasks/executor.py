"""Runs attempts of subtasks on this gateway: selection, start, events, and what is known of past runs.

It knows nothing of plans. It accepts an order, answers where it will run, and publishes what becomes of it
under the task's key: numbered, stamped, and with the time of the run's last sign of life (`Telling`). The last event of
each run is kept in SQLite, over a restart too, until the task's record has moved on, so a coordinator that comes later
can ask (`KeptRuns`); of the many that nobody asks after the oldest go.
"""

import asyncio
import time
from collections import OrderedDict
from collections.abc import Callable, Collection, Coroutine
from typing import Any, Protocol

import msgspec
import structlog
from msgspec.structs import replace

from appliance.background import Background
from appliance.errors import PayloadError, RefusedError, SwiftbotError
from appliance.model import Failure, Phase, PoolHint, RunAccepted, RunEvent, RunEventKind, RunRequest, encode, keyspace
from appliance.model.keys import check_name
from appliance.model.pool_api import Hinted
from appliance.model.task_api import RunAsk, RunStatus
from appliance.plane.node import Plane
from appliance.plane.session import Closer, Message
from appliance.pool.pool import Call, Pool
from appliance.pool.selection import Decision
from appliance.tasks.checkpoints import Checkpoints
from appliance.tasks.handoff import Here, Reservations
from appliance.tasks.offload import Choosing, Elsewhere, PassedOn, Passing, RemoteContainers, whereabouts
from appliance.tasks.records import MAX_NOTE, MAX_RUN_S, clean, read_record, task_key, tidy
from appliance.tasks.settings import TasksConfig

MOST_RUNS = 4000
"""Runs whose numbers are remembered: more than a gateway keeps of ended ones."""


class Telling:
    """Publishes the events of one gateway's runs; its parts hear them at once, without the way over Zenoh."""

    def __init__(self, plane: Plane, *listeners: Callable[[RunEvent], None]) -> None:
        self._plane = plane
        self._listeners = [*listeners]
        self._numbers: OrderedDict[tuple[str, str, int], int] = OrderedDict()
        self._heard: dict[tuple[str, str, int], float] = {}
        self._progress: dict[tuple[str, str, int], float] = {}
        """Of the run, as it said last."""

    def listen(self, listener: Callable[[RunEvent], None]) -> Callable[[], None]:
        """Call a part of this gateway with each event; returns what ends that."""
        self._listeners.append(listener)
        return lambda: self._listeners.remove(listener)

    def tell(self, event: RunEvent) -> None:
        """Publish an event."""
        run = (event.task, event.subtask, event.attempt)
        # A mere sign of life is no line of anybody's stream: it takes no number, so that none seems to be missing.
        number = self._numbers.get(run, 0) + (event.kind is not RunEventKind.ALIVE)
        self._numbers[run] = number
        self._numbers.move_to_end(run)
        self._heard[run] = time.monotonic()
        if event.kind is RunEventKind.PROGRESS:
            self._progress[run] = event.progress
        while len(self._numbers) > MOST_RUNS:
            oldest, _ = self._numbers.popitem(last=False)
            self._heard.pop(oldest, None)
            self._progress.pop(oldest, None)
        event = replace(event, number=number, at_ns=time.time_ns())
        self._plane.session.publish(keyspace.RUN_EVENT, event, event.task, event.subtask, express=True)
        for listener in self._listeners:
            listener(event)

    def waits(self, call: Call, note: str) -> None:
        """Publish that a run waits for something, as its progress."""
        run = call.run
        self.tell(
            RunEvent(
                task=run.task,
                subtask=run.subtask,
                attempt=run.attempt,
                kind=RunEventKind.PROGRESS,
                gateway=self._plane.gateway,
                progress=self._progress.get((run.task, run.subtask, run.attempt), 0.0),
                note=clean(note, MAX_NOTE),
            )
        )

    def silent_s(self, task: str, subtask: str, attempt: int) -> float | None:
        """Return the seconds since a run's last sign of life; None when nothing was told of it."""
        heard = self._heard.get((task, subtask, attempt))
        return None if heard is None else time.monotonic() - heard


log = structlog.get_logger(__name__)

KEPT_RUNS = 2000
"""Last events kept of ended runs; a coordinator asks within seconds."""
_PREFIX = "run/"


class KeyValues(Protocol):
    """What is needed of the gateway's store."""

    async def put(self, key: str, value: bytes, *, durable: bool = True) -> None:
        """Keep a value."""
        ...

    async def delete(self, key: str) -> object:
        """Forget a key."""
        ...

    async def scan(self, prefix: str) -> list[tuple[str, bytes]]:
        """Return what is kept under keys of that prefix."""
        ...


class KeptRuns:
    """Events by run id, and the newest attempt of each subtask."""

    def __init__(self, store: KeyValues, gateway: str) -> None:
        self.last: dict[str, RunEvent] = {}
        """Run id -> its last event that counts for a coordinator."""
        self._store = store
        self._gateway = gateway
        self._newest: dict[tuple[str, str], int] = {}

    async def load(self) -> dict[str, str]:
        """Load what was kept; a run that was in progress when the gateway went down has failed.

        Returns:
            Run id -> gateway, of the runs that were passed on.
        """
        moved: dict[str, str] = {}
        for key, value in await self._store.scan(_PREFIX):
            run_id = key.removeprefix(_PREFIX)
            try:
                event = msgspec.json.decode(value, type=RunEvent)
            except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
                log.warning("a kept run event cannot be read and is dropped", run=run_id, reason=str(error))
                await self._store.delete(key)
                continue
            if event.gateway not in ("", self._gateway):
                moved[run_id] = event.gateway
            elif event.kind not in (RunEventKind.SUCCEEDED, RunEventKind.FAILED):
                message = f"{self._gateway} was restarted while it ran"
                failure = Failure(code="unreachable", message=message, retryable=True)
                event = replace(event, kind=RunEventKind.FAILED, failure=failure)
                await self._store.put(key, encode(event))
            self._note(run_id, event)
        return moved

    async def keep(self, run_id: str, event: RunEvent) -> None:
        """Keep an event over a restart; a store that cannot must not keep the outcome from being told."""
        try:
            await self._store.put(f"{_PREFIX}{run_id}", encode(event), durable=False)
        except SwiftbotError as error:
            log.warning("run event could not be kept", run=run_id, reason=str(error))

    def newest(self, task: str, subtask: str) -> int:
        """The newest attempt of a subtask that this gateway knows of; 0: none."""
        return self._newest.get((task, subtask), 0)

    def remember(self, run_id: str, event: RunEvent, *, busy: Collection[str]) -> list[str]:
        """Note an event; returns the runs that are too many now, oldest first, none of those in progress."""
        self._note(run_id, event)
        over = len(self.last) - KEPT_RUNS
        return [] if over <= 0 else [each for each in self.last if each not in busy][:over]

    def _note(self, run_id: str, event: RunEvent) -> None:
        self.last[run_id] = event
        subtask = event.task, event.subtask
        self._newest[subtask] = max(event.attempt, self._newest.get(subtask, 0))

    def forget(self, run_id: str) -> Coroutine[Any, Any, object]:
        """Forget a run, and which attempt of its subtask it was; what is returned takes it off the disk."""
        gone = self.last.pop(run_id, None)
        if gone is not None:
            self._newest.pop((gone.task, gone.subtask), None)
        return self._store.delete(f"{_PREFIX}{run_id}")


class Executor:
    """The runs of one gateway.

    Args:
        plane: the fleet.
        pool: this gateway's containers.
        remote: other gateways' containers.
        config: section `[tasks]`.
        telling: publishes the runs' events.
        reservations: containers here for runs that come from other gateways.
        on_change: called when the number of runs, or whether they drain, has changed.
    """

    def __init__(
        self,
        plane: Plane,
        pool: Pool,
        remote: RemoteContainers,
        config: TasksConfig,
        *,
        telling: Telling | None = None,
        reservations: Reservations | None = None,
        on_change: Callable[[], None] = lambda: None,
    ) -> None:
        self._plane = plane
        self._config = config
        self._remote = remote
        self._closers: list[Closer] = []
        self._pool = pool
        self._running: dict[str, asyncio.Task[None]] = {}
        self._here: dict[str, Here] = {}
        self._accepted: dict[str, RunAccepted] = {}
        self._accepting: dict[str, asyncio.Task[RunAccepted]] = {}
        self._withdrawn: set[str] = set()
        """Orders being decided on that must not begin any more."""
        self._choosing = Choosing(plane, pool, remote, check=self._check)
        self._passing = Passing(plane, pool, Elsewhere(plane, pool, remote, self._order_of))
        self._kept = KeptRuns(plane.store, plane.gateway)
        self._background = Background()
        self._telling = telling or Telling(plane)
        self._checkpoints = Checkpoints(
            plane.dht,
            gateway=plane.gateway,
            max_bytes=config.max_checkpoint_bytes,
            tell=self._telling.tell,
            refuse=lambda what, reason: plane.session.refuse(what, reason=reason),
        )
        self.draining = False
        self._on_change = on_change
        self._reservations = reservations or Reservations(plane.gateway, pool)

    @property
    def running(self) -> int:
        """Runs in progress."""
        return len(self._running)

    def here(self) -> dict[str, Here]:
        """Return the runs in progress by their ids."""
        return dict(self._here)

    async def start(self) -> None:
        """Load what was kept; a run that was in progress when the gateway went down has failed."""
        session, keys = self._plane.session, self._plane.keys
        self._closers.append(session.subscribe(keys(keyspace.TASK_UPDATE), self._on_record))
        sent = session.subscribe_typed(
            keyspace.RUN_EVENT, self._on_event, heed=lambda key: self._remote.waits_for(keyspace.RUN_EVENT.names(key))
        )
        self._closers.append(sent)
        self._passing.moved.update(await self._kept.load())
        self._passing.start()

    async def run(self, request: RunRequest) -> RunAccepted:
        """Accept one attempt and start it; the answer tells where, the events what becomes of it.

        Raises:
            RefusedError: the gateway drains, the attempt is outdated, or no container can be had.
            PoolError: no container can be started now.
            PayloadError: no such names or numbers can be.
            UnreachableError: it was passed on, and whether it was taken there is not known.
        """
        check_name(request.task, "task")
        check_name(request.subtask, "subtask")
        if request.attempt < 1 or not 0 < request.deadline_s <= 2 * MAX_RUN_S:
            raise PayloadError(f"attempt {request.attempt} within {request.deadline_s:g} s cannot be run")
        run_id = request.run_id
        if run_id in self._accepted:
            return self._accepted[run_id]
        accepting = self._accepting.get(run_id)
        if accepting is None:
            # A task of its own: the same order may come twice, and the asker may go away, while it is decided.
            accepting = asyncio.create_task(self._accept(request), name=f"accept {run_id}")
            self._accepting[run_id] = accepting
            accepting.add_done_callback(lambda done: self._decided(run_id, done))
        return await asyncio.shield(accepting)

    def _decided(self, run_id: str, done: "asyncio.Task[RunAccepted]") -> None:
        del self._accepting[run_id]
        self._withdrawn.discard(run_id)
        if not done.cancelled():
            done.exception()  # the asker has it; if nobody waits any more, nobody misses it

    async def _accept(self, request: RunRequest) -> RunAccepted:
        run_id = request.run_id
        self._check(request)
        await self._end_older(request)
        received_ns = time.monotonic_ns()
        decision = self._reservations.take(request)
        if decision is None:
            chooser = self._reservations.reserve if request.hops else self._choosing.choose
            decision = await chooser(request)
        if isinstance(decision, RunAccepted):
            self._sent_on(request, decision)
            return decision
        # Much may have happened while other gateways were asked.
        self._check(request)
        phase = _seen_from_afar(decision.phase, request) or decision.phase
        accepted = RunAccepted(
            gateway=self._plane.gateway,
            container=decision.container or "",
            phase=phase,
            why=decision.why,
            choice=decision.choice,
        )
        self._accepted[run_id] = accepted
        self._remember(run_id, whereabouts(request, accepted))
        task = asyncio.create_task(self._carry_out(request, decision, received_ns), name=f"run {run_id}")
        self._running[run_id] = task
        self._here[run_id] = Here(request, time.monotonic())
        task.add_done_callback(lambda done: self._ended(run_id, done))
        self._on_change()
        return accepted

    def _sent_on(self, request: RunRequest, accepted: RunAccepted) -> None:
        """Note where a run went that never began here: this gateway is asked after it until its record names the other.

        The asker may be a coordinator that took over just now; told that nobody knows of the run, it would begin the
        next attempt beside it. The same order again has the same answer.
        """
        run_id, event = request.run_id, whereabouts(request, accepted)
        self._accepted[run_id] = accepted
        self._passing.moved[run_id] = accepted.gateway
        self._remember(run_id, event)
        self._background.start(self._kept.keep(run_id, event), "tidy up after a run")

    def _check(self, request: RunRequest) -> None:
        """Refuse what must not begin (any more)."""
        newest = self._kept.newest(request.task, request.subtask)
        if request.attempt < newest:
            raise RefusedError(f"attempt {request.attempt} of {request.subtask} is outdated by attempt {newest}")
        if self.draining:
            raise RefusedError(f"{self._plane.gateway} is draining", remedy="another gateway takes it")
        if request.run_id in self._withdrawn:
            raise RefusedError(f"attempt {request.attempt} of {request.subtask} was called off before it began")

    async def _carry_out(self, request: RunRequest, decision: Decision, received_ns: int) -> None:
        run_id = request.run_id
        waited_ms = (time.monotonic_ns() - received_ns) / 1e6

        def tell(event: RunEvent) -> None:
            told = replace(event, gateway=self._plane.gateway, phase=_seen_from_afar(event.phase, request))
            if told.kind is RunEventKind.STARTED and told.startup_ms is not None:
                told = replace(told, startup_ms=told.startup_ms + waited_ms)
            if told.kind is RunEventKind.STARTED:
                self._kept.last[run_id] = told
                self._here[run_id].began = True
            if told.kind is RunEventKind.CHECKPOINT:
                self._checkpoints.add(told)
            else:
                self._telling.tell(told)

        begun = asyncio.create_task(self._kept.keep(run_id, self._kept.last[run_id]))
        try:
            final = await self._passing.run(request, decision, tell, since=received_ns / 1e9, check=self._check)
        except SwiftbotError as error:
            final = _failed(
                request, Failure(code=error.code, message=error.message, remedy=error.remedy, retryable=True)
            )
        except Exception as error:
            log.exception("run broke", run=run_id)
            final = _failed(
                request, Failure(code="internal", message=f"{type(error).__name__}: {error}", retryable=True)
            )
        if isinstance(final, PassedOn):
            self._remember(run_id, final.event)
            self._telling.tell(final.event)
            await begun
            await self._kept.keep(run_id, final.event)
            if run_id in self._withdrawn:
                await self._passing.ask(run_id, keyspace.RUN_CANCEL)
            return
        final = replace(final, gateway=self._plane.gateway, phase=_seen_from_afar(final.phase, request))
        final = tidy(final, max_result_bytes=self._config.max_result_bytes)
        self._remember(run_id, final)
        await begun
        await self._checkpoints.end(final)
        # Kept before it is published: a coordinator that misses the event finds it here.
        await self._kept.keep(run_id, final)
        self._telling.tell(final)

    def _remember(self, run_id: str, event: RunEvent) -> None:
        for oldest in self._kept.remember(run_id, event, busy=self._running.keys()):
            self._forget(oldest)

    def _forget(self, run_id: str) -> None:
        self._accepted.pop(run_id, None)
        self._passing.moved.pop(run_id, None)
        self._background.start(self._kept.forget(run_id), "tidy up after a run")

    async def _end_older(self, request: RunRequest) -> None:
        """End an outdated attempt that still runs here, or is about to."""
        for run_id in self._accepting:
            if run_id.startswith(f"{request.task}/{request.subtask}/") and _number(run_id) < request.attempt:
                self._withdrawn.add(run_id)
        for run_id in [each for each in self._running if each.startswith(f"{request.task}/{request.subtask}/")]:
            if run_id != request.run_id:
                await self._end(run_id)

    def _on_event(self, _: str, event: RunEvent | None) -> None:
        """Hear of the ends of runs that went to other gateways."""
        if event is not None and event.kind in (RunEventKind.SUCCEEDED, RunEventKind.FAILED):
            self._remote.over((event.task, event.subtask), event.gateway)

    def _on_record(self, message: Message) -> None:
        """End runs whose attempt the record has left behind; forget the runs of a task that has ended."""
        (task,) = keyspace.TASK_UPDATE.names(message.key)
        mine = [run_id for run_id in self._kept.last if run_id.startswith(f"{task}/")]
        coming = [run_id for run_id in self._accepting if run_id.startswith(f"{task}/")]
        if not (mine or coming) or message.deleted:
            return
        try:
            record = read_record(message.payload)
        except PayloadError as error:
            self._plane.session.refuse("malformed task", key=message.key, reason=str(error))
            return
        if record.id != task:
            self._plane.session.refuse("malformed task", key=message.key, reason=f"the record is of {record.id[:80]}")
            return
        attempts = {each.subtask.id: each.attempt for each in record.subtasks}
        for run_id in coming:
            if record.state.final or _number(run_id) < attempts.get(run_id.split("/")[1], 0):
                self._withdrawn.add(run_id)
        for run_id in mine:
            event = self._kept.last[run_id]
            # A revised plan may have no such subtask any more.
            gone = bool(attempts) and event.subtask not in attempts
            outdated = gone or event.attempt < attempts.get(event.subtask, 0)
            if run_id in self._running:
                if record.state.final:
                    self._background.start(self._end(run_id), "tidy up after a run")
                elif outdated:
                    self._background.start(self._end_outdated(event), "tidy up after a run")
            elif record.state.final:
                self._forget(run_id)

    async def _end_outdated(self, event: RunEvent) -> None:
        """End a run whose attempt a coordinator has left behind, if the record itself says so too.

        After a partition the coordinator whose version loses goes on telling for a moment: a run of the version that
        stands must not be ended by it.
        """
        try:
            stored = await self._plane.dht.read(task_key(event.task))
            record = read_record(stored.value) if stored is not None else None
        except SwiftbotError:
            record = None  # nothing speaks against what was heard
        if record is not None and record.id == event.task:
            current = next((each.attempt for each in record.subtasks if each.subtask.id == event.subtask), None)
            gone = current is None and event.subtask in record.retired
            if not record.state.final and not gone and (current or 0) <= event.attempt:
                log.info("a coordinator that was succeeded is not heeded", run=f"{event.task}/{event.subtask}")
                return
        await self._end(f"{event.task}/{event.subtask}/{event.attempt}")

    def _ended(self, run_id: str, done: "asyncio.Task[None]") -> None:
        self._running.pop(run_id, None)
        self._here.pop(run_id, None)
        self._withdrawn.discard(run_id)
        if not done.cancelled() and (error := done.exception()) is not None:
            # The coordinator asks after the run, sees that it has ended with nothing, and repeats it.
            log.error("run was not brought to its end", run=run_id, exc_info=error)
        self._on_change()

    async def hint(self, hint: PoolHint) -> Hinted:
        """Tell the pool here what a plan will need of it."""
        return await self._pool.verbs.hint(hint)

    async def status(self, ask: RunAsk) -> RunStatus:
        """Tell what is known of a run; one that was passed on is asked after where it is."""
        if ask.run_id in self._passing.moved:
            return await self._passing.ask(ask.run_id, keyspace.RUN_STATUS)
        running = ask.run_id in self._running or ask.run_id in self._accepting
        waiting = [turn.id for turn, _ in self._pool.waiting()] if running else []
        position = waiting.index(ask.run_id) + 1 if ask.run_id in waiting else 0
        return RunStatus(
            running=running,
            last=self._kept.last.get(ask.run_id),
            silent_s=self._telling.silent_s(ask.task, ask.subtask, ask.attempt) if running and not position else None,
            position=position,
            queue=len(waiting) if position else 0,
            expected_s=self._pool.expected_s(position) if position else None,
        )

    async def _end(self, run_id: str) -> None:
        """Have a run in progress end, also one that is on its way to another gateway."""
        if run_id in self._passing.moving:
            self._withdrawn.add(run_id)
        await self._pool.cancel(run_id)

    async def cancel(self, ask: RunAsk) -> RunStatus:
        """Ask a run to end; its final event follows."""
        if ask.run_id in self._accepting:
            self._withdrawn.add(ask.run_id)
        if ask.run_id in self._passing.moved:
            return await self._passing.ask(ask.run_id, keyspace.RUN_CANCEL)
        if ask.run_id in self._running:
            await self._end(ask.run_id)
        return await self.status(ask)

    def _order_of(self, run_id: str) -> RunRequest | None:
        here = self._here.get(run_id)
        return here.request if here is not None else None

    def check(self, request: RunRequest) -> None:
        """Raise RefusedError when an order could not begin here: draining, or outdated."""
        self._check(request)

    async def save(self, ask: RunAsk, *, wait_s: float, may_save: bool) -> bool:
        """Have a run's newest checkpoint in the DHT now; returns whether its handler saved one for this.

        `may_save`: its skill says that it saves when it is asked; of others what they saved by themselves is written.
        """
        run = (ask.task, ask.subtask, ask.attempt)
        return await self._checkpoints.fresh(run, lambda: self._pool.save(ask.run_id), wait_s=wait_s, may_save=may_save)

    def saved(self, ask: RunAsk) -> bool:
        """Whether a run has saved a checkpoint, or goes on from one."""
        here = self._here.get(ask.run_id)
        before = here is not None and here.request.resume is not None
        return before or self._checkpoints.any_of((ask.task, ask.subtask, ask.attempt))

    async def end(self, ask: RunAsk, *, wait_s: float) -> RunStatus:
        """Have a run end and wait until it has, its last words kept and its volumes noted; or for so long."""
        await self.cancel(ask)
        if (task := self._running.get(ask.run_id)) is not None:
            await asyncio.wait({task}, timeout=wait_s)
        return await self.status(ask)

    async def drain(self, deadline_s: float) -> None:
        """Accept nothing more and wait for the runs in progress; what is left then is cancelled."""
        self.draining = True
        self._on_change()
        try:
            if self._running:
                await asyncio.wait(list(self._running.values()), timeout=deadline_s)
            for run_id in list(self._running):
                await self._end(run_id)
            if self._running:
                await asyncio.wait(list(self._running.values()), timeout=5.0)
        finally:
            # Until here records are heard: a task that ends or moves on elsewhere ends its runs here.
            self._passing.stop()
            for each in self._closers:
                each.close()
            await self._background.finish(2.0)


def _number(run_id: str) -> int:
    """The attempt in a run's id."""
    return int(run_id.rpartition("/")[2])


def _seen_from_afar(phase: Phase | None, request: RunRequest) -> Phase | None:
    """The phase as the gateway that was asked first sees it: what is local to us is remote to it."""
    return Phase.REMOTE_WARM if request.hops and phase is Phase.LOCAL_WARM else phase


def _failed(request: RunRequest, failure: Failure) -> RunEvent:
    return RunEvent(
        task=request.task,
        subtask=request.subtask,
        attempt=request.attempt,
        kind=RunEventKind.FAILED,
        failure=failure,
    )
