"""The task manager of one gateway: accepts tasks, drives those whose key it owns, answers for them over RPC.

A task belongs to the gateway that owns `task/{id}` on the ring. Submissions are handed there, and acknowledged
when the record is durable on it and on its replicas. When the ring changes, every gateway looks through its
shard: an unfinished task whose key it now owns gets a driver here, one that it owns no longer loses it. That is
all there is to takeover: a dead coordinator's tasks are driven by the next owner from the replicated record.
"""

import asyncio
import contextlib
import time
import uuid
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
    RefusedError,
    SwiftbotError,
    UnreachableError,
)
from appliance.llm.cascade import Decomposer
from appliance.llm.settings import PlanContext
from appliance.llm.validate import validate
from appliance.model import (
    HIGHEST_PRIORITY,
    LONGEST_DEADLINE_S,
    PLAIN_PRIORITY,
    Failure,
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
from appliance.tasks.agreeing import Agreeing
from appliance.tasks.api import PlanAnswer, PlanAsk, TaskAsk, TaskList, TasksAsk
from appliance.tasks.bounds import MAX_DEPTH, MAX_TEXT, clean, read_record, too_deep
from appliance.tasks.checkpoints import Checkpoint, read_checkpoint, remove_checkpoint
from appliance.tasks.driver import Driver
from appliance.tasks.executor import Executor
from appliance.tasks.healing import heal, unheard
from appliance.tasks.keeper import Keeper
from appliance.tasks.listing import newest_tasks
from appliance.tasks.lookahead import LookAhead
from appliance.tasks.machine import Transition, TransitionKind
from appliance.tasks.placement import Placement, bind, holds, place
from appliance.tasks.recovery import Recovery
from appliance.tasks.settings import TasksConfig
from appliance.tasks.surroundings import CancelAsked, GatewayLost, RunNews, Wake, need_of, task_key

log = structlog.get_logger(__name__)

SWEEP_S = 15.0
"""How often the shard is looked through when the ring stands still."""
MAX_BREAKS = 6
"""Drivers of one task that may break before it is ended with the reason; with the pauses, half a minute."""
AGAIN_S = (0.5, 1.5, 4.0)
"""When the shard is looked through again after the ring has changed."""
MAX_SUBMITTER = 120


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
        self._ahead = LookAhead(plane, manifest=self.manifest, likely_place=self._likely_place, tell_here=executor.hint)
        self.recovery = Recovery(
            plane,
            catalogue=catalogue,
            decomposer=decomposer,
            site=site,
            durations=self._ahead.durations,
            busy=self._busy_robots,
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
        Agreeing(self.plane, self._drivers, self.task).register()
        news = self.plane.session.subscribe_typed(self.plane.keys.run(), RunEvent, self._on_run_event)
        self._closers.append(news.close)
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

    # --- submission -----------------------------------------------------------------------------------------

    async def submit(self, request: TaskRequest) -> TaskRecord:
        """Accept a task wherever its key belongs; durable when this returns.

        A request with an `id` that is known is the same task: its record is returned.

        Raises:
            PayloadError: empty or oversize instruction, bad id.
            RefusedError: the coordinator is full.
            UnreachableError: no owner could be reached within the time allowed.
        """
        request = self._checked(request)
        until = time.monotonic() + 5.0
        while True:
            owner = self.plane.ring.owner(task_key(request.id))
            if owner == self.plane.gateway:
                return await self.accept(request)
            try:
                return await self.plane.rpc.call(owner, "accept", request, TaskRecord, timeout_s=2.0)
            except (UnreachableError, DeadlineError) as error:
                # The owner died: its tokens go within a second, then the ring names its successor.
                if time.monotonic() > until:
                    raise
                log.info("owner did not answer, asking again", owner=owner, reason=str(error))
                await asyncio.sleep(0.1)

    def _checked(self, request: TaskRequest) -> TaskRequest:
        instruction = request.instruction.strip()
        if not instruction:
            raise PayloadError("the instruction is empty", remedy="say what is to be done")
        if len(instruction) > self.config.max_instruction_chars:
            raise PayloadError(
                f"the instruction has {len(instruction):,} characters, more than {self.config.max_instruction_chars:,}",
                remedy="split it, or raise tasks.max_instruction_chars",
            )
        if len(request.submitter) > MAX_SUBMITTER:
            raise PayloadError(f"the submitter's name has more than {MAX_SUBMITTER} characters")
        if request.plan is not None and any(too_deep(each.params) for each in request.plan.subtasks):
            raise PayloadError(f"parameters are nested more than {MAX_DEPTH} deep", remedy="write them flat")
        if not 0 <= request.priority <= HIGHEST_PRIORITY:
            raise PayloadError(
                f"priority {request.priority} is none", remedy=f"0 to {HIGHEST_PRIORITY}, {PLAIN_PRIORITY} is plain"
            )
        if not 0 <= request.deadline_s <= LONGEST_DEADLINE_S:  # false for what is not a number
            raise PayloadError(
                f"a deadline of {request.deadline_s:g} s is none",
                remedy=f"seconds from now, up to {LONGEST_DEADLINE_S:g}; 0 for none",
            )
        for name in request.group:
            check_name(name, "gateway")
        task = request.id or f"t-{uuid.uuid4().hex[:10]}"
        return replace(request, instruction=instruction, id=check_name(task, "task"))

    async def accept(self, request: TaskRequest) -> TaskRecord:
        """Write the record, here and on the replicas, then drive it."""
        request = self._checked(request)
        if len(self._drivers) >= self.config.max_tasks:
            raise RefusedError(
                f"{self.plane.gateway} already coordinates {len(self._drivers)} unfinished tasks",
                remedy="wait for some to end, or cancel some",
            )
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

    def _drive(self, record: TaskRecord, version: VersionVector) -> None:
        if record.id in self._drivers or self._stopping:
            return
        give_up = self._why.get(record.id) if self._breaks[record.id] >= MAX_BREAKS else None
        driver = Driver(self, record, version, on_change=lambda _: self.on_change(), give_up=give_up)
        self._drivers[record.id] = driver
        task = asyncio.create_task(driver.run(), name=f"drive {record.id}")
        self._driving[record.id] = task
        task.add_done_callback(lambda done: self._driven(driver, done))
        self.on_change()

    def _driven(self, driver: Driver, done: asyncio.Task[None]) -> None:
        self._drivers.pop(driver.record.id, None)
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
            if record.state.final:
                final[stored.key] = stored.version
                self._heal_ended(record, stored.version)
            elif record.id not in self._drivers:
                self._drive(record, stored.version)
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

    def _on_fact(self, kind: str) -> None:
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
        instruction = self._checked(TaskRequest(instruction=ask.instruction)).instruction
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
        skills = self._catalogue.skills
        manifests = {
            each.subtask.id: skills[each.subtask.skill] for each in record.subtasks if each.subtask.skill in skills
        }
        return bind(
            target.subtask.robot or "",
            record.subtasks,
            robots=self.plane.registry.robots,
            uses={key: manifest.uses for key, manifest in manifests.items()},
            verbs={key: manifest.verbs for key, manifest in manifests.items()},
            busy=self._busy_robots(),
        )

    def _busy_robots(self) -> frozenset[str]:
        return frozenset(
            each.bound_robot
            for driver in self._drivers.values()
            for each in machine.active(driver.record)
            if each.bound_robot
        )

    def place(self, record: TaskRecord, target: SubtaskRecord, robot: str | None) -> Placement:
        """Order the gateways for a subtask by the coarse score."""
        registry = self.plane.registry
        need = need_of(self.manifest(target.subtask.skill))
        registry.asked(need.image)
        stale_s = {name: late_s for name in self.plane.members() if (late_s := registry.stale_s(name))}
        for name in stale_s:
            registry.doubt(name)
        return place(
            need,
            here=self.plane.gateway,
            gateways={name: status for name, status in registry.gateways.items() if name in self.plane.members()},
            containers=registry.containers,
            holds=holds(record, target, need.volumes, registry.gateways),
            robot=registry.robots.get(robot) if robot else None,
            avoid=frozenset(each.gateway for each in target.attempts if each.failure),
            config=self.config,
            stale_s=stale_s,
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

    def _likely_place(self, record: TaskRecord, target: SubtaskRecord) -> str:
        robot = self.bind(record, target)[0] if target.subtask.robot else None
        return next(iter(self.place(record, target, robot).order), "")

    def took(self, skill: str, duration_ms: float) -> None:
        """Note how long a run that succeeded took."""
        self._ahead.durations.add(skill, duration_ms / 1e3)

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
            return driver.record
        stored = await self.plane.dht.read(task_key(check_name(ask.id, "task")))
        if stored is None or stored.deleted:
            raise NotFoundError(f"there is no task {ask.id}", remedy="see `swiftbot task list`")
        return read_record(stored.value)

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
        owner = self.plane.ring.owner(task_key(ask.id))
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
