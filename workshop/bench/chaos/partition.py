"""Gives orders on both sides of each partition of a chaos run, and measures when all gateways answer the same again."""

import asyncio
import random
import time
import uuid
from collections.abc import Callable, Sequence

from appliance.errors import DeadlineError, SwiftbotError, UnreachableError
from appliance.model import Approval, LogLine, Notice, TaskRecord, TaskRequest, TaskState
from appliance.plane.rpc import Rpc
from appliance.plane.session import Session
from appliance.tasks.api import ApproveAsk, CancelTaskAsk, TaskAsk
from workshop.bench.chaos import sides
from workshop.bench.chaos.arena import Progress
from workshop.bench.chaos.sides import APPROVE, CANCEL, SUBMIT, Agreement, Contested, Cut, Given, View
from workshop.bench.net.faults import PARTITION, Phase

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
        rounds: tasks of each kind for each cut (`sides.KINDS`).
        seed: of the tasks.
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
    ) -> None:
        self.cuts: list[Cut] = []
        self.notices: dict[str, str] = {}
        """Recipient by id of each notice."""
        self._gateways = tuple(gateways)
        self._phases = [each for each in planned if each.name == PARTITION]
        self._contested = [
            sides.contested(number, rounds=rounds, robots=robots, seed=seed) for number in range(len(self._phases))
        ]
        self._begun = {each.at_s: asyncio.Event() for each in self._phases}
        self._mended = {each.at_s: asyncio.Event() for each in self._phases}
        self._mended_at: dict[float, float] = {}
        self._joined: list[float] = []
        self._accepted: set[str] = set()
        self._rpc = Rpc(observer, None)
        self._generator = random.Random(seed)  # noqa: S311 - a mixture, not secrets
        observer.subscribe_typed(observer.keys.notice(), Notice, self._noticed)
        observer.subscribe_typed(observer.keys.log(), LogLine, self._logged)

    @property
    def wanted(self) -> list[sides.Wanted]:
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
                    record = await self._rpc.call(gateway, "submit", request, TaskRecord, timeout_s=_ORDER_S)
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
            task=task, verb=verb, side=side, by=f"operator-{side + 1}", act=f"o-{uuid.uuid4().hex[:16]}", problem="cut"
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
                await self._rpc.call(gateway, SUBMIT, request, TaskRecord, timeout_s=_ORDER_S)
                self._accepted.add(given.task)
            case "approve":
                approve = ApproveAsk(id=given.task, hash=waiting[given.task], by=given.by, act=given.act)
                await self._rpc.call(gateway, APPROVE, approve, TaskRecord, timeout_s=_ORDER_S)
            case _:
                cancel = CancelTaskAsk(id=given.task, by=given.by, act=given.act)
                await self._rpc.call(gateway, CANCEL, cancel, TaskRecord, timeout_s=_ORDER_S)

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
                return sides.view(await self._rpc.call(gateway, "task", TaskAsk(id=task), TaskRecord, timeout_s=1.0))
            except SwiftbotError as error:
                return error.code

        answers = await asyncio.gather(*(ask(each) for each in self._gateways))
        agreement.heard(task, dict(zip(self._gateways, answers, strict=True)), time.monotonic() - mended_at)

    def handed_in(self) -> list[sides.Wanted]:
        """Tasks that a gateway has accepted."""
        return [each.wanted for cut in self._contested for each in cut if each.wanted.task in self._accepted]

    async def clear(self) -> None:
        """Cancel what nobody has decided on: it would wait for an approval for minutes."""

        async def cancel(each: sides.Wanted) -> None:
            for _ in range(10):
                gateway = self._generator.choice(self._gateways)
                try:
                    record = await self._rpc.call(gateway, "task", TaskAsk(id=each.task), TaskRecord)
                    if record.state is TaskState.PROPOSED:
                        await self._rpc.call(gateway, CANCEL, CancelTaskAsk(id=record.id, by="bench"), TaskRecord)
                except SwiftbotError:
                    await asyncio.sleep(_AGAIN_S)
                else:
                    return

        await asyncio.gather(*(cancel(each) for each in self.handed_in()))
