"""The task manager of one gateway: accepts tasks, drives those whose key it owns, answers for them over RPC.

A task belongs to the gateway that owns `task/{id}` on the ring. Submissions are handed there, and acknowledged
when the record is durable on it and on its replicas.

Takeover: when the ring changes, and now and then, every gateway looks through its shard. An unfinished task whose key
it now owns gets a driver here, one that it owns no longer loses it: a dead coordinator's tasks are driven by the next
owner from the replicated record. A driver that breaks is followed by another, later each time.

A driver follows its record, never the other way round: where this gateway's copy changes by another hand (a healed
partition, a coordinator elsewhere), the driver steps down at once, and the record as it stands now gets a new one, or
is told to those who listen when it is final.
"""

import asyncio
import contextlib
import time
from collections import Counter
from collections.abc import Callable, Mapping

import structlog
from msgspec.structs import replace

from appliance.errors import ConflictError, DeadlineError, NotFoundError, PayloadError, SwiftbotError, UnreachableError
from appliance.llm.cascade import Decomposer
from appliance.model import (
    Failure,
    Group,
    Plan,
    RunAccepted,
    RunEvent,
    RunRequest,
    Site,
    SubtaskRecord,
    TaskRecord,
    TaskRequest,
    VersionVector,
    encode,
)
from appliance.plane.dht import Record
from appliance.plane.keys import run_of
from appliance.plane.node import Plane
from appliance.skills.catalogue import Catalogue, SkillManifest
from appliance.tasks import conflicts, machine
from appliance.tasks.admission import Admission, checked, expectation, longest_s, refuse_stop
from appliance.tasks.api import (
    CancelTaskAsk,
    ExperienceAsk,
    PlanAsk,
    PlanCheckAsk,
    SkillsAsk,
    TaskAsk,
    TasksAsk,
    WhyAsk,
)
from appliance.tasks.audit import Audit
from appliance.tasks.checkpoints import Checkpoint, read_checkpoint, remove_checkpoint
from appliance.tasks.conflicts import heal
from appliance.tasks.context import FREE, PREFIX, Commands, GatewayLost, RunNews, Surroundings, Wake, task_key
from appliance.tasks.coordinator import Driver
from appliance.tasks.endpoints import OperatorVerbs, Questions
from appliance.tasks.executor import Executor
from appliance.tasks.lookahead import LookAhead
from appliance.tasks.machine import Transition, TransitionKind
from appliance.tasks.placement import Place, Placement
from appliance.tasks.plans import Plans, Recovery
from appliance.tasks.record_writer import Keeper
from appliance.tasks.records import MAX_TEXT, clean, read_record, unknown, unsound
from appliance.tasks.retention import TRIMMED, answered
from appliance.tasks.scheduler import Scheduler
from appliance.tasks.settings import TasksConfig
from appliance.tasks.timing import Ages

log = structlog.get_logger(__name__)

SWEEP_S = 15.0
"""How often the shard is looked through when the ring stands still."""
MAX_BREAKS = 6
"""Drivers of one task that may break before it is ended with the reason; with the pauses, half a minute."""
SETTLED_S = 1.0
"""A driver overtaken after less than this is not followed at once: two gateways that both take a key for theirs, as
while the membership settles, would overtake each other as fast as they can write."""
AGAIN_S = (0.5, 1.5, 4.0)
"""When the shard is looked through again after the ring has changed."""


class Driving:
    """The drivers of one gateway.

    Args:
        around: what drivers need.
        ages: of the tasks that are heard of.
        moved: told each record that a driver has written.
        ended: told each driver that has come to its end.
        changed: told when the drivers are other ones.
    """

    def __init__(
        self,
        around: Surroundings,
        *,
        ages: Ages,
        moved: Callable[[TaskRecord], None],
        ended: Callable[[Driver], None],
        changed: Callable[[], None],
    ) -> None:
        self.drivers: dict[str, Driver] = {}
        self.sweep = asyncio.Event()
        """Set to have the shard looked through at once."""
        self._around = around
        self._plane = around.plane
        self._ages = ages
        self._moved = moved
        self._ended = ended
        self._changed = changed
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._breaks: Counter[str] = Counter()
        """How often a task's driver has broken; each time it is left alone for longer, in the end given up."""
        self._why: dict[str, Failure] = {}
        """Why the last driver of a task broke."""
        self._healing: dict[str, asyncio.Task[None]] = {}
        self._final: dict[str, VersionVector] = {}
        """Records of the shard known to be final, which need not be decoded at every sweep."""
        self._let_go: set[str] = set()
        """Tasks that were driven here, have not ended so, and whose record was not looked at since."""
        self._since: dict[str, float] = {}
        """Since when each task is driven here, on the monotonic clock."""
        self._sweeper: asyncio.Task[None] | None = None
        self._unwatch: Callable[[], None] = lambda: None
        self._stopping = False

    def start(self) -> None:
        """Take up what is owned here, now and whenever the ring changes."""
        self._plane.dht.on_ring_change.append(self.sweep.set)
        self._plane.dht.on_ring_change.append(self._sweep_soon)
        # Asked on the store's thread, of every record: a look into a dict, which threads may share.
        self._unwatch = self._plane.dht.watch(
            lambda key: key.startswith(PREFIX) and key[len(PREFIX) :] in self.drivers, self._changed_here
        )
        self._sweeper = asyncio.create_task(self._keep_sweeping(), name="task takeover")
        self.sweep.set()

    def drive(self, record: TaskRecord, version: VersionVector, value: bytes = b"") -> None:
        """Drive a task from its record on, unless that is done; `value`: the record as it was stored."""
        if record.id in self.drivers or self._stopping:
            return
        give_up = self._why.get(record.id) if self._breaks[record.id] >= MAX_BREAKS else unsound(record)
        if give_up is not None and value and self._breaks[record.id] < MAX_BREAKS:
            self._plane.session.refuse("unsound task record", task=record.id, reason=give_up.message)
        driver = Driver(
            self._around,
            record,
            version,
            on_change=self._moved,
            give_up=give_up,
            elapsed_s=self._ages.elapsed_s(record),
            unknown=unknown(value) if value else None,
        )
        self.drivers[record.id] = driver
        self._since[record.id] = time.monotonic()
        task = asyncio.create_task(driver.run(), name=f"drive {record.id}")
        self._tasks[record.id] = task
        task.add_done_callback(lambda done: self._driven(driver, done))
        self._changed()

    def _changed_here(self, stored: Record) -> None:
        """This gateway's copy of the record of a task that is driven here has changed."""
        driver = self.drivers.get(stored.key[len(PREFIX) :])
        if driver is not None and driver.heard(stored.version):
            self._step_down(driver)

    def _step_down(self, driver: Driver) -> None:
        """End a driver whose record has moved on; nothing more follows from what it holds in memory."""
        log.info("task record has changed, its driver steps down", task=driver.record.id, state=str(driver.told.state))
        self._tasks[driver.record.id].cancel()

    def _driven(self, driver: Driver, done: asyncio.Task[None]) -> None:
        self.drivers.pop(driver.record.id, None)
        self._ended(driver)
        self._tasks.pop(driver.record.id, None)
        task = driver.record.id
        driven_s = time.monotonic() - self._since.pop(task)
        if not done.cancelled() and (error := done.exception()) is not None:
            # The record stands as it was last written: a new driver takes it up from there.
            log.error("driver broke", task=task, exc_info=error)
            if not isinstance(error, UnreachableError | DeadlineError):
                self._breaks[task] += 1
                what = error.message if isinstance(error, SwiftbotError) else f"{type(error).__name__}: {error}"
                self._why[task] = Failure(code="internal", message=clean(f"driving it broke: {what}", MAX_TEXT))
        if driver.ended or self._stopping:
            self._breaks.pop(task, None)
            self._why.pop(task, None)
            log.info("task ended" if driver.ended else "task is handed over", task=task, state=str(driver.record.state))
        else:
            pause_s = min(30.0, 0.5 * 2 ** self._breaks[task])
            if driver.overtaken and driven_s > SETTLED_S and not self._breaks[task]:
                pause_s = 0.0
            self._let_go.add(task)
            asyncio.get_running_loop().call_later(pause_s, self.sweep.set)
        self._changed()

    async def _keep_sweeping(self) -> None:
        """Take up what is ours when the ring changes, and now and then in any case.

        A task can be accepted by a gateway that learns a moment later that the key is another's: without the
        regular look its owner, who has swept before the record came, would never drive it.
        """
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(SWEEP_S):
                    await self.sweep.wait()
            self.sweep.clear()
            try:
                await self._take_up()
            except Exception as error:  # without takeover a lost gateway's tasks would hang: it must not die
                log.exception("takeover is tried again", reason=str(error))
                asyncio.get_running_loop().call_later(1.0, self.sweep.set)

    async def _take_up(self) -> None:
        """Drive the unfinished tasks of the shard that are owned here; let go of those that are not."""
        for task_id, driving in list(self._tasks.items()):
            if not self._plane.dht.owns(task_key(task_id)):
                driving.cancel()
        final: dict[str, VersionVector] = {}
        for stored in await self._plane.dht.local(PREFIX, leave_out=TRIMMED):
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
                if (driver := self.drivers.get(record.id)) is not None and driver.heard(stored.version):
                    self._step_down(driver)
                self._heal_ended(record, stored.version, stored.value)
            elif record.id not in self.drivers:
                self.drive(record, stored.version, stored.value)
            elif self.drivers[record.id].heard(stored.version):
                self._step_down(self.drivers[record.id])
        self._final = final
        await self._tell_ends()

    async def _tell_ends(self) -> None:
        """Publish the ends of tasks that another gateway has coordinated to it while this one went on by its own copy.

        Those who listen on this side of a healed partition have heard of nothing but that copy.
        """
        for task in tuple(self._let_go):
            if task not in self.drivers:
                try:
                    stored = await self._plane.dht.read(task_key(task))
                except UnreachableError:
                    continue  # looked at again with the next sweep
                if stored is not None and _is_final(stored.value):
                    self._plane.session.put(self._plane.keys.task(task), stored.value)
            self._let_go.discard(task)

    def _heal_ended(self, record: TaskRecord, version: VersionVector, value: bytes) -> None:
        """Tell what became of a task that had been ended on one side of a partition and went on on the other."""
        healing = heal(record)
        if healing is None or record.id in self._healing or self._stopping:
            return
        keeper = Keeper(self._plane, record, version, lambda _: None)
        keeper.unknown = unknown(value)
        work = asyncio.create_task(healing.settle(self._plane, keeper), name=f"heal {record.id}")
        self._healing[record.id] = work
        work.add_done_callback(lambda done: self._healed(record.id, done))

    def _healed(self, task: str, done: asyncio.Task[None]) -> None:
        self._healing.pop(task, None)
        if not done.cancelled() and (error := done.exception()) is not None:
            log.info("what a partition left is settled later", task=task, reason=str(error))
            self._final.pop(task_key(task), None)  # looked at again with the next sweep

    def _sweep_soon(self) -> None:
        """Look through the shard again a few times: records of the other side of a partition come bit by bit."""
        for pause_s in AGAIN_S:
            asyncio.get_running_loop().call_later(pause_s, self.sweep.set)

    async def close(self) -> None:
        """Stop all drivers; the records stay."""
        self._stopping = True
        self._unwatch()
        tasks = [each for each in (self._sweeper, *self._tasks.values(), *self._healing.values()) if each]
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
        executor: Executor,
        site: Site,
        image_of: Callable[[str], str] = lambda _: "",
        commands: Commands = FREE,
        audit: Audit | None = None,
    ) -> None:
        self.config = config
        self.plane = plane
        self.commands = commands
        self._audit = audit or Audit(plane.session, plane.keys, plane.gateway)
        self._catalogue = catalogue
        self._executor = executor
        self._ages = Ages()
        self._admission = Admission(plane.gateway, config.max_tasks)
        self._driving = Driving(self, ages=self._ages, moved=self._moved, ended=self._has_ended, changed=self._tell)
        self._drivers, self._sweep = self._driving.drivers, self._driving.sweep
        self.scheduler = Scheduler(
            plane,
            catalogue,
            config,
            records=lambda: [driver.record for driver in self._drivers.values()],
            wake=self._wake,
            image_of=image_of,
            hindrance=commands.hindrance,
            shuns=decomposer.memory.experience.shuns,
        )
        self._ahead = LookAhead(
            plane,
            manifest=self.manifest,
            likely_place=self.scheduler.likely_place,
            tell_here=executor.hint,
            experience_s=decomposer.memory.experience.expected_s,
        )
        self.recovery = Recovery(
            plane,
            catalogue=catalogue,
            decomposer=decomposer,
            site=site,
            durations=self._ahead.durations,
            busy=self.scheduler.busy_robots,
        )
        questions = Questions(
            plane, self._drivers, scheduler=self.scheduler, durations=self._ahead.durations, sweep=self._sweep
        )
        self.task, self.tasks, self.why = questions.task, questions.tasks, questions.why
        self.cancel, self.cancel_here = questions.cancel, questions.cancel_here
        plans = Plans(config, plane, catalogue=catalogue, decomposer=decomposer, site=site, task=questions.task)
        self.plan, self.approval, self.plan_problems = plans.plan, plans.approval, plans.problems
        self.plan_check, self.plan_only, self.experience = plans.check, plans.propose, plans.experience
        self._closers: list[Callable[[], None]] = []
        self.on_change: Callable[[], None] = lambda: None

    @property
    def unfinished(self) -> int:
        """Tasks coordinated here that have not ended."""
        return len(self._drivers)

    async def start(self) -> None:
        """Answer RPC and take up the unfinished tasks whose keys this gateway owns."""
        rpc = self.plane.rpc
        self.plane.dht.resolver = conflicts.resolver
        rpc.register("submit", TaskRequest, self._audit.submission(self.submit))
        rpc.register("accept", TaskRequest, self.accept)
        rpc.register("plan", PlanAsk, self.plan_only)
        rpc.register("experience", ExperienceAsk, self.experience)
        rpc.register("task", TaskAsk, self.task)
        rpc.register("tasks", TasksAsk, self.tasks)
        rpc.register("plan_check", PlanCheckAsk, self.plan_check)
        rpc.register("cancel", CancelTaskAsk, self._audit.signed("cancel", self.cancel))
        rpc.register("cancel_here", CancelTaskAsk, self.cancel_here)
        rpc.register("why", WhyAsk, self.why)
        rpc.register("skills", SkillsAsk, self.scheduler.skills)
        OperatorVerbs(
            self.plane,
            self._drivers,
            task=self.task,
            drive=self._driving.drive,
            published=self.recovery.published,
            audit=self._audit,
        ).register()
        news = self.plane.session.subscribe_typed(
            self.plane.keys.run(), RunEvent, self._on_run_event, heed=lambda key: run_of(key)[0] in self._drivers
        )
        self._closers.append(news.close)
        self._closers.append(self.plane.session.subscribe(self.plane.keys.task(), self._ages.hear).close)
        self.plane.on_member_lost.append(self._on_member_lost)
        self.plane.registry.on_change.append(self._on_fact)
        await self._ahead.durations.load()
        self._driving.start()

    async def settle(self, deadline_s: float) -> None:
        """Wait until the ends of this gateway's own runs, which is draining, stand in the records driven here.

        Otherwise the next coordinator would find them running on a gateway that is gone, and repeat them.
        """
        until = time.monotonic() + deadline_s
        while time.monotonic() < until and not all(driver.settled for driver in self._drivers.values()):  # noqa: ASYNC110 - several drivers, a few seconds at most
            await asyncio.sleep(0.02)

    async def stop(self) -> None:
        """Stop driving; the records stay, and the next owner of each key goes on."""
        for close in self._closers:
            close()
        await self._driving.close()
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
        refuse_stop(request, self.plane.registry.robots)
        until = time.monotonic() + 5.0
        while True:
            owner = ""
            try:
                owner = await self.plane.owner_of(task_key(request.id))
                if owner != self.plane.gateway:
                    return await self.plane.rpc.call(owner, "accept", request, TaskRecord, timeout_s=2.0)
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
        if request.id in self._drivers:
            return await self.task(TaskAsk(id=request.id))  # asked again, however full it is
        with self._admission.one_more(request.id, self._drivers):
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
            note=self.expect(request.plan, deadline_s=request.deadline_s),
        )
        record = machine.apply(None, transition)
        try:
            version = await self.plane.dht.write(task_key(record.id), encode(record), expected=None)
        except ConflictError:
            # Known already; perhaps by a first try whose answer was lost before it was driven.
            self._sweep.set()
            return answered(await self.task(TaskAsk(id=request.id)), request)
        self.plane.session.put(self.plane.keys.transition(record.id), encode(transition))
        self.recovery.published(transition)
        self.plane.session.put(self.plane.keys.task(record.id), encode(record))
        log.info("task accepted", task=record.id, instruction=record.instruction)
        self._driving.drive(record, version)
        return record

    # --- driving --------------------------------------------------------------------------------------------

    def _moved(self, record: TaskRecord) -> None:
        self.scheduler.moved(record)
        self.on_change()

    def _tell(self) -> None:
        self.on_change()

    def _has_ended(self, driver: Driver) -> None:
        self.scheduler.forget(driver.record.id)
        if driver.ended:
            self._admission.ends.ended(time.monotonic())

    def _on_run_event(self, key: str, event: RunEvent | None) -> None:
        if event is None or (driver := self._drivers.get(event.task)) is None:
            return
        if not key.endswith(f"/task/{event.task}/run/{event.subtask}") or not self.plane.sees(event.gateway):
            self.plane.session.refuse("forged run event", key=key, reason=f"from {clean(event.gateway, 80)!r}")
            return
        driver.tell(RunNews(event))

    def _on_member_lost(self, gateway: str) -> None:
        for driver in self._drivers.values():
            driver.tell(GatewayLost(gateway))

    def _wake(self, task: str) -> None:
        """Have a task's driver look again: a subtask of it may go now."""
        if (driver := self._drivers.get(task)) is not None:
            driver.tell(Wake())

    def look_again(self) -> None:
        """Who may command robots has changed: every driver looks at what that means for its task."""
        for driver in self._drivers.values():
            driver.tell(Wake())

    def _on_fact(self, kind: str) -> None:
        if kind == "gateway":
            self.scheduler.line.serve(time.monotonic())
        if kind == "robot":
            for driver in self._drivers.values():
                if driver.waits:
                    driver.tell(Wake())

    # --- what drivers need ------------------------------------------------------------------------------------

    def manifest(self, skill: str) -> SkillManifest:
        """Return a skill's manifest; NotFoundError when this gateway does not know it (another may)."""
        if (found := self._catalogue.skills.get(skill)) is None:
            raise NotFoundError(
                f"{self.plane.gateway} has no skill {clean(skill, 80)!r}", remedy="give all gateways the same skills"
            )
        return found

    def bind(self, record: TaskRecord, target: SubtaskRecord) -> tuple[str | None, str]:
        """Choose the robot of a subtask."""
        return self.scheduler.bind(record, target)

    def regroup(self, record: TaskRecord) -> Group | None:
        """Return the group that a task should have from now on, or None when the present one may stay."""
        return self.scheduler.regroup(record)

    def place(self, record: TaskRecord, target: SubtaskRecord, robot: str | None) -> Placement:
        """Order the members of a task's group for a subtask by the coarse score."""
        return self.scheduler.place(record, target, robot)

    def sent(self, record: TaskRecord, target: SubtaskRecord, placement: Placement) -> None:
        """Tell, for the log, how the gateways stood when a subtask was sent."""
        self.scheduler.sent(record, target, placement)

    def turn(self, record: TaskRecord, target: SubtaskRecord, placement: Placement, left_s: float) -> Place:
        """Return where a ready subtask may go now, or its place among those that wait for room."""
        return self.scheduler.turn(record, target, placement, left_s)

    def expect(self, plan: Plan | None, *, deadline_s: float, elapsed_s: float = 0.0) -> str:
        """Say in words what a task must expect: a wait, a deadline that can hardly be met; "" when nothing."""
        line, work_s = self.scheduler.line, None
        if plan is not None:
            durations = self._ahead.durations
            seen = [each for each in plan.subtasks if durations.seen(each.skill)]  # a guess is no reason to warn
            work_s = longest_s(plan, {each.id: durations.of(each.skill, each.params) for each in seen})
        return expectation(
            waiting=len(line),
            wait_s=line.expected_s(len(line) + 1),
            work_s=work_s,
            deadline_s=deadline_s,
            elapsed_s=elapsed_s,
        )

    async def order(self, gateway: str, request: RunRequest) -> RunAccepted:
        """Send a run order; to this gateway it is a call."""
        durations = self._ahead.durations
        if durations.seen(request.skill):
            request = replace(request, expected_s=durations.of(request.skill, request.params))
        if gateway == self.plane.gateway:
            return await self._executor.run(request)
        return await self.plane.rpc.call(gateway, "run", request, RunAccepted, timeout_s=self.config.run_timeout_s)

    def plan_moved(self, record: TaskRecord, running_s: Mapping[str, float]) -> None:
        """Tell pools what the subtasks that are not ready will need."""
        self._ahead.plan_moved(record, running_s)

    def took(self, skill: str, duration_ms: float) -> None:
        """Note how long a run that succeeded took."""
        self._ahead.durations.add(skill, duration_ms / 1e3)
        self.scheduler.line.completions.ended(duration_ms / 1e3)

    async def checkpoint(self, task: str, subtask: str) -> Checkpoint | None:
        """Return the last checkpoint of a subtask, or None when there is none or it cannot be had."""
        return await read_checkpoint(self.plane.dht, task, subtask)

    async def forget_checkpoints(self, record: TaskRecord) -> None:
        """Remove the checkpoints of a task that has ended."""
        for each in record.subtasks:
            if each.checkpoint_ns:
                await remove_checkpoint(self.plane.dht, record.id, each.subtask.id)

    def driver(self, task: str) -> Driver | None:
        """Return the driver of a task that is coordinated here."""
        return self._drivers.get(task)
