"""RPC endpoints of tasks that any gateway answers: here where the task is driven, else by asking its coordinator.

- `Questions`: a task, the newest tasks of the fleet or of one gateway's shard (what `swiftbot task list` and the
  terminal UI ask for), why a task waits, and the wish to end one.
- `explain`: why a task waits, as its coordinator knows it just now: who could serve it, who could not, and when it may
  start. What has been decided stands in the record (`why`); this adds what is in no record because it changes by the
  second.
- `OperatorVerbs`: takes operators' orders to the task's coordinator, and begins tasks again that have ended.
"""

import asyncio
import contextlib
import heapq
import time
from collections.abc import Awaitable, Callable, Iterable, Mapping
from typing import TypeVar

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from appliance.errors import ConflictError, DeadlineError, NotFoundError, PayloadError, SwiftbotError, UnreachableError
from appliance.model import SubtaskRecord, SubtaskState, TaskRecord, TaskState, VersionVector, Word, keyspace
from appliance.model.keys import Verb, check_name
from appliance.model.task_api import (
    ApproveAsk,
    CancelTaskAsk,
    CandidateWhy,
    FirstAsk,
    PauseAsk,
    RejectAsk,
    ResumeAsk,
    RetryAsk,
    RunAsk,
    RunStatus,
    TaskAsk,
    TaskList,
    TasksAsk,
    TaskWhy,
    Waits,
    WhyAsk,
)
from appliance.plane.node import Plane
from appliance.tasks import history
from appliance.tasks.audit import Audit
from appliance.tasks.coordinator import Coordinator
from appliance.tasks.durations import Durations
from appliance.tasks.events import CancelAsked, OperatorAsked
from appliance.tasks.lookahead import expected_starts
from appliance.tasks.machine import Transition, TransitionKind
from appliance.tasks.record_writer import Draft, RecordWriter, SupersededError
from appliance.tasks.records import PREFIX, read_record, task_key, unknown
from appliance.tasks.retention import TRIMMED
from appliance.tasks.scheduler import Scheduler
from appliance.tasks.steering import may_move, may_pause, may_resume, may_retry, proposal_for, revived
from appliance.tasks.timing import left_s
from appliance.tasks.views import WAITS, why, with_waits

ANSWER_S = 2.0
READ_AT_ONCE = 200
"""Records that are decoded before others have their turn."""


class _Head(Struct):
    """The part of a record that tells its place in the order."""

    id: str
    created_ns: int = 0


async def newest_tasks(plane: Plane, ask: TasksAsk, driven: Iterable[TaskRecord]) -> TaskList:
    """Return the newest tasks; gateways that do not answer in time are named.

    Args:
        plane: the fleet.
        ask: how many, and whether of this gateway's shard alone.
        driven: records of tasks that are driven here, which may be newer than those written.
    """
    heads: list[tuple[history.Place, bytes]] = []
    found: dict[str, TaskRecord] = {}
    filtered = history.is_filtered(ask)
    # Without what is only remembered, unless it is asked for: there is too much of it to be read each time.
    for number, stored in enumerate(await plane.dht.local(PREFIX, leave_out=None if ask.remembered else TRIMMED)):
        if number % READ_AT_ONCE == READ_AT_ONCE - 1:
            await asyncio.sleep(0)
        # A filter looks at what the owner has: by an older copy a task may match that does not any more.
        if stored.deleted or (filtered and not plane.dht.owns(stored.key)):
            continue
        if not filtered:  # ten thousand may wait: only those that are answered are decoded whole
            with contextlib.suppress(msgspec.DecodeError, UnicodeDecodeError, RecursionError):
                head = msgspec.json.decode(stored.value, type=_Head)
                heads.append(((head.created_ns, head.id), stored.value))
            continue
        with contextlib.suppress(PayloadError):
            record = read_record(stored.value)
            found[record.id] = record
    for _, value in heapq.nlargest(max(0, ask.limit) + 1, heads):
        with contextlib.suppress(PayloadError):
            record = read_record(value)
            found[record.id] = record
    found.update({record.id: record for record in driven})
    most_bytes = plane.config.max_payload_bytes // 2
    own = history.newest(found.values(), ask, most_bytes=most_bytes)
    if ask.local:
        return own
    unreachable: list[str] = []
    lists = [own]
    others = sorted(plane.members() - {plane.gateway})
    here = replace(ask, local=True)
    answers = await asyncio.gather(
        *(plane.rpc.call(other, keyspace.TASKS, here, timeout_s=ANSWER_S) for other in others),
        return_exceptions=True,
    )
    for other, answer in zip(others, answers, strict=True):
        if isinstance(answer, TaskList):
            lists.append(answer)
        elif isinstance(answer, SwiftbotError):
            unreachable.append(other)
        else:
            raise answer
    merged, more = history.together(lists)
    whole = history.newest(merged.values(), ask, most_bytes=most_bytes)
    return replace(whole, unreachable=tuple(unreachable), more=more or whole.more)


STATUS_S = 1.0
MOST_ASKED = 32
"""Runs of one task whose gateways are asked where they stand."""


async def explain(
    record: TaskRecord,
    subtask: str,
    *,
    plane: Plane,
    scheduler: Scheduler,
    durations: Durations,
    elapsed_s: float,
) -> TaskWhy:
    """Return the reasons of a task that is coordinated here, or of one of its subtasks.

    Args:
        record: the task.
        subtask: the one of interest; "" for all.
        plane: the fleet.
        scheduler: where its subtasks go.
        durations: how long subtasks take.
        elapsed_s: since it was accepted.

    Raises:
        NotFoundError: the plan has no such subtask.
    """
    found = why(record, subtask)
    seconds = {each.subtask.id: durations.of(each.subtask.skill, each.subtask.params) for each in record.subtasks}
    starts = expected_starts(record, seconds, {})
    chosen = [each for each in record.subtasks if subtask in ("", each.subtask.id) and not each.state.final]
    sent = [each for each in chosen if each.state is SubtaskState.DISPATCHED][:MOST_ASKED]
    answers = await asyncio.gather(*(_status(plane, record, each) for each in sent))
    statuses = {each.subtask.id: answer for each, answer in zip(sent, answers, strict=True)}
    waits = {each.subtask.id: _waits(record, each, scheduler, statuses, starts) for each in chosen}
    left = left_s(record, elapsed_s)
    return with_waits(found, waits, left_s=None if record.deadline_s == 0 else round(left, 1))


def _waits(
    record: TaskRecord,
    target: SubtaskRecord,
    scheduler: Scheduler,
    statuses: Mapping[str, RunStatus | None],
    starts: Mapping[str, float],
) -> Waits:
    name = target.subtask.id
    match target.state:
        case SubtaskState.RUNNING:
            held = target.note.startswith(WAITS)
            return Waits(reason=target.note.removeprefix(WAITS) if held else "nothing: it runs")
        case SubtaskState.WAITING:
            open_ones = [each for each in target.subtask.after if not record.of(each).state.final]
            return Waits(reason=f"comes after {', '.join(open_ones)}", expected_s=_rounded(starts.get(name)))
        case SubtaskState.DISPATCHED:
            status = statuses.get(name)
            if status is None or not status.position:
                return Waits(reason=f"{target.gateway} has it, and has not told of its first line", at=target.gateway)
            return Waits(
                reason=f"a container of {target.gateway}",
                at=target.gateway,
                position=status.position,
                waiting=status.queue,
                expected_s=_rounded(status.expected_s),
            )
        case _:
            pass
    if record.paused:
        return Waits(reason=record.paused)
    place = scheduler.line.place_of((record.id, name), time.monotonic())
    robots, reason = scheduler.bind(record, target) if target.subtask.robot else ((), "")
    try:
        placement = scheduler.place(record, target, next(iter(robots), None))
    except NotFoundError as error:
        return Waits(reason=error.message)
    candidates = [CandidateWhy(gateway=each, score=placement.scores.get(each)) for each in placement.order]
    candidates += [CandidateWhy(gateway=each, excluded=text) for each, text in placement.excluded.items()]
    if place.position:
        reason = f"room at {', '.join(placement.order)}"
    elif robots or not reason:
        reason = target.note or "nothing: it is being sent"
    return Waits(
        reason=reason.removeprefix(WAITS),
        position=place.position,
        waiting=place.waiting,
        expected_s=_rounded(place.expected_s),
        candidates=tuple(candidates),
    )


def _rounded(seconds: float | None) -> float | None:
    return None if seconds is None else round(seconds, 1)


async def _status(plane: Plane, record: TaskRecord, target: SubtaskRecord) -> RunStatus | None:
    ask = RunAsk(task=record.id, subtask=target.subtask.id, attempt=target.attempt)
    try:
        return await plane.rpc.call(target.gateway, keyspace.RUN_STATUS, ask, timeout_s=STATUS_S)
    except SwiftbotError:
        return None


CANCEL_S = 1.5
"""How long the answer to a cancel waits for the record that it makes: less than the asker waits for the answer."""


class Questions:
    """Answers on one gateway.

    Args:
        plane: the fleet.
        coordinators: of the tasks that are worked on here.
        scheduler: where their subtasks go.
        durations: how long subtasks take.
        sweep: set to have tasks taken up that are owned here and not known yet.
        hurry: takes a task up that waits for its turn.
        place: what a task that waits for its turn waits for, in words; "" for any other.
    """

    def __init__(
        self,
        plane: Plane,
        coordinators: Mapping[str, Coordinator],
        *,
        scheduler: Scheduler,
        durations: Durations,
        sweep: asyncio.Event,
        hurry: Callable[[str], Awaitable[None]],
        place: Callable[[str], str],
    ) -> None:
        self._plane = plane
        self._coordinators = coordinators
        self._scheduler = scheduler
        self._durations = durations
        self._sweep = sweep
        self._hurry = hurry
        self._place = place

    async def task(self, ask: TaskAsk) -> TaskRecord:
        """Return a task's record; NotFoundError when there is none.

        A coordinator's copy is the answer only where the record is this gateway's and has not changed under it: after a
        partition the other side's may stand.
        """
        coordinator = self._coordinators.get(ask.id)
        if coordinator is not None and not coordinator.overtaken and self._plane.dht.owns(task_key(ask.id)):
            return coordinator.written
        stored = await self._plane.dht.read(task_key(check_name(ask.id, "task")))
        if stored is None or stored.deleted:
            raise NotFoundError(f"there is no task {ask.id}", remedy="see `swiftbot task list`")
        return read_record(stored.value)

    async def why(self, ask: WhyAsk) -> TaskWhy:
        """Tell why a task waits, or was served where it was; its coordinator knows what is in no record."""
        if coordinator := self._coordinators.get(ask.id):
            return await explain(
                coordinator.record,
                ask.subtask,
                plane=self._plane,
                scheduler=self._scheduler,
                durations=self._durations,
                elapsed_s=coordinator.elapsed_s,
            )
        record = await self.task(TaskAsk(id=ask.id))
        owner = self._plane.ring.owner(task_key(ask.id))
        if not (record.state.final or ask.here or owner == self._plane.gateway):
            return await self._plane.rpc.call(owner, keyspace.WHY, replace(ask, here=True))
        found = why(record, ask.subtask)
        return replace(found, waits=self._place(ask.id) or found.waits)

    async def tasks(self, ask: TasksAsk) -> TaskList:
        """Return the newest tasks, of the whole fleet or of this gateway's shard."""
        return await newest_tasks(self._plane, ask, [coordinator.record for coordinator in self._coordinators.values()])

    async def cancel(self, ask: CancelTaskAsk) -> TaskRecord:
        """Stop a task wherever it is coordinated; returns the record that came of it: see `cancel_here`."""
        if ask.id in self._coordinators:
            return await self.cancel_here(ask)
        record = await self.task(TaskAsk(id=ask.id))
        if record.state.final:
            return record
        owner = await self._plane.owner_of(task_key(ask.id))
        if owner == self._plane.gateway:
            self._sweep.set()
            return await self.cancel_here(ask)
        return await self._plane.rpc.call(owner, keyspace.CANCEL_HERE, ask)

    async def cancel_here(self, ask: CancelTaskAsk) -> TaskRecord:
        """Stop a task that is coordinated here; waits a moment for a coordinator that is being set up.

        Returns the record as it is written then: cancelled, cancelling while runs are being ended, or how it had ended
        before the cancel came.

        Raises:
            UnreachableError: nobody coordinates it just now.
        """
        for _ in range(20):
            await self._hurry(ask.id)
            if coordinator := self._coordinators.get(ask.id):
                coordinator.put(CancelAsked(Word(by=ask.by, why=ask.why, act=ask.act, at_ns=time.time_ns())))
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(CANCEL_S):
                        await coordinator.ending.wait()
                record = await self.task(TaskAsk(id=ask.id))
                if not coordinator.ending.is_set() or record.state.final or record.state is TaskState.CANCELLING:
                    return record  # what is not written in time stays noted: the record says that it is not confirmed
                # It has stepped down, since the record changed under it: the next one gets it.
                self._sweep.set()
            else:
                record = await self.task(TaskAsk(id=ask.id))
            if record.state.final:
                return record
            await asyncio.sleep(0.1)
        raise UnreachableError(f"nobody coordinates task {ask.id} just now", remedy="try again in a second")


STEER_S = 4.0
"""How long an order may take to be written: a replicated write takes milliseconds, an inbox that is full a second."""
TRIES = 20

Ask = ApproveAsk | RejectAsk | PauseAsk | ResumeAsk | RetryAsk | FirstAsk
A = TypeVar("A", ApproveAsk, RejectAsk, PauseAsk, ResumeAsk, RetryAsk, FirstAsk)


class OperatorVerbs:
    """The verbs `approve`, `reject`, `pause`, `resume`, `retry` and `first` of one gateway.

    Args:
        plane: the fleet.
        coordinators: of the tasks that are coordinated here.
        task: returns a task's record.
        drive: begins to drive a record at a version, as it is stored.
        hurry: takes a task up that waits for its turn.
        published: hears of each transition that is published.
        audit: of this gateway.
    """

    def __init__(
        self,
        plane: Plane,
        coordinators: Mapping[str, Coordinator],
        *,
        task: Callable[[TaskAsk], Awaitable[TaskRecord]],
        drive: Callable[[TaskRecord, VersionVector, bytes], None],
        hurry: Callable[[str], Awaitable[None]],
        published: Callable[[Transition], None],
        audit: Audit,
    ) -> None:
        self._plane = plane
        self._coordinators = coordinators
        self._task = task
        self._drive = drive
        self._hurry = hurry
        self._published = published
        self._audit = audit

    def register(self) -> None:
        """Answer RPC."""
        rpc, audit = self._plane.rpc, self._audit
        rpc.register(keyspace.APPROVE, audit.signed("approve", self.approve))
        rpc.register(keyspace.REJECT, audit.signed("reject", self.reject))
        rpc.register(keyspace.PAUSE, audit.signed("pause", self.pause))
        rpc.register(keyspace.RESUME, audit.signed("resume", self.resume))
        rpc.register(keyspace.RETRY, audit.signed("retry", self.retry))
        rpc.register(keyspace.FIRST, audit.signed("first", self.first))
        rpc.register(keyspace.ACTS, audit.acts)

    async def approve(self, ask: ApproveAsk) -> TaskRecord:
        """Answer `approve`. Errors as `deciding.proposal_for`; PlanError for an edited plan that is not valid."""
        return await self._steer(keyspace.APPROVE, ask)

    async def reject(self, ask: RejectAsk) -> TaskRecord:
        """Answer `reject`. Errors as `deciding.proposal_for`."""
        return await self._steer(keyspace.REJECT, ask)

    async def pause(self, ask: PauseAsk) -> TaskRecord:
        """Answer `pause`. Errors as `deciding.may_pause`."""
        return await self._steer(keyspace.PAUSE, ask)

    async def resume(self, ask: ResumeAsk) -> TaskRecord:
        """Answer `resume`. Errors as `deciding.may_resume`."""
        return await self._steer(keyspace.RESUME, ask)

    async def retry(self, ask: RetryAsk) -> TaskRecord:
        """Answer `retry`. Errors as `deciding.may_retry`."""
        return await self._steer(keyspace.RETRY, ask)

    async def first(self, ask: FirstAsk) -> TaskRecord:
        """Answer `first`. Errors as `deciding.may_move` and `turns.moved_before`."""
        return await self._steer(keyspace.FIRST, ask)

    async def _steer(self, verb: Verb[A, TaskRecord], ask: A) -> TaskRecord:
        if ask.here or ask.id in self._coordinators:
            return await self._here(ask)
        if not is_wanted(await self._task(TaskAsk(id=ask.id)), ask):
            return await self._task(TaskAsk(id=ask.id))
        owner = await self._plane.owner_of(task_key(ask.id))
        if owner == self._plane.gateway:
            return await self._here(ask)
        return await self._plane.rpc.call(owner, verb, replace(ask, here=True), timeout_s=STEER_S + 1.0)

    async def _here(self, ask: Ask) -> TaskRecord:
        """Hand it to the task's coordinator; waits a moment for one that is being set up."""
        for _ in range(TRIES):
            await self._hurry(ask.id)
            if coordinator := self._coordinators.get(ask.id):
                outcome: asyncio.Future[TaskRecord] = asyncio.get_running_loop().create_future()
                coordinator.put(OperatorAsked(ask=ask, outcome=outcome))
                try:
                    async with asyncio.timeout(STEER_S):
                        return await outcome
                except TimeoutError:
                    raise DeadlineError(f"task {ask.id} did not take it in time", remedy="ask again") from None
            record = await self._task(TaskAsk(id=ask.id))
            if record.state.final:
                if isinstance(ask, RetryAsk):
                    return await self._begin_again(ask)
                if not is_wanted(record, ask):
                    return record
            await asyncio.sleep(0.1)
        raise UnreachableError(f"nobody coordinates task {ask.id} just now", remedy="try again in a second")

    async def _begin_again(self, ask: RetryAsk) -> TaskRecord:
        """Write that a task that has ended goes on, under compare-and-set, and drive it."""
        key = task_key(ask.id)
        stored = await self._plane.dht.read(key)
        if stored is None or stored.deleted:
            raise NotFoundError(f"there is no task {ask.id}", remedy="see `swiftbot task list`")
        record = read_record(stored.value)
        fields = revived(record, ask, elapsed_s=record.elapsed_s)
        if fields is None:
            return record
        draft = Draft(record, self._plane.gateway)
        writer = RecordWriter(
            self._plane, draft, stored.version, unknown=unknown(stored.value), on_published=self._published
        )
        draft.apply(TransitionKind.RETRIED, **fields)
        try:
            await writer.flush()
        except SupersededError:
            now = await self._task(TaskAsk(id=ask.id))
            who = now.retried_by.by if now.retried_by is not None else "somebody else"
            raise ConflictError(f"{who} has had task {ask.id} tried again already") from None
        self._drive(draft.record, writer.version, writer.value)
        return draft.record


def is_wanted(record: TaskRecord, ask: Ask) -> bool:
    """Whether an order has anything to do by a record; False when it was done, errors where it cannot be."""
    match ask:
        case ApproveAsk() | RejectAsk():
            return proposal_for(record, ask) is not None
        case PauseAsk():
            return may_pause(record, ask)
        case ResumeAsk():
            return may_resume(record, ask)
        case RetryAsk():
            return may_retry(record, ask)
        case FirstAsk():
            return may_move(record, ask)
