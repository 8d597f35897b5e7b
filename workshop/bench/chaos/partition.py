"""Gives orders on both sides of each partition of a chaos run, and measures when all gateways answer the same again."""

import asyncio
import random
import time
import uuid
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from msgspec import Struct, field

from appliance.errors import DeadlineError, SwiftbotError, UnreachableError
from appliance.model import Approval, LogLine, Notice, TaskRecord, TaskRequest, TaskState, keyspace
from appliance.model.task_api import ApproveAsk, CancelTaskAsk, TaskAsk
from appliance.plane.rpc import Rpc
from appliance.plane.session import Session
from workshop.bench.chaos import plan
from workshop.bench.chaos.arena import Progress
from workshop.bench.chaos.plan import Wanted
from workshop.bench.net.faults import PARTITION, Phase

SUBMIT, APPROVE, CANCEL = "submit", "approve", "cancel"
KINDS = (
    (APPROVE, ""),
    (CANCEL, ""),
    (APPROVE, CANCEL),
    (APPROVE, APPROVE),
    (CANCEL, CANCEL),
    (SUBMIT, ""),
    (SUBMIT, SUBMIT),
)
"""What one side does to a task, and the other; each also the other way round."""
MOST_EVIDENCE = 20

View = tuple[TaskState, str, str]


class Contested(Struct, frozen=True, kw_only=True):
    """A task, and what each side of the partition orders of it ("": nothing)."""

    wanted: Wanted
    orders: tuple[str, str]

    @property
    def submitted(self) -> bool:
        """Whether it is handed in during the cut instead of waiting for approval when it comes."""
        return SUBMIT in self.orders


class Given(Struct, kw_only=True):
    """An order as it was given, and what was answered."""

    task: str
    verb: str
    side: int
    by: str
    act: str
    problem: str = ""
    """Code of the error it was answered with; empty: as done."""


class Cut(Struct, kw_only=True):
    """One partition as it was."""

    seconds: float
    sides: tuple[tuple[str, ...], ...]
    tasks: int = 0
    given: list[Given] = field(default_factory=list[Given])
    met_s: float | None = None
    """From the mended link to when the last gateway saw the last of the other side; None: nobody had missed anybody."""
    agreed_s: float | None = None
    """From the mended link to when all gateways answered the same for every task; None: never."""
    apart: list[str] = field(default_factory=list[str])
    """Tasks of which they did not, and what was said."""

    @property
    def after_met_s(self) -> float | None:
        """From the moment that all saw each other to the same answers."""
        return None if self.agreed_s is None else max(0.0, self.agreed_s - (self.met_s or 0.0))


def contested(cut: int, *, rounds: int, robots: Sequence[str], seed: int) -> tuple[Contested, ...]:
    """Return the tasks of a cut, the same for the same seed: `rounds` of each kind each way round."""
    generator = random.Random(seed * 1000 + cut)  # noqa: S311 - a mixture, not secrets
    orders = [each for one, other in KINDS for each in {(one, other): None, (other, one): None}] * rounds
    generator.shuffle(orders)
    wanted = plan.tasks(len(orders), seconds=0.0, robots=robots, prefix=f"p{seed}-{cut}-", seed=seed * 1000 + cut)
    return tuple(Contested(wanted=each, orders=pair) for each, pair in zip(wanted, orders, strict=True))


def view(record: TaskRecord) -> View:
    """What of a record all gateways must answer alike, whatever a run tells meanwhile."""
    return (
        record.state,
        record.decision.act if record.decision is not None else "",
        record.cancelled_by.act if record.cancelled_by is not None else "",
    )


class Agreement:
    """When gateways that are asked again and again have come to answer the same of each task.

    An answer that differs in one round and no more is a task that moved on between two questions; one that differs
    twice running is a gateway that does not know.
    """

    def __init__(self, tasks: Sequence[str]) -> None:
        self._differs: dict[str, int] = dict.fromkeys(tasks, 2)
        self._what: dict[str, str] = dict.fromkeys(tasks, "not asked yet")
        self.at_s = 0.0
        """When the last difference was seen to be gone."""

    @property
    def apart(self) -> list[str]:
        """Tasks of which not all say the same just now, and what they say."""
        return [f"{task}: {self._what[task]}" for task, rounds in self._differs.items() if rounds]

    def heard(self, task: str, answers: Mapping[str, View | str], at_s: float) -> None:
        """Take in one round of answers (a text: the error in place of one), `at_s` after the link was mended."""
        said = Counter(answers.values())
        if len(said) == 1 and not isinstance(next(iter(said)), str):
            if self._differs[task] > 1:
                self.at_s = at_s
            self._differs[task] = 0
            return
        self._differs[task] += 1
        self._what[task] = "; ".join(
            f"{gateway} {each if isinstance(each, str) else f'{each[0]} {each[1:]}'}"
            for gateway, each in sorted(answers.items())
        )


def effective(given: Given, record: TaskRecord) -> bool:
    """Whether a record shows what an order wanted."""
    match given.verb:
        case "approve":
            return record.decision is not None and record.decision.approved
        case "cancel":
            return record.state in (TaskState.CANCELLED, TaskState.CANCELLING)
        case _:
            return True


def account(
    cuts: Sequence[Cut], records: Mapping[str, TaskRecord | None], notices: Mapping[str, str]
) -> dict[str, Any]:
    """Return what became of the orders.

    Args:
        cuts: the partitions.
        records: by task, in the end.
        notices: recipient by id of each notice that was heard.

    Returns:
        A row for each cut in `cuts`; `lost`: orders answered as done that the record does not show, `told` of them by a
        notice to their operator, and `silently` those that were not (evidence); `missing`: tasks whose submission was
        answered as done and that have no record; `apart`: differences that did not go away.
    """
    lost: list[Given] = []
    silently: list[str] = []
    missing: list[str] = []
    for given in (each for cut in cuts for each in cut.given if not each.problem):
        record = records.get(given.task)
        if record is None:
            missing.append(f"{given.task}: {given.verb} by {given.by} was answered as done, and there is no record")
        elif not effective(given, record):
            lost.append(given)
            if notices.get(f"{given.task}/healed/order-{given.act}") != given.by:
                silently.append(f"{given.verb} of {given.task} by {given.by} ({given.act}): it is {record.state}")
    return {
        "cuts": [_row(cut) for cut in cuts],
        "lost": len(lost),
        "told": len(lost) - len(silently),
        "silently": silently[:MOST_EVIDENCE],
        "missing": missing[:MOST_EVIDENCE],
        "apart": [each for cut in cuts for each in cut.apart][:MOST_EVIDENCE],
    }


def _row(cut: Cut) -> dict[str, Any]:
    return {
        "seconds": cut.seconds,
        "tasks": cut.tasks,
        "orders": [
            dict(Counter(f"{each.verb} {each.problem or 'done'}" for each in cut.given if each.side == side))
            for side in range(len(cut.sides))
        ],
        "met_s": _rounded(cut.met_s),
        "agreed_s": _rounded(cut.agreed_s),
        "agreed_after_met_s": _rounded(cut.after_met_s),
    }


def _rounded(seconds: float | None) -> float | None:
    return None if seconds is None else round(seconds, 3)


def broken(found: Mapping[str, Any], *, within_s: float) -> list[str]:
    """Say what of an account breaks the promise: the same answers within `within_s` of having met, nothing lost."""
    slow = [row for row in found["cuts"] if row["agreed_after_met_s"] is None or row["agreed_after_met_s"] > within_s]
    said = (
        [f"{len(slow)} of {len(found['cuts'])} partitions without the same answers {within_s:g} s after"]
        if slow
        else []
    )
    return said + [
        f"{len(found[kind])} {what}"
        for kind, what in (("silently", "orders lost without a notice"), ("missing", "submissions lost"))
        if found[kind]
    ]


PREPARE_S = 8.0
"""How long before a cut its tasks are handed in, so that their plans wait when it comes."""
AGREE_S = 1.0
"""How long after all gateways see each other again they may answer differently."""
WATCHED_S = 30.0
"""How long the same answers are waited for."""
QUIET_S = 2.0
"""How long gateways are asked on once all have answered the same: a difference that comes back counts."""
BETWEEN_S = 0.05
_AGAIN_S = 0.2
_ORDER_S = 3.0


class Partitions:
    """The orders of one run.

    Args:
        observer: a session linked to every gateway, whose links no partition cuts.
        gateways: all.
        planned: the run's faults; of those that are partitions.
        robots: the robots that tasks are for.
        rounds: tasks of each kind for each cut (`KINDS`).
        seed: of the tasks.
        operator: name in the observer's certificate, which is then that of all orders; empty without keys.
    """

    def __init__(
        self,
        observer: Session,
        *,
        gateways: Sequence[str],
        planned: Sequence[Phase],
        robots: Sequence[str],
        rounds: int,
        seed: int,
        operator: str = "",
    ) -> None:
        self.cuts: list[Cut] = []
        self.notices: dict[str, str] = {}
        """Recipient by id of each notice."""
        self._operator = operator
        self._gateways = tuple(gateways)
        self._phases = [each for each in planned if each.name == PARTITION]
        self._contested = [
            contested(number, rounds=rounds, robots=robots, seed=seed) for number in range(len(self._phases))
        ]
        self._begun = {each.at_s: asyncio.Event() for each in self._phases}
        self._mended = {each.at_s: asyncio.Event() for each in self._phases}
        self._mended_at: dict[float, float] = {}
        self._joined: list[float] = []
        self._accepted: set[str] = set()
        self._rpc = Rpc(observer, None)
        self._generator = random.Random(seed)  # noqa: S311 - a mixture, not secrets
        observer.subscribe_typed(keyspace.NOTICE, self._noticed)
        observer.subscribe_typed(keyspace.LOG, self._logged)

    @property
    def wanted(self) -> list[Wanted]:
        """All tasks of all cuts."""
        return [each.wanted for cut in self._contested for each in cut]

    def _noticed(self, _: str, notice: Notice | None) -> None:
        if notice is not None:
            self.notices[notice.id] = notice.to

    def _logged(self, _: str, line: LogLine | None) -> None:
        if line is not None and line.event == "gateway joined":
            self._joined.append(time.monotonic())

    def noted(self, phase: Phase) -> Callable[[], None]:
        """Hear that a fault begins; what is returned hears that it is over."""
        if phase.at_s not in self._begun:
            return lambda: None
        self._begun[phase.at_s].set()

        def over() -> None:
            self._mended_at[phase.at_s] = time.monotonic()
            self._mended[phase.at_s].set()

        return over

    async def run(self, began: float, progress: Progress) -> None:
        """Go through the partitions; `began`: when the faults' times count from, on the monotonic clock."""
        for number, phase in enumerate(self._phases):
            await asyncio.sleep(max(0.0, began + phase.at_s - PREPARE_S - time.monotonic()))
            cut = Cut(seconds=phase.until_s - phase.at_s, sides=phase.sides)
            self.cuts.append(cut)
            tasks = self._contested[number]
            waiting = await self._prepare(tasks, until=began + phase.at_s)
            cut.tasks = len(tasks)
            await self._begun[phase.at_s].wait()
            await self._order(cut, tasks, waiting, self._mended[phase.at_s])
            await self._mended[phase.at_s].wait()
            await self._agree(cut, [each.wanted.task for each in tasks], self._mended_at[phase.at_s])
            progress(
                f"{len(cut.given)} orders in {cut.seconds:g} s of partition; met after {cut.met_s} s, all gateways "
                f"answer the same after {cut.agreed_s} s"
            )

    async def _prepare(self, tasks: Sequence[Contested], *, until: float) -> dict[str, str]:
        """Hand in what is to wait for approval; returns the hash of each plan that waits."""
        waiting: dict[str, str] = {}

        async def hand_in(each: Contested) -> None:
            request = TaskRequest(
                instruction=f"chaos {each.wanted.task}", id=each.wanted.task, plan=each.wanted.plan,
                approval=Approval.ALWAYS,
            )  # fmt: skip
            while time.monotonic() < until:
                gateway = self._generator.choice(self._gateways)
                try:
                    record = await self._rpc.call(gateway, keyspace.SUBMIT, request, timeout_s=_ORDER_S)
                except SwiftbotError:
                    record = None
                if record is not None:
                    self._accepted.add(request.id)
                if record is not None and record.state is TaskState.PROPOSED and record.proposal is not None:
                    waiting[request.id] = record.proposal.hash
                    return
                await asyncio.sleep(_AGAIN_S)

        await asyncio.gather(*(hand_in(each) for each in tasks if not each.submitted))
        return waiting

    async def _order(
        self, cut: Cut, tasks: Sequence[Contested], waiting: dict[str, str], mended: asyncio.Event
    ) -> None:
        """Give the orders of both sides, spread over the first half of the cut."""

        async def give(each: Contested, side: int, verb: str, at: float) -> None:
            await asyncio.sleep(max(0.0, at - time.monotonic()))
            cut.given.append(await self._give(each, side, verb, cut.sides[side], waiting, mended))

        now = time.monotonic()
        async with asyncio.TaskGroup() as group:
            for each in tasks:
                for side, verb in enumerate(each.orders):
                    if verb and (each.submitted or each.wanted.task in waiting):
                        at = now + self._generator.uniform(0.0, cut.seconds / 2)
                        group.create_task(give(each, side, verb, at))

    async def _give(
        self,
        each: Contested,
        side: int,
        verb: str,
        gateways: Sequence[str],
        waiting: dict[str, str],
        mended: asyncio.Event,
    ) -> Given:
        """Give one order to a gateway of one side, again while nobody there can take it."""
        task = each.wanted.task
        given = Given(
            task=task,
            verb=verb,
            side=side,
            by=self._operator or f"operator-{side + 1}",
            act=f"o-{uuid.uuid4().hex[:16]}",
            problem="cut",
        )
        while not mended.is_set():
            gateway = self._generator.choice(list(gateways))
            try:
                await self._ask(gateway, each, given, waiting)
            except (UnreachableError, DeadlineError):
                await asyncio.sleep(_AGAIN_S)
            except SwiftbotError as error:
                given.problem = error.code
                break
            else:
                given.problem = ""
                break
        return given

    async def _ask(self, gateway: str, each: Contested, given: Given, waiting: dict[str, str]) -> None:
        match given.verb:
            case "submit":
                request = TaskRequest(
                    instruction=f"chaos {given.task}", id=given.task, plan=each.wanted.plan, submitter=given.by
                )
                await self._rpc.call(gateway, keyspace.SUBMIT, request, timeout_s=_ORDER_S)
                self._accepted.add(given.task)
            case "approve":
                approve = ApproveAsk(id=given.task, hash=waiting[given.task], by=given.by, act=given.act)
                await self._rpc.call(gateway, keyspace.APPROVE, approve, timeout_s=_ORDER_S)
            case _:
                cancel = CancelTaskAsk(id=given.task, by=given.by, act=given.act)
                await self._rpc.call(gateway, keyspace.CANCEL, cancel, timeout_s=_ORDER_S)

    async def _agree(self, cut: Cut, tasks: Sequence[str], mended_at: float) -> None:
        """Ask every gateway for every task until all have said the same for a while."""
        known = sorted(self._accepted & set(tasks))
        agreement = Agreement(known)
        until = mended_at + WATCHED_S
        while time.monotonic() < until:
            await asyncio.gather(*(self._ask_all(task, agreement, mended_at) for task in known))
            now_s = time.monotonic() - mended_at
            if not agreement.apart and now_s > agreement.at_s + QUIET_S:
                break
            await asyncio.sleep(BETWEEN_S)
        met = [at for at in self._joined if mended_at <= at]
        cut.met_s = max(met) - mended_at if met else None
        cut.apart = agreement.apart
        cut.agreed_s = None if agreement.apart else agreement.at_s

    async def _ask_all(self, task: str, agreement: Agreement, mended_at: float) -> None:
        async def ask(gateway: str) -> View | str:
            try:
                return view(await self._rpc.call(gateway, keyspace.TASK, TaskAsk(id=task), timeout_s=1.0))
            except SwiftbotError as error:
                return error.code

        answers = await asyncio.gather(*(ask(each) for each in self._gateways))
        agreement.heard(task, dict(zip(self._gateways, answers, strict=True)), time.monotonic() - mended_at)

    def handed_in(self) -> list[Wanted]:
        """Tasks that a gateway has accepted."""
        return [each.wanted for cut in self._contested for each in cut if each.wanted.task in self._accepted]

    async def clear(self) -> None:
        """Cancel what nobody has decided on: it would wait for an approval for minutes."""

        async def cancel(each: Wanted) -> None:
            for _ in range(10):
                gateway = self._generator.choice(self._gateways)
                try:
                    record = await self._rpc.call(gateway, keyspace.TASK, TaskAsk(id=each.task))
                    if record.state is TaskState.PROPOSED:
                        await self._rpc.call(gateway, keyspace.CANCEL, CancelTaskAsk(id=record.id, by="bench"))
                except SwiftbotError:
                    await asyncio.sleep(_AGAIN_S)
                else:
                    return

        await asyncio.gather(*(cancel(each) for each in self.handed_in()))
