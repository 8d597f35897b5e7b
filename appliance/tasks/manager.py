"""The task manager of one gateway: accepts tasks, drives those whose key it owns, answers for them over RPC.

A task belongs to the gateway that owns `task/{id}` on the ring. Submissions are handed there, and acknowledged
when the record is durable on it and on its replicas. When the ring changes, every gateway looks through its
shard: an unfinished task whose key it now owns gets a driver here, one that it owns no longer loses it. That is
all there is to takeover: a dead coordinator's tasks are driven by the next owner from the replicated record.
"""

import asyncio
import time
from collections.abc import Callable, Mapping

import structlog
from msgspec.structs import replace

from appliance.errors import (
    ConflictError,
    DeadlineError,
    NotFoundError,
    UnreachableError,
)
from appliance.llm.cascade import Decomposer
from appliance.model import (
    Group,
    Plan,
    RunAccepted,
    RunEvent,
    RunRequest,
    Site,
    SubtaskRecord,
    TaskRecord,
    TaskRequest,
    encode,
)
from appliance.plane.keys import run_of
from appliance.plane.node import Plane
from appliance.skills.catalogue import Catalogue, SkillManifest
from appliance.tasks import machine, resolve
from appliance.tasks.admission import Admission, checked, expectation, longest_s, refuse_stop
from appliance.tasks.api import (
    ExperienceAsk,
    PlanAsk,
    SkillsAsk,
    TaskAsk,
    TasksAsk,
    WhyAsk,
)
from appliance.tasks.bounds import clean
from appliance.tasks.checkpoints import Checkpoint, read_checkpoint, remove_checkpoint
from appliance.tasks.deadline import Ages
from appliance.tasks.driver import Driver
from appliance.tasks.driving import Driving
from appliance.tasks.executor import Executor
from appliance.tasks.line import Place
from appliance.tasks.lookahead import LookAhead
from appliance.tasks.machine import Transition, TransitionKind
from appliance.tasks.placement import Placement
from appliance.tasks.plans import Plans
from appliance.tasks.questions import Questions
from appliance.tasks.recovery import Recovery
from appliance.tasks.remembering import answered
from appliance.tasks.scheduling import Scheduler
from appliance.tasks.settings import TasksConfig
from appliance.tasks.steering.api import CancelTaskAsk, PlanCheckAsk
from appliance.tasks.steering.audit import Audit
from appliance.tasks.steering.verbs import OperatorVerbs
from appliance.tasks.surroundings import FREE, Commands, GatewayLost, RunNews, Wake, task_key

log = structlog.get_logger(__name__)


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
        self.plane.dht.resolver = resolve.resolver
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
