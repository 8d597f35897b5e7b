"""The task manager of one gateway: accepts tasks, drives those whose key it owns, answers for them over RPC.

A task belongs to the gateway that owns `task/{id}` on the ring. Submissions are handed there, and acknowledged
when the record is durable on it and on its replicas. When the ring changes, every gateway looks through its
shard: an unfinished task whose key it now owns gets a driver here, one that it owns no longer loses it. That is
all there is to takeover: a dead coordinator's tasks are driven by the next owner from the replicated record.
"""

import asyncio
import contextlib
import time
from collections import Counter
from collections.abc import Callable, Mapping

import structlog
from msgspec.structs import replace

from appliance.errors import (
    ConflictError,
    DeadlineError,
    NotFoundError,
    PayloadError,
    PlanError,
    SwiftbotError,
    UnreachableError,
)
from appliance.llm.cascade import Decomposer
from appliance.llm.settings import PlanContext
from appliance.llm.validate import validate
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
from appliance.plane.keys import check_name
from appliance.plane.node import Plane
from appliance.skills.catalogue import Catalogue, SkillManifest
from appliance.tasks import machine, resolve
from appliance.tasks.admission import Ends, checked, expectation, full, longest_s
from appliance.tasks.agreeing import Agreeing
from appliance.tasks.api import PlanAnswer, PlanAsk, SkillsAsk, TaskAsk, TaskList, TasksAsk, WhyAsk
from appliance.tasks.bounds import MAX_TEXT, clean, read_record
from appliance.tasks.checkpoints import Checkpoint, read_checkpoint, remove_checkpoint
from appliance.tasks.deadline import Ages
from appliance.tasks.driver import Driver
from appliance.tasks.executor import Executor
from appliance.tasks.explaining import explain
from appliance.tasks.healing import heal, unheard
from appliance.tasks.keeper import Keeper
from appliance.tasks.line import Place
from appliance.tasks.listing import newest_tasks
from appliance.tasks.lookahead import LookAhead
from appliance.tasks.machine import Transition, TransitionKind
from appliance.tasks.placement import Placement
from appliance.tasks.recovery import Recovery
from appliance.tasks.scheduling import Scheduler
from appliance.tasks.settings import TasksConfig
from appliance.tasks.soundness import unknown, unsound
from appliance.tasks.surroundings import CancelAsked, GatewayLost, RunNews, Wake, task_key
from appliance.tasks.why import TaskWhy, why

log = structlog.get_logger(__name__)

SWEEP_S = 15.0
"""How often the shard is looked through when the ring stands still."""
MAX_BREAKS = 6
"""Drivers of one task that may break before it is ended with the reason; with the pauses, half a minute."""
AGAIN_S = (0.5, 1.5, 4.0)
"""When the shard is looked through again after the ring has changed."""


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
    ) -> None:
        self.config = config
        self.plane = plane
        self._catalogue = catalogue
        self._decomposer = decomposer
        self._executor = executor
        self._site = site
        self._drivers: dict[str, Driver] = {}
        self._driving: dict[str, asyncio.Task[None]] = {}
        self._breaks: Counter[str] = Counter()
        """How often a task's driver has broken; each time it is left alone for longer, in the end given up."""
        self._why: dict[str, Failure] = {}
        """Why the last driver of a task broke."""
        self._healing: dict[str, asyncio.Task[None]] = {}
        self._final: dict[str, VersionVector] = {}
        """Records of the shard known to be final, which need not be decoded at every sweep."""
        self.scheduler = Scheduler(
            plane,
            catalogue,
            config,
            records=lambda: [driver.record for driver in self._drivers.values()],
            wake=self._wake,
            image_of=image_of,
        )
        self._ages = Ages()
        self._ends = Ends()
        self._ahead = LookAhead(
            plane, manifest=self.manifest, likely_place=self.scheduler.likely_place, tell_here=executor.hint
        )
        self.recovery = Recovery(
            plane,
            catalogue=catalogue,
            decomposer=decomposer,
            site=site,
            durations=self._ahead.durations,
            busy=self.scheduler.busy_robots,
        )
        self._closers: list[Callable[[], None]] = []
        self._stopping = False
        self._sweep = asyncio.Event()
        self._sweeper: asyncio.Task[None] | None = None
        self.on_change: Callable[[], None] = lambda: None

    @property
    def unfinished(self) -> int:
        """Tasks coordinated here that have not ended."""
        return len(self._drivers)

    async def start(self) -> None:
        """Answer RPC and take up the unfinished tasks whose keys this gateway owns."""
        rpc = self.plane.rpc
        self.plane.dht.resolver = resolve.resolver
        rpc.register("submit", TaskRequest, self.submit)
        rpc.register("accept", TaskRequest, self.accept)
        rpc.register("plan", PlanAsk, self.plan_only)
        rpc.register("task", TaskAsk, self.task)
        rpc.register("tasks", TasksAsk, self.tasks)
        rpc.register("cancel", TaskAsk, self.cancel)
        rpc.register("cancel_here", TaskAsk, self.cancel_here)
        rpc.register("why", WhyAsk, self.why)
        rpc.register("skills", SkillsAsk, self.scheduler.skills)
        Agreeing(self.plane, self._drivers, self.task).register()
        news = self.plane.session.subscribe_typed(self.plane.keys.run(), RunEvent, self._on_run_event)
        self._closers.append(news.close)
        self._closers.append(self.plane.session.subscribe(self.plane.keys.task(), self._ages.hear).close)
        self.plane.on_member_lost.append(self._on_member_lost)
        self.plane.dht.on_ring_change.append(self._sweep.set)
        self.plane.dht.on_ring_change.append(self._sweep_soon)
        self.plane.registry.on_change.append(self._on_fact)
        await self._ahead.durations.load()
        self._sweeper = asyncio.create_task(self._keep_sweeping(), name="task takeover")
        self._sweep.set()

    async def settle(self, deadline_s: float) -> None:
        """Wait until the ends of this gateway's own runs, which is draining, stand in the records driven here.

        Otherwise the next coordinator would find them running on a gateway that is gone, and repeat them.
        """
        until = time.monotonic() + deadline_s
        while time.monotonic() < until and not all(driver.settled for driver in self._drivers.values()):  # noqa: ASYNC110 - several drivers, a few seconds at most
            await asyncio.sleep(0.02)

    async def stop(self) -> None:
        """Stop driving; the records stay, and the next owner of each key goes on."""
        self._stopping = True
        for close in self._closers:
            close()
        tasks = [each for each in (self._sweeper, *self._driving.values(), *self._healing.values()) if each]
        for each in tasks:
            each.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await self._ahead.close()
        await self.scheduler.close()

    # --- submission -----------------------------------------------------------------------------------------

    async def submit(self, request: TaskRequest) -> TaskRecord:
        """Accept a task wherever its key belongs; durable when this returns.

        A request with an `id` that is known is the same task: its record is returned.

        Raises:
            PayloadError: empty or oversize instruction, bad id.
            RefusedError: the coordinator is full.
            UnreachableError: no owner could be reached within the time allowed.
        """
        request = self._check(request)
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

    def _check(self, request: TaskRequest) -> TaskRequest:
        return checked(request, self.config)

    async def accept(self, request: TaskRequest) -> TaskRecord:
        """Write the record, here and on the replicas, then drive it."""
        request = self._check(request)
        over = len(self._drivers) + 1 - self.config.max_tasks
        if over > 0:
            raise full(self.plane.gateway, len(self._drivers), self._ends.retry_after_s(over, time.monotonic()))
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
            note=self.expect(request.plan, deadline_s=request.deadline_s),
        )
        record = machine.apply(None, transition)
        try:
            version = await self.plane.dht.write(task_key(record.id), encode(record), expected=None)
        except ConflictError:
            # Known already; perhaps by a first try whose answer was lost before it was driven.
            self._sweep.set()
            return await self.task(TaskAsk(id=request.id))
        self.plane.session.put(self.plane.keys.transition(record.id), encode(transition))
        self.recovery.published(transition)
        self.plane.session.put(self.plane.keys.task(record.id), encode(record))
        log.info("task accepted", task=record.id, instruction=record.instruction)
        self._drive(record, version)
        return record

    # --- driving --------------------------------------------------------------------------------------------

    def _drive(self, record: TaskRecord, version: VersionVector, value: bytes = b"") -> None:
        if record.id in self._drivers or self._stopping:
            return
        give_up = self._why.get(record.id) if self._breaks[record.id] >= MAX_BREAKS else unsound(record)
        if give_up is not None and value and self._breaks[record.id] < MAX_BREAKS:
            self.plane.session.refuse("unsound task record", task=record.id, reason=give_up.message)
        driver = Driver(
            self,
            record,
            version,
            on_change=self._moved,
            give_up=give_up,
            elapsed_s=self._ages.elapsed_s(record),
            unknown=unknown(value) if value else None,
        )
        self._drivers[record.id] = driver
        task = asyncio.create_task(driver.run(), name=f"drive {record.id}")
        self._driving[record.id] = task
        task.add_done_callback(lambda done: self._driven(driver, done))
        self.on_change()

    def _moved(self, record: TaskRecord) -> None:
        self.scheduler.moved(record)
        self.on_change()

    def _driven(self, driver: Driver, done: asyncio.Task[None]) -> None:
        self._drivers.pop(driver.record.id, None)
        self.scheduler.forget(driver.record.id)
        if driver.ended:
            self._ends.ended(time.monotonic())
        self._driving.pop(driver.record.id, None)
        task = driver.record.id
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
            asyncio.get_running_loop().call_later(pause_s, self._sweep.set)
        self.on_change()

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
        for task_id, driving in list(self._driving.items()):
            if not self.plane.dht.owns(task_key(task_id)):
                driving.cancel()
        final: dict[str, VersionVector] = {}
        for stored in await self.plane.dht.local("task/"):
            if stored.deleted or not self.plane.dht.owns(stored.key):
                continue
            if self._final.get(stored.key) == stored.version:
                final[stored.key] = stored.version
                continue
            try:
                record = read_record(stored.value)
            except PayloadError as error:
                log.warning("task record cannot be read", key=stored.key, reason=str(error))
                continue
            if task_key(record.id) != stored.key:
                # Driven under the name it gives itself it would be written over another task's record.
                reason = f"it is of {record.id[:80]!r}"
                self.plane.session.refuse("misplaced task record", key=stored.key, reason=reason)
                final[stored.key] = stored.version
                continue
            if record.state.final:
                final[stored.key] = stored.version
                self._heal_ended(record, stored.version)
            elif record.id not in self._drivers:
                self._drive(record, stored.version, stored.value)
            elif unheard(record, self._drivers[record.id].record):
                # Two coordinators have met: whoever drives by the version before goes on from the merged one.
                self._driving[record.id].cancel()
                self._sweep_soon()
        self._final = final

    def _heal_ended(self, record: TaskRecord, version: VersionVector) -> None:
        """Tell what became of a task that had been ended on one side of a partition and went on on the other."""
        healing = heal(record)
        if healing is None or record.id in self._healing or self._stopping:
            return
        keeper = Keeper(self.plane, record, version, lambda _: None)
        work = asyncio.create_task(healing.settle(self.plane, keeper), name=f"heal {record.id}")
        self._healing[record.id] = work
        work.add_done_callback(lambda done: self._healed(record.id, done))

    def _healed(self, task: str, done: asyncio.Task[None]) -> None:
        self._healing.pop(task, None)
        if not done.cancelled() and (error := done.exception()) is not None:
            log.info("what a partition left is settled later", task=task, reason=str(error))

    def _sweep_soon(self) -> None:
        """Look through the shard again a few times: records of the other side of a partition come bit by bit."""
        for pause_s in AGAIN_S:
            asyncio.get_running_loop().call_later(pause_s, self._sweep.set)

    def _on_run_event(self, key: str, event: RunEvent | None) -> None:
        if event is None or (driver := self._drivers.get(event.task)) is None:
            return
        if not key.endswith(f"/task/{event.task}/run/{event.subtask}") or event.gateway not in self.plane.members():
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

    def _on_fact(self, kind: str) -> None:
        if kind == "gateway":
            self.scheduler.line.serve(time.monotonic())
        if kind == "robot":
            for driver in self._drivers.values():
                if driver.waits:
                    driver.tell(Wake())

    # --- what drivers need ------------------------------------------------------------------------------------

    async def plan(self, record: TaskRecord) -> Plan:
        """Return the plan handed in with the task if it is valid, else a new one."""
        robots = tuple(self.plane.registry.robots.values())
        if record.plan is not None:
            problems = validate(record.plan, self._catalogue, robots=robots, site=self._site, require_implemented=True)
            if problems:
                raise PlanError("the plan handed in is not valid", problems=problems)
            return record.plan
        return (await self.plan_only(PlanAsk(instruction=record.instruction))).plan

    async def plan_only(self, ask: PlanAsk) -> PlanAnswer:
        """Decompose an instruction against the present roster and site; run nothing."""
        instruction = self._check(TaskRequest(instruction=ask.instruction)).instruction
        robots = tuple(sorted(self.plane.registry.robots.values(), key=lambda robot: robot.id))
        outcome = await self._decomposer.plan(PlanContext(instruction=instruction, robots=robots, site=self._site))
        return PlanAnswer(plan=outcome.plan, attempts=outcome.attempts)

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

    # --- questions --------------------------------------------------------------------------------------------

    async def task(self, ask: TaskAsk) -> TaskRecord:
        """Return a task's record; NotFoundError when there is none."""
        if driver := self._drivers.get(ask.id):
            return driver.told
        stored = await self.plane.dht.read(task_key(check_name(ask.id, "task")))
        if stored is None or stored.deleted:
            raise NotFoundError(f"there is no task {ask.id}", remedy="see `swiftbot task list`")
        return read_record(stored.value)

    async def why(self, ask: WhyAsk) -> TaskWhy:
        """Tell why a task waits, or was served where it was; its coordinator knows what is in no record."""
        if driver := self._drivers.get(ask.id):
            return await explain(
                driver.record,
                ask.subtask,
                plane=self.plane,
                scheduler=self.scheduler,
                durations=self._ahead.durations,
                elapsed_s=driver.elapsed_s,
            )
        record = await self.task(TaskAsk(id=ask.id))
        owner = self.plane.ring.owner(task_key(ask.id))
        if not (record.state.final or ask.here or owner == self.plane.gateway):
            return await self.plane.rpc.call(owner, "why", replace(ask, here=True), TaskWhy)
        return why(record, ask.subtask)

    async def tasks(self, ask: TasksAsk) -> TaskList:
        """Return the newest tasks, of the whole fleet or of this gateway's shard."""
        return await newest_tasks(self.plane, ask, [driver.record for driver in self._drivers.values()])

    async def cancel(self, ask: TaskAsk) -> TaskRecord:
        """Stop a task wherever it is coordinated; returns its record at that moment."""
        if ask.id in self._drivers:
            return await self.cancel_here(ask)
        record = await self.task(ask)
        if record.state.final:
            return record
        owner = await self.plane.owner_of(task_key(ask.id))
        if owner == self.plane.gateway:
            self._sweep.set()
            return await self.cancel_here(ask)
        return await self.plane.rpc.call(owner, "cancel_here", ask, TaskRecord)

    async def cancel_here(self, ask: TaskAsk) -> TaskRecord:
        """Stop a task that is coordinated here; waits a moment for a driver that is being set up."""
        for _ in range(20):
            if driver := self._drivers.get(ask.id):
                driver.tell(CancelAsked())
                return driver.record
            record = await self.task(ask)
            if record.state.final:
                return record
            await asyncio.sleep(0.1)
        raise UnreachableError(f"nobody coordinates task {ask.id} just now", remedy="try again in a second")
