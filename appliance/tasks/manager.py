"""The task manager of one gateway: accepts tasks, drives those whose key it owns, answers for them over RPC.

A task belongs to the gateway that owns `task/{id}` on the ring. Submissions are handed there, and acknowledged
when the record is durable on it and on its replicas.

Of those whose keys it owns it works on `tasks.max_tasks` at once; the others wait their turn (`queue`).

Takeover: when the ring changes, and now and then, every gateway looks through its shard. An unfinished task whose key
it now owns gets a coordinator here, one that it owns no longer loses it: a dead gateway's tasks are driven by the next
owner from the replicated record. A coordinator that breaks is followed by another, later each time.

A coordinator follows its record, never the other way round: where this gateway's copy changes by another hand (a healed
partition, a coordinator elsewhere), the coordinator steps down at once, and the record as it stands now gets a new one,
or is published when it is final.
"""

import asyncio
import contextlib
import time
from collections import Counter
from collections.abc import Callable, Mapping

import structlog

from appliance.background import Background
from appliance.errors import ConflictError, DeadlineError, PayloadError, SwiftbotError, UnreachableError
from appliance.llm.cascade import Decomposer
from appliance.llm.settings import OutOfUse
from appliance.model import (
    Failure,
    RunEvent,
    Site,
    Subtask,
    TaskRecord,
    TaskRequest,
    TaskState,
    VersionVector,
    encode,
    keyspace,
)
from appliance.model.task_api import (
    TaskAsk,
)
from appliance.plane.dht import Record
from appliance.plane.events import AuthorityChanged, FactsChanged, FleetEvent, Lost, Relinked, RingChanged, Stage
from appliance.plane.node import Plane
from appliance.skills.catalogue import Catalogue
from appliance.tasks import machine
from appliance.tasks.admission import Admission, checked, refuse_commands
from appliance.tasks.audit import Audit
from appliance.tasks.conflicts import heal
from appliance.tasks.context import FREE, Commands, Context
from appliance.tasks.coordinator import Coordinator
from appliance.tasks.endpoints import OperatorVerbs, Questions
from appliance.tasks.events import GatewayLost, GatewayRelinked, RunReported, Wake
from appliance.tasks.executor import Telling
from appliance.tasks.lookahead import LookAhead
from appliance.tasks.machine import Transition, TransitionKind
from appliance.tasks.plans import Plans
from appliance.tasks.queue import TaskQueue, Waiting
from appliance.tasks.record_writer import Draft, RecordWriter
from appliance.tasks.records import MAX_TEXT, PREFIX, answered, clean, read_record, task_key, unknown, unsound
from appliance.tasks.retention import TRIMMED
from appliance.tasks.scheduler import Scheduler
from appliance.tasks.settings import TasksConfig
from appliance.tasks.timing import Ages, left_s

log = structlog.get_logger(__name__)

SUBMITTED_AT_ONCE = 32
"""Submissions of one gateway under way at once, the others are told when to come back: so one takes no longer than 32
do, 0.2 s, and the gateway has time for everything else."""
ACCEPTED_AT_ONCE = 128
"""The same of those that other gateways hand on."""
SWEEP_S = 15.0
"""How often the shard is looked through when the ring stands still."""
MAX_BREAKS = 6
"""Coordinators of one task that may break before it is ended with the reason; with the pauses, half a minute."""
SETTLED_S = 1.0
"""A coordinator overtaken after less than this is not followed at once: two gateways that both take a key for theirs,
as while the membership settles, would overtake each other as fast as they can write."""
AGAIN_S = (0.5, 1.5, 4.0)
"""When the shard is looked through again after the ring has changed."""
TURN_S = 0.1
"""How often it is looked whose turn it is."""
MOST_IN_LINE = 16
"""Subtasks that wait for room, beyond which no more tasks of the same submitters are taken up: they would only wait
elsewhere, and each that waits is looked at again and again."""
MOST_AT_ONCE = 4
"""Tasks taken up at one look: a few dozen a second."""
APART_S = 0.25
"""Between two turns of one submitter while acceptances are slow."""
READ_AT_ONCE = 200
"""Records that are decoded before others have their turn."""


class Takeover:
    """The coordinators of one gateway: of the unfinished tasks whose keys it owns, those whose turn it is.

    Args:
        context: the parts of the gateway.
        coordinators: by task; kept here.
        sweep: set to have the shard looked through at once.
        ages: of the tasks whose records are seen.
        slow: whether acceptances are slow, by the monotonic clock and how late the event loop is.
        moved: gets each record that a coordinator has written.
        ended: gets each coordinator that has come to its end.
        changed: called when the coordinators are other ones.
    """

    def __init__(
        self,
        context: Context,
        coordinators: dict[str, Coordinator],
        *,
        sweep: asyncio.Event,
        ages: Ages,
        slow: Callable[[float, float], bool],
        moved: Callable[[TaskRecord], None],
        ended: Callable[[Coordinator], None],
        changed: Callable[[], None],
    ) -> None:
        self.queue = TaskQueue()
        """The tasks that wait for their turn."""
        self._coordinators = coordinators
        self._sweep = sweep
        self._context = context
        self._plane = context.plane
        self._ages = ages
        self._slow = slow
        self._late_s = 0.0
        """How late the event loop is, a mean of the last half second."""
        self._moved = moved
        self._ended = ended
        self._changed = changed
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._beginning: dict[str, Waiting] = {}
        """Tasks whose turn has come and whose records are being read."""
        self._reading = Background()
        self._breaks: Counter[str] = Counter()
        """How often a task's coordinator has broken; each time it is left alone for longer, in the end given up."""
        self._why: dict[str, Failure] = {}
        """Why the last coordinator of a task broke."""
        self._healing: dict[str, asyncio.Task[None]] = {}
        self._final: dict[str, VersionVector] = {}
        """Records of the shard known to be final, which need not be decoded at every sweep."""
        self._let_go: set[str] = set()
        """Tasks that were driven here, have not ended so, and whose record was not looked at since."""
        self._since: dict[str, float] = {}
        """Since when each task is driven here, on the monotonic clock."""
        self._sweeper: asyncio.Task[None] | None = None
        self._turning: asyncio.Task[None] | None = None
        self._unwatch: Callable[[], None] = lambda: None
        self._stopping = False

    def start(self) -> None:
        """Take up what is owned here, now and on every call of `ring_changed`."""
        # Asked on the store's thread, of every record: a look into a dict, which threads may share.
        self._unwatch = self._plane.dht.watch(
            lambda key: key.startswith(PREFIX) and key[len(PREFIX) :] in self._coordinators, self._changed_here
        )
        self._sweeper = asyncio.create_task(self._keep_sweeping(), name="task takeover")
        self._turning = asyncio.create_task(self._keep_turning(), name="turns of tasks")
        self._sweep.set()

    def __contains__(self, task: str) -> bool:
        """Whether a task is worked on here, or waits for its turn."""
        return task in self._coordinators or task in self.queue or task in self._beginning

    @property
    def at_work(self) -> int:
        """Tasks that are worked on."""
        return len(self._coordinators) + len(self._beginning)

    def take(self, record: TaskRecord, version: VersionVector, value: bytes = b"") -> None:
        """Drive a task, or have one that has not begun wait for its turn; `value` as of `drive`."""
        if record.id in self or self._stopping:
            return
        now = time.monotonic()
        full = len(self.queue) > 0 or not self._room() or self._slow(now, self._late_s)
        if record.state is not TaskState.ACCEPTED or not full:
            self.drive(record, version, value)
            return
        waiting = Waiting(
            id=record.id,
            submitter=record.submitter,
            priority=record.priority,
            accepted_ns=record.created_ns,
            due_at=now + left_s(record, self._ages.elapsed_s(record)),
        )
        self.queue.add(waiting, now)
        self._give_turns()

    def _room(self) -> bool:
        """Whether there is a place for one more task."""
        return (
            self.at_work < self._context.config.max_tasks
            and len(self._context.scheduler.line) + len(self._beginning) < MOST_IN_LINE
        )

    def _give_turns(self) -> None:
        """Take up the tasks whose turn it is."""
        if self._stopping or not len(self.queue):
            return
        now, most = time.monotonic(), self._context.config.max_tasks
        for task in self.queue.overdue(now):  # its coordinator ends it
            self._begin(task)
        at_work = [(each.record.submitter, each.record.priority) for each in self._coordinators.values()]
        at_work += [(each.submitter, each.priority) for each in self._beginning.values()]

        def busy(submitter: str, priority: int) -> int:
            return sum(name == submitter and of >= priority for name, of in at_work)

        apart_s = APART_S if self._slow(now, self._late_s) else 0.0
        for _ in range(MOST_AT_ONCE):
            if self.at_work >= 2 * most:
                break
            task = self.queue.next(now, room=self._room(), busy=busy, apart_s=apart_s)
            if task is None:
                break
            at_work.append((task.submitter, task.priority))
            self._begin(task)

    def _begin(self, task: Waiting) -> "asyncio.Task[None]":
        self._beginning[task.id] = task
        return self._reading.start(self._drive_stored(task.id), f"take up {task.id}")

    async def _drive_stored(self, task: str) -> None:
        """Drive a task whose turn has come, from its record as it stands."""
        try:
            stored = await self._plane.dht.read(task_key(task), replica=True)
        except UnreachableError as error:
            log.info("a task's turn has come and its record cannot be read", task=task, reason=str(error))
            asyncio.get_running_loop().call_later(1.0, self._sweep.set)
            return
        finally:
            del self._beginning[task]
        if stored is None or stored.deleted or not self._plane.dht.owns(stored.key):
            return
        try:
            record = read_record(stored.value)
        except PayloadError as error:
            log.warning("task record cannot be read", key=stored.key, reason=str(error))
            return
        if not record.state.final:
            self.drive(record, stored.version, stored.value)

    async def hurry(self, task: str) -> None:
        """Take a task up that waits for its turn: there is an order for it."""
        if (waiting := self.queue.remove(task)) is not None:
            await self._begin(waiting)

    def place(self, task: str) -> str:
        """What a task waits for that waits for its turn, in words; "" for any other."""
        if task not in self.queue:
            return ""
        ahead, most = self.queue.ahead(task), self._context.config.max_tasks
        return (
            f"its turn: {ahead:,} tasks of its submitter go before it, {len(self.queue):,} wait at "
            f"{self._plane.gateway}, which works on {most} at once (tasks.max_tasks)"
        )

    async def _keep_turning(self) -> None:
        while True:
            due = time.monotonic() + TURN_S
            await asyncio.sleep(TURN_S)
            self._late_s += 0.2 * (time.monotonic() - due - self._late_s)
            self._give_turns()

    def drive(self, record: TaskRecord, version: VersionVector, value: bytes = b"") -> None:
        """Drive a task from its record on, unless that is done; `value`: the record as it was stored."""
        if record.id in self._coordinators or self._stopping:
            return
        give_up = self._why.get(record.id) if self._breaks[record.id] >= MAX_BREAKS else unsound(record)
        if give_up is not None and value and self._breaks[record.id] < MAX_BREAKS:
            self._plane.session.refuse("unsound task record", task=record.id, reason=give_up.message)
        coordinator = Coordinator(
            self._context,
            record,
            version,
            on_change=self._moved,
            give_up=give_up,
            elapsed_s=self._ages.elapsed_s(record),
            unknown=unknown(value) if value else None,
        )
        self._coordinators[record.id] = coordinator
        self._since[record.id] = time.monotonic()
        task = asyncio.create_task(coordinator.run(), name=f"drive {record.id}")
        self._tasks[record.id] = task
        task.add_done_callback(lambda done: self._driven(coordinator, done))
        self._changed()

    def _changed_here(self, stored: Record) -> None:
        """This gateway's copy of the record of a task that is driven here has changed."""
        coordinator = self._coordinators.get(stored.key[len(PREFIX) :])
        if coordinator is not None and coordinator.copy_changed(stored.version):
            self._step_down(coordinator)

    def _step_down(self, coordinator: Coordinator) -> None:
        """End a coordinator whose record has moved on; nothing more follows from what it holds in memory."""
        log.info(
            "task record has changed, its coordinator steps down",
            task=coordinator.record.id,
            state=str(coordinator.written.state),
        )
        self._tasks[coordinator.record.id].cancel()

    def _driven(self, coordinator: Coordinator, done: asyncio.Task[None]) -> None:
        self._coordinators.pop(coordinator.record.id, None)
        self._ended(coordinator)
        self._tasks.pop(coordinator.record.id, None)
        task = coordinator.record.id
        driven_s = time.monotonic() - self._since.pop(task)
        if not done.cancelled() and (error := done.exception()) is not None:
            # The record stands as it was last written: a new coordinator takes it up from there.
            log.error("coordinator broke", task=task, exc_info=error)
            if not isinstance(error, UnreachableError | DeadlineError):
                self._breaks[task] += 1
                what = error.message if isinstance(error, SwiftbotError) else f"{type(error).__name__}: {error}"
                self._why[task] = Failure(code="internal", message=clean(f"driving it broke: {what}", MAX_TEXT))
        if coordinator.ended or self._stopping:
            self._breaks.pop(task, None)
            self._why.pop(task, None)
            log.info(
                "task ended" if coordinator.ended else "task is handed over",
                task=task,
                state=str(coordinator.record.state),
            )
        else:
            pause_s = min(30.0, 0.5 * 2 ** self._breaks[task])
            if coordinator.overtaken and driven_s > SETTLED_S and not self._breaks[task]:
                pause_s = 0.0
            self._let_go.add(task)
            asyncio.get_running_loop().call_later(pause_s, self._sweep.set)
        self._give_turns()
        self._changed()

    async def _keep_sweeping(self) -> None:
        """Take up what is ours when the ring changes, and now and then in any case.

        A task can be accepted by a gateway that learns a moment later that the key is another's: without the
        regular look its owner, who has swept before the record came, would never drive it.
        """
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(SWEEP_S):
                    await self._sweep.wait()
            self._sweep.clear()
            try:
                await self._take_up()
            except Exception as error:  # without takeover a lost gateway's tasks would hang: it must not die
                log.exception("takeover is tried again", reason=str(error))
                asyncio.get_running_loop().call_later(1.0, self._sweep.set)

    async def _take_up(self) -> None:
        """Drive the unfinished tasks of the shard that are owned here; let go of those that are not."""
        for task_id, driving in list(self._tasks.items()):
            if not self._plane.dht.owns(task_key(task_id)):
                driving.cancel()
        for task_id in self.queue:
            if not self._plane.dht.owns(task_key(task_id)):
                self.queue.remove(task_id)
        final: dict[str, VersionVector] = {}
        for number, stored in enumerate(await self._plane.dht.local(PREFIX, leave_out=TRIMMED)):
            if number % READ_AT_ONCE == READ_AT_ONCE - 1:
                await asyncio.sleep(0)
            if stored.key[len(PREFIX) :] in self.queue:  # read when its turn comes
                continue
            if self._final.get(stored.key) == stored.version:  # the most by far
                final[stored.key] = stored.version
                continue
            if stored.deleted or not self._plane.dht.owns(stored.key):
                continue
            try:
                record = read_record(stored.value)
            except PayloadError as error:
                log.warning("task record cannot be read", key=stored.key, reason=str(error))
                continue
            if task_key(record.id) != stored.key:
                # Driven under the name it gives itself it would be written over another task's record.
                reason = f"it is of {record.id[:80]!r}"
                self._plane.session.refuse("misplaced task record", key=stored.key, reason=reason)
                final[stored.key] = stored.version
                continue
            if record.state.final:
                final[stored.key] = stored.version
                if (coordinator := self._coordinators.get(record.id)) is not None and coordinator.copy_changed(
                    stored.version
                ):
                    self._step_down(coordinator)
                self._heal_ended(record, stored.version, stored.value)
            elif record.id not in self._coordinators:
                self.take(record, stored.version, stored.value)
            elif self._coordinators[record.id].copy_changed(stored.version):
                self._step_down(self._coordinators[record.id])
        self._final = final
        await self._tell_ends()

    async def _tell_ends(self) -> None:
        """Publish the ends of tasks that another gateway has coordinated to it while this one went on by its own copy.

        Those who listen on this side of a healed partition have heard of nothing but that copy.
        """
        for task in tuple(self._let_go):
            if task not in self._coordinators:
                try:
                    stored = await self._plane.dht.read(task_key(task))
                except UnreachableError:
                    continue  # looked at again with the next sweep
                if stored is not None and _is_final(stored.value):
                    self._plane.session.put(self._plane.keys(keyspace.TASK_UPDATE, task), stored.value)
            self._let_go.discard(task)

    def _heal_ended(self, record: TaskRecord, version: VersionVector, value: bytes) -> None:
        """Tell what became of a task that had been ended on one side of a partition and went on on the other."""
        healing = heal(record)
        if healing is None or record.id in self._healing or self._stopping:
            return
        writer = RecordWriter(self._plane, Draft(record, self._plane.gateway), version, unknown=unknown(value))
        work = asyncio.create_task(healing.settle(self._plane, writer), name=f"heal {record.id}")
        self._healing[record.id] = work
        work.add_done_callback(lambda done: self._healed(record.id, done))

    def _healed(self, task: str, done: asyncio.Task[None]) -> None:
        self._healing.pop(task, None)
        if not done.cancelled() and (error := done.exception()) is not None:
            log.info("what a partition left is settled later", task=task, reason=str(error))
            self._final.pop(task_key(task), None)  # looked at again with the next sweep

    def ring_changed(self) -> None:
        """Look through the shard now and a few times more: records of a partition's other side come bit by bit."""
        self._sweep.set()
        for pause_s in AGAIN_S:
            asyncio.get_running_loop().call_later(pause_s, self._sweep.set)

    async def close(self) -> None:
        """Stop all coordinators; the records stay."""
        self._stopping = True
        self._unwatch()
        await self._reading.close()
        tasks = [*self._tasks.values(), *self._healing.values()]
        tasks += [each for each in (self._sweeper, self._turning) if each is not None]
        for each in tasks:
            each.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def _is_final(value: bytes) -> bool:
    """Whether a stored record is of a task that has ended; not one that cannot be read."""
    try:
        return read_record(value).state.final
    except PayloadError:
        return False


class TaskManager:
    """Accepts, drives and answers for tasks on one gateway."""

    def __init__(
        self,
        config: TasksConfig,
        *,
        plane: Plane,
        catalogue: Catalogue,
        decomposer: Decomposer,
        site: Site,
        image_of: Callable[[str], str] = lambda _: "",
        commands: Commands = FREE,
        out_of_use: Callable[[], OutOfUse] = OutOfUse,
        audit: Audit | None = None,
        on_change: Callable[[], None] = lambda: None,
        on_transition: Callable[[Transition], None] = lambda _: None,
        on_record: Callable[[TaskRecord], None] = lambda _: None,
        runs: Telling | None = None,
    ) -> None:
        """`runs`: where the events of this gateway's own runs are heard; without, over Zenoh."""
        self.config = config
        self._runs = runs
        self.plane = plane
        self._audit = audit or Audit(plane.session, plane.keys, plane.gateway)
        self._ages = Ages()
        self._admission = Admission(plane.gateway, config.max_tasks + config.max_queue)
        self._on_change = on_change
        self._on_record = on_record
        self._coordinators: dict[str, Coordinator] = {}
        self.scheduler = Scheduler(
            plane,
            catalogue,
            config,
            records=lambda: [coordinator.record for coordinator in self._coordinators.values()],
            wake=self._wake,
            image_of=image_of,
            hindrance=commands.hindrance,
            closed=self._closed,
            kept_from=self._kept_from,
            shuns=decomposer.memory.experience.shuns,
            site=site,
            expected=decomposer.memory.experience.expected_s,
        )
        self._ahead = LookAhead(
            plane,
            catalogue.skills,
            likely_place=self.scheduler.likely_place,
            experience_s=decomposer.memory.experience.expected_s,
        )
        self._sweep = asyncio.Event()
        self.questions = Questions(
            plane,
            self._coordinators,
            scheduler=self.scheduler,
            durations=self._ahead.durations,
            sweep=self._sweep,
            hurry=self._hurry,
            place=self._place,
        )
        self.context = Context(
            plane=plane,
            config=config,
            catalogue=catalogue,
            scheduler=self.scheduler,
            plans=Plans(
                config,
                plane,
                catalogue=catalogue,
                decomposer=decomposer,
                site=site,
                task=self.questions.task,
                busy=self.scheduler.busy_robots,
                out_of_use=out_of_use,
            ),
            ahead=self._ahead,
            commands=commands,
            on_transition=on_transition,
            findings=Counter(),
        )
        self._takeover = Takeover(
            self.context,
            self._coordinators,
            sweep=self._sweep,
            ages=self._ages,
            slow=self._admission.slow,
            moved=self._moved,
            ended=self._has_ended,
            changed=on_change,
        )
        self._closers: list[Callable[[], None]] = []

    @property
    def unfinished(self) -> int:
        """Tasks of this coordinator that have not ended, those that wait for their turn among them."""
        return self._takeover.at_work + len(self._takeover.queue)

    @property
    def waiting(self) -> int:
        """Of these, those that wait for their turn."""
        return len(self._takeover.queue)

    @property
    def records(self) -> tuple[TaskRecord, ...]:
        """Their records as they are just now."""
        return tuple(each.record for each in self._coordinators.values())

    @property
    def findings(self) -> Mapping[str, int]:
        """What the watchdog and replanning found and did, by kind, since start."""
        return self.context.findings

    async def start(self) -> None:
        """Answer RPC and take up the unfinished tasks whose keys this gateway owns."""
        rpc = self.plane.rpc
        # Before the audit: what is only told to come back is no order yet.
        submit = self._audit.submission(self.submit)
        rpc.register(keyspace.SUBMIT, self._admission.paced(submit, most=SUBMITTED_AT_ONCE))
        rpc.register(keyspace.ACCEPT, self._admission.paced(self.accept, most=ACCEPTED_AT_ONCE))
        plans, questions = self.context.plans, self.questions
        rpc.register(keyspace.PLAN, plans.propose)
        rpc.register(keyspace.EXPERIENCE, plans.experience)
        rpc.register(keyspace.TASK, questions.task)
        rpc.register(keyspace.TASKS, questions.tasks)
        rpc.register(keyspace.PLAN_CHECK, plans.check)
        rpc.register(keyspace.CANCEL, self._audit.signed("cancel", questions.cancel))
        rpc.register(keyspace.CANCEL_HERE, questions.cancel_here)
        rpc.register(keyspace.WHY, questions.why)
        rpc.register(keyspace.SKILLS, self.scheduler.skills)
        OperatorVerbs(
            self.plane,
            self._coordinators,
            task=questions.task,
            drive=self._takeover.drive,
            hurry=self._takeover.hurry,
            published=self.context.on_transition,
            audit=self._audit,
        ).register()
        news = self.plane.session.subscribe_typed(
            keyspace.RUN_EVENT,
            self._on_run_event,
            heed=lambda key: keyspace.RUN_EVENT.names(key)[0] in self._coordinators,
        )
        self._closers.append(news.close)
        if self._runs is not None:
            self._closers.append(self._runs.listen(self._on_own_run_event))
        self._closers.append(self.plane.session.subscribe(self.plane.keys(keyspace.TASK_UPDATE), self._ages.hear).close)
        self._closers.append(self.plane.events.subscribe(Stage.TASKS, self._on_fleet_event))
        await self._ahead.durations.load()
        self._takeover.start()

    async def settle(self, deadline_s: float) -> None:
        """Wait until the ends of this gateway's own runs, which is draining, stand in the records driven here.

        Otherwise the next coordinator would find them running on a gateway that is gone, and repeat them.
        """
        until = time.monotonic() + deadline_s
        while time.monotonic() < until and not all(coordinator.settled for coordinator in self._coordinators.values()):  # noqa: ASYNC110 - several coordinators, a few seconds at most
            await asyncio.sleep(0.02)

    async def stop(self) -> None:
        """Stop driving; the records stay, and the next owner of each key goes on."""
        for close in self._closers:
            close()
        await self._takeover.close()
        await self._ahead.close()
        await self.scheduler.close()

    # --- submission -----------------------------------------------------------------------------------------

    async def submit(self, request: TaskRequest) -> TaskRecord:
        """Accept a task wherever its key belongs; durable when this returns.

        A request with an `id` that is known is the same task: its record is returned, or what is remembered of it.

        Raises:
            PayloadError: empty or oversize instruction, bad id.
            RefusedError: it is a stop; the coordinator is full.
            UnreachableError: no owner could be reached within the time allowed.
        """
        request = checked(request, self.config)
        refuse_commands(request, self.plane.registry.robots)
        until = time.monotonic() + 5.0
        while True:
            owner = ""
            try:
                owner = await self.plane.owner_of(task_key(request.id))
                if owner != self.plane.gateway:
                    return await self.plane.rpc.call(owner, keyspace.ACCEPT, request)
            except (UnreachableError, DeadlineError) as error:
                # The owner died: its tokens go within a second, then the ring names its successor.
                if time.monotonic() > until:
                    raise
                log.info("owner not found or does not answer, asking again", owner=owner, reason=str(error))
                await asyncio.sleep(0.1)
                continue
            return await self.accept(request)

    async def accept(self, request: TaskRequest) -> TaskRecord:
        """Write the record, here and on the replicas, then drive it."""
        request = checked(request, self.config)
        if request.id in self._takeover:
            return await self.questions.task(TaskAsk(id=request.id))  # asked again, however full it is
        with self._admission.one_more(request.id, self.unfinished):
            return await self._take(request)

    async def _take(self, request: TaskRequest) -> TaskRecord:
        transition = Transition(
            task=request.id,
            sequence=1,
            kind=TransitionKind.ACCEPTED,
            at_ns=time.time_ns(),
            coordinator=self.plane.gateway,
            instruction=request.instruction,
            submitter=request.submitter,
            priority=request.priority,
            deadline_s=request.deadline_s,
            within=request.group,
            plan=request.plan,
            approval=request.approval,
            note=self.context.expect(
                request.plan, deadline_s=request.deadline_s, tasks_before=len(self._takeover.queue)
            ),
        )
        record = machine.apply(None, transition)
        try:
            version = await self.plane.dht.write(task_key(record.id), encode(record), expected=None)
        except ConflictError:
            # Known already; perhaps by a first try whose answer was lost before it was driven.
            await self._take_known(request.id)
            return answered(await self.questions.task(TaskAsk(id=request.id)), request)
        self.plane.session.publish(keyspace.TRANSITION, transition, record.id)
        self.context.on_transition(transition)
        self.plane.session.publish(keyspace.TASK_UPDATE, record, record.id)
        log.info("task accepted", task=record.id, instruction=record.instruction)
        self._takeover.take(record, version)
        return record

    async def _take_known(self, task: str) -> None:
        """Take up a task whose record is there, unless it has ended or is another gateway's."""
        stored = await self.plane.dht.read(task_key(task))
        if stored is None or stored.deleted or not self.plane.dht.owns(stored.key):
            return
        record = read_record(stored.value)
        if not record.state.final:
            self._takeover.take(record, stored.version, stored.value)

    # --- driving --------------------------------------------------------------------------------------------

    def _moved(self, record: TaskRecord) -> None:
        self.scheduler.moved(record)
        self._on_record(record)
        self._on_change()

    def _has_ended(self, coordinator: Coordinator) -> None:
        self.scheduler.forget(coordinator.record.id)
        if coordinator.ended:
            self._admission.ends.ended(time.monotonic())

    def _on_run_event(self, key: str, event: RunEvent | None) -> None:
        if event is None or (coordinator := self._coordinators.get(event.task)) is None:
            return
        if not key.endswith(f"/task/{event.task}/run/{event.subtask}") or not self.plane.sees(event.gateway):
            self.plane.session.deny("forged run event", key, f"from {clean(event.gateway, 80)!r}")
            return
        if self._runs is None or event.gateway != self.plane.gateway:
            coordinator.put(RunReported(event))

    def _on_own_run_event(self, event: RunEvent) -> None:
        if (coordinator := self._coordinators.get(event.task)) is not None:
            coordinator.put(RunReported(event))

    def _on_fleet_event(self, event: FleetEvent) -> None:
        match event:
            case Lost(gateway):
                for coordinator in self._coordinators.values():
                    coordinator.put(GatewayLost(gateway))
            case Relinked(gateway):
                for coordinator in self._coordinators.values():
                    coordinator.put(GatewayRelinked(gateway))
            case RingChanged():
                self._takeover.ring_changed()
            case AuthorityChanged():
                for coordinator in self._coordinators.values():
                    coordinator.put(Wake())
            case FactsChanged("gateway"):
                self.scheduler.line.serve(time.monotonic())
            case FactsChanged("robot"):
                for coordinator in self._coordinators.values():
                    if coordinator.waits:
                        coordinator.put(Wake())
            case _:
                pass

    def _closed(self, subtask: Subtask) -> str:
        return self.context.plans.closed(subtask)

    def _kept_from(self, subtask: Subtask, robot: str) -> str:
        return self.context.plans.kept_from(subtask, robot)

    async def _hurry(self, task: str) -> None:
        await self._takeover.hurry(task)

    def _place(self, task: str) -> str:
        return self._takeover.place(task)

    def _wake(self, task: str) -> None:
        """Have a task's coordinator look again: a subtask of it may go now."""
        if (coordinator := self._coordinators.get(task)) is not None:
            coordinator.put(Wake())

    def coordinator(self, task: str) -> Coordinator | None:
        """Return the coordinator of a task, if it is this gateway's."""
        return self._coordinators.get(task)
