"""Schedules and saved instructions on one gateway: submits what is due, answers for both.

The owner of a schedule's record submits its tasks; when it goes, the next owner goes on from what the record says is
handled. A task is submitted first and noted in the record then: between the two another owner may submit it again,
which is the same task, since its id is made of schedule and time. Whether something is due is decided in `due`.
"""

import asyncio
import contextlib
import time
from collections.abc import Awaitable, Callable
from typing import TypeVar, get_args

import structlog
from msgspec import Struct
from msgspec.structs import replace

from appliance.alerts.rules import Finding
from appliance.errors import (
    ConflictError,
    DeadlineError,
    NotFoundError,
    PayloadError,
    RefusedError,
    SwiftbotError,
    UnreachableError,
)
from appliance.model import TaskRecord, TaskRequest, VersionVector, Word, encode, keyspace
from appliance.model.alerts import AlertLevel, Subject
from appliance.model.keys import Verb
from appliance.model.schedules import (
    InstructionList,
    InstructionRemove,
    InstructionsAsk,
    InstructionSave,
    SavedInstruction,
    Schedule,
    ScheduleAdd,
    ScheduleList,
    SchedulesAsk,
    ScheduleShown,
    ScheduleSteer,
)
from appliance.model.task_api import TaskAsk
from appliance.plane.events import FleetEvent, Joined, Lost, RingChanged, Stage
from appliance.plane.node import Plane
from appliance.plane.records import Record
from appliance.schedules import due, instructions, records
from appliance.tasks.audit import Audit

log = structlog.get_logger(__name__)

LOOK_S = 5.0
"""How often schedules are looked at in any case: a clock may be set, and news be lost."""
SOON_S = 0.05
AGAIN_S = 1.0
"""Pause before a task that could not be submitted is tried again."""
ANSWER_S = 2.0
MOST_SCHEDULES = 500
"""Of a fleet, as far as one gateway's shard shows; so many saved instructions too."""
NEXT_TIMES = 5

A = TypeVar("A", SchedulesAsk, InstructionsAsk)
R = TypeVar("R", ScheduleList, InstructionList)
T = TypeVar("T", bound=Struct)


class ScheduleManager:
    """Submits the tasks of schedules whose records this gateway owns, and answers for schedules.

    Args:
        plane: the fleet.
        submit: submits a task wherever it belongs; the same id again is the same task.
        task: returns a task's record; NotFoundError where there is none.
        check: RefusedError for an instruction that no schedule may have, such as a stop.
        report: tells operators of something that has happened.
        now_ns: the wall clock, Unix nanoseconds.
    """

    def __init__(
        self,
        plane: Plane,
        *,
        submit: Callable[[TaskRequest], Awaitable[TaskRecord]],
        task: Callable[[TaskAsk], Awaitable[TaskRecord]],
        check: Callable[[TaskRequest], None],
        report: Callable[[Finding], None],
        now_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._plane = plane
        self._submit = submit
        self._task = task
        self._check = check
        self._report = report
        self._now_ns = now_ns
        self._failed: dict[str, str] = {}
        """Why the task of a schedule that is due could not be submitted so far."""
        self._changed = asyncio.Event()
        self._closers: list[Callable[[], None]] = []
        self._work: asyncio.Task[None] | None = None

    def start(self, audit: Audit) -> None:
        """Answer, and begin to submit what is due."""
        rpc = self._plane.rpc
        rpc.register(keyspace.SCHEDULE_ADD, audit.signed("schedule_add", self.add))
        steering = {do: audit.signed(f"schedule_{do}", self.steer) for do in get_args(_DO)}

        async def steer(ask: ScheduleSteer) -> Schedule:
            return await steering[ask.do](ask)

        rpc.register(keyspace.SCHEDULE_STEER, steer)
        rpc.register(keyspace.SCHEDULES, self.schedules)
        rpc.register(keyspace.INSTRUCTION_SAVE, audit.signed("instruction_save", self.save))
        rpc.register(keyspace.INSTRUCTION_REMOVE, audit.signed("instruction_remove", self.remove))
        rpc.register(keyspace.INSTRUCTIONS, self.saved)
        watched = self._plane.dht.watch(lambda key: key.startswith(records.SCHEDULES), lambda _: self._changed.set())
        self._closers = [watched, self._plane.events.subscribe(Stage.TASKS, self._on_event)]
        self._work = asyncio.create_task(self._keep(), name="schedules")

    async def stop(self) -> None:
        """Submit nothing more; the records stay, and their next owner goes on."""
        for close in self._closers:
            close()
        if self._work is not None:
            self._work.cancel()
            await asyncio.gather(self._work, return_exceptions=True)

    def _on_event(self, event: FleetEvent) -> None:
        if isinstance(event, Joined | Lost | RingChanged):
            self._changed.set()

    # --- submitting what is due ----------------------------------------------------------------------------------

    async def _keep(self) -> None:
        pause_s = SOON_S
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(pause_s):
                    await self._changed.wait()
            self._changed.clear()
            pause_s = LOOK_S
            try:
                pause_s = await self.look()
            except SwiftbotError as error:
                log.warning("schedules are looked at again", reason=str(error))
            except Exception:  # supervision boundary: schedules must go on
                log.exception("schedules could not be looked at")
            await asyncio.sleep(SOON_S)

    async def look(self) -> float:
        """Submit what is due of the schedules that are this gateway's; returns seconds until the next look."""
        wait_s = LOOK_S
        seen: set[str] = set()
        removed: list[tuple[int, Record]] = []
        for stored in await self._plane.dht.local(records.SCHEDULES):
            if stored.deleted or not self._plane.dht.owns(stored.key):
                continue
            try:
                schedule = records.read(stored.value, Schedule)
                if schedule.removed is not None:
                    removed.append((schedule.removed.at_ns, stored))
                    continue
                due.sound(schedule.spec)
            except PayloadError as error:
                self._plane.session.refuse("unsound schedule record", key=stored.key, reason=error.message)
                continue
            seen.add(schedule.id)
            try:
                wait_s = min(wait_s, await self._handle(schedule, stored.version))
            except ConflictError:
                self._changed.set()  # an operator changed it meanwhile
            except SwiftbotError as error:
                log.warning("a schedule is handled again", schedule=schedule.id, reason=str(error))
                wait_s = min(wait_s, AGAIN_S)
        self._failed = {name: why for name, why in self._failed.items() if name in seen}
        await self._forget(removed)
        return wait_s

    async def _forget(self, removed: list[tuple[int, Record]]) -> None:
        """Remove the records of schedules that were removed long ago, or are too many."""
        before_ns = self._now_ns() - int(records.KEEP_REMOVED_S * 1e9)
        newest_first = sorted(removed, key=lambda each: each[0], reverse=True)
        for number, (at_ns, stored) in enumerate(newest_first):
            if number >= records.MOST_REMOVED or at_ns < before_ns:
                with contextlib.suppress(SwiftbotError):  # at the next look again
                    await self._plane.dht.remove(stored.key, expected=stored.version)

    async def _handle(self, schedule: Schedule, version: VersionVector) -> float:
        """Carry out what is to be done about one; returns seconds until it is due again."""
        now_ns = self._now_ns()
        found = due.step(schedule, now_ns, failed=self._failed.get(schedule.id, ""))
        if found.handled_ns and schedule.task and schedule.spec.overlap == "skip" and await self._runs(schedule.task):
            found = due.step(schedule, now_ns, busy=schedule.task)
        if not found.handled_ns:
            return max(0.0, (found.next_ns - now_ns) / 1e9) if found.next_ns else LOOK_S
        changed = replace(schedule, handled_ns=max(found.handled_ns, schedule.handled_ns))
        if found.missed:
            changed = replace(changed, missed=schedule.missed + found.missed, missed_ns=found.missed_ns,
                              missed_why=found.missed_why)  # fmt: skip
            self._report(missed(changed, found))
        if found.fire_ns:
            record = await self._submitted(schedule, found)
            if record is None:
                return AGAIN_S
            changed = replace(changed, fired=schedule.fired + 1, fired_ns=found.fire_ns, task=record.id)
            log.info("task of a schedule submitted", schedule=schedule.id, task=record.id, late=found.late)
        await self._plane.dht.write(records.schedule_key(schedule.id), encode(changed), expected=version)
        self._failed.pop(schedule.id, None)
        return SOON_S

    async def _submitted(self, schedule: Schedule, found: due.Step) -> TaskRecord | None:
        """Submit the task for a time; None where that is tried again."""
        spec = schedule.spec
        request = TaskRequest(
            instruction=spec.instruction, id=due.task_id(spec.id, found.fire_ns), submitter=schedule.added.by,
            priority=spec.priority, deadline_s=spec.deadline_s, group=spec.group, approval=spec.approval,
        )  # fmt: skip
        try:
            return await self._submit(request)
        except SwiftbotError as error:
            log.warning("task of a schedule not submitted", schedule=spec.id, task=request.id, reason=str(error))
            self._failed[spec.id] = error.message
            return None

    async def _runs(self, task: str) -> bool:
        """Whether a task has not ended; one whose record cannot be read counts as running."""
        try:
            return not (await self._task(TaskAsk(id=task))).state.final
        except NotFoundError:
            return False
        except (UnreachableError, DeadlineError, PayloadError):
            return True

    # --- schedules: answers ----------------------------------------------------------------------------------------

    async def add(self, ask: ScheduleAdd) -> Schedule:
        """Answer `schedule_add`; a name that is taken by the same schedule is answered with it."""
        spec = ask.spec
        key, now_ns = records.schedule_key(spec.id), self._now_ns()
        stored = await self._plane.dht.read(key)
        known = records.read(stored.value, Schedule) if stored is not None and not stored.deleted else None
        if known is not None and known.removed is None:
            if known.spec == spec:
                return known
            raise RefusedError(f"there is a schedule {spec.id}", remedy="give another name, or remove it first")
        due.check(spec, now_ns=now_ns)
        self._check(TaskRequest(instruction=spec.instruction, id=due.task_id(spec.id, now_ns), group=spec.group))
        if await self._count() >= MOST_SCHEDULES:
            raise RefusedError(f"there are {MOST_SCHEDULES} schedules already", remedy="remove some of them")
        edited_ns = max(now_ns, known.edited_ns + 1) if known is not None else now_ns
        schedule = Schedule(spec=spec, added=self._word(ask, now_ns), edited_ns=edited_ns, handled_ns=now_ns)
        try:
            expected = stored.version if stored is not None else None
            await self._plane.dht.write(key, encode(schedule), expected=expected)
        except ConflictError as error:
            raise RefusedError(f"there is a schedule {spec.id}", remedy="give another name") from error
        self._changed.set()
        return schedule

    async def steer(self, ask: ScheduleSteer) -> Schedule:
        """Answer `schedule_steer`: with the schedule as it is, or was."""
        key = records.schedule_key(ask.id)
        while True:
            stored = await self._plane.dht.read(key)
            if stored is None or stored.deleted:
                raise records.no_schedule(ask.id)
            schedule = records.read(stored.value, Schedule)
            if schedule.removed is not None:
                raise records.no_schedule(ask.id)
            changed = steered(schedule, ask, self._word(ask, self._now_ns()))
            try:
                if changed != schedule:
                    await self._plane.dht.write(key, encode(changed), expected=stored.version)
            except ConflictError:
                continue
            self._changed.set()
            return schedule if ask.do == "remove" else changed

    async def _count(self) -> int:
        """Return how many schedules this gateway's shard has, those apart that were removed."""
        found = 0
        for stored in await self._plane.dht.local(records.SCHEDULES):
            with contextlib.suppress(PayloadError):
                found += records.read(stored.value, Schedule).removed is None
        return found

    async def schedules(self, ask: SchedulesAsk) -> ScheduleList:
        """Answer `schedules`: of this gateway's shard, and of all others where the whole is asked for."""
        now_ns = self._now_ns()
        own: list[ScheduleShown] = []
        for each in await self._owned(records.SCHEDULES, Schedule):
            with contextlib.suppress(PayloadError):  # counted where it is looked at for what is due
                if each.removed is None:
                    due.sound(each.spec)
                    own.append(self._shown(each, now_ns))
        lists, silent = await self._of_all(keyspace.SCHEDULES, ask, SchedulesAsk(local=True))
        found = {each.schedule.id: each for each in own}
        found |= {each.schedule.id: each for answer in lists for each in answer.schedules}
        return ScheduleList(schedules=tuple(found[name] for name in sorted(found)), unreachable=silent)

    def _shown(self, schedule: Schedule, now_ns: int) -> ScheduleShown:
        after_ns = max(now_ns, schedule.handled_ns)
        times = due.upcoming(schedule.spec, after_ns, since_ns=schedule.added.at_ns, count=NEXT_TIMES)
        return ScheduleShown(
            schedule=schedule, next_ns=() if schedule.paused is not None else times, owner=self._plane.gateway
        )

    # --- saved instructions: answers -------------------------------------------------------------------------------

    async def save(self, ask: InstructionSave) -> SavedInstruction:
        """Answer `instruction_save`."""
        key = records.instruction_key(ask.id)
        instructions.parameters(ask.text)
        stored = await self._plane.dht.read(key)
        taken = stored is not None and not stored.deleted
        if taken and not ask.replace:
            raise RefusedError(f"there is a saved instruction {ask.id}", remedy="give another name, or --replace")
        if not taken and len(await self._plane.dht.local(records.INSTRUCTIONS)) >= MOST_SCHEDULES:
            raise RefusedError(f"there are {MOST_SCHEDULES} saved instructions already", remedy="remove some of them")
        saved = SavedInstruction(id=ask.id, text=ask.text, about=ask.about, saved=self._word(ask, self._now_ns()))
        await self._plane.dht.write(key, encode(saved), expected=stored.version if stored is not None else None)
        return saved

    async def remove(self, ask: InstructionRemove) -> SavedInstruction:
        """Answer `instruction_remove`."""
        key = records.instruction_key(ask.id)
        stored = await self._plane.dht.read(key)
        if stored is None or stored.deleted:
            raise records.no_instruction(ask.id)
        await self._plane.dht.remove(key, expected=stored.version)
        return records.read(stored.value, SavedInstruction)

    async def saved(self, ask: InstructionsAsk) -> InstructionList:
        """Answer `instructions`: of this gateway's shard, and of all others where the whole is asked for."""
        found = {each.id: each for each in await self._owned(records.INSTRUCTIONS, SavedInstruction)}
        lists, silent = await self._of_all(keyspace.INSTRUCTIONS, ask, InstructionsAsk(local=True))
        found |= {each.id: each for answer in lists for each in answer.instructions}
        return InstructionList(instructions=tuple(found[name] for name in sorted(found)), unreachable=silent)

    # --- what both need --------------------------------------------------------------------------------------------

    @staticmethod
    def _word(ask: ScheduleAdd | ScheduleSteer | InstructionSave, now_ns: int) -> Word:
        return Word(by=ask.by or "unsigned", why=ask.why, act=ask.act, at_ns=now_ns)

    async def _owned(self, prefix: str, kind: type[T]) -> list[T]:
        found: list[T] = []
        for stored in await self._plane.dht.local(prefix):
            if not stored.deleted and self._plane.dht.owns(stored.key):
                with contextlib.suppress(PayloadError):
                    found.append(records.read(stored.value, kind))
        return found

    async def _of_all(self, verb: Verb[A, R], ask: A, local: A) -> tuple[list[R], tuple[str, ...]]:
        """Ask the other gateways, unless only this one's are asked for; also returns who did not answer."""
        if ask.local:
            return [], ()
        others = sorted(self._plane.members() - {self._plane.gateway})
        answers = await asyncio.gather(
            *(self._plane.rpc.call(other, verb, local, timeout_s=ANSWER_S) for other in others), return_exceptions=True
        )
        found: list[R] = []
        silent: list[str] = []
        for other, answer in zip(others, answers, strict=True):
            if isinstance(answer, SwiftbotError):
                silent.append(other)
            elif isinstance(answer, BaseException):
                raise answer
            else:
                found.append(answer)
        return found, tuple(silent)


_DO = ScheduleSteer.__annotations__["do"]


def steered(schedule: Schedule, ask: ScheduleSteer, word: Word) -> Schedule:
    """Return a schedule after an operator's word: what would have been due during a pause is not missed. Pure."""
    if ask.do == "remove":
        return replace(schedule, removed=word, edited_ns=word.at_ns)
    if ask.do == "pause":
        return schedule if schedule.paused is not None else replace(schedule, paused=word, edited_ns=word.at_ns)
    if schedule.paused is None:
        return schedule
    handled_ns = max(schedule.handled_ns, word.at_ns)
    return replace(schedule, paused=None, edited_ns=word.at_ns, handled_ns=handled_ns)


def missed(schedule: Schedule, found: due.Step) -> Finding:
    """Return the alert about times that were missed."""
    spec = schedule.spec
    times = "a time" if found.missed == 1 else f"{found.missed:,} times"
    late = "; the last one is submitted late" if found.late else ""
    return Finding(
        kind="schedule-missed", level=AlertLevel.WARNING, subject=Subject.SCHEDULE, name=spec.id,
        what=f"missed {times}, last {due.when(found.missed_ns, spec.zone)}: {found.missed_why}{late}",
        remedy=f"`swiftbot schedule show {spec.id}`; `swiftbot submit` runs it now", since_ns=schedule.missed_ns,
    )  # fmt: skip
