"""What a person's command does over Zenoh: one small client for the command line, the demo and the benchmarks.

It sits anywhere on the Zenoh network, asks any gateway, and knows nothing of a gateway's inside.

What an operator may order (`SteeringCalls`): approve, pause, retry, stop robots, take one over, answer. Every order
is signed with the operator's name, carries why and an id of its own, so that one that is repeated because an answer
was lost is still one order; gateways put what came of it on the audit's key (`operator/act/{gateway}`).

Soft stops go by the names that people type: "Rover_1" and "rover 1" are `rover_1`; an unknown name stops none.
"""

import asyncio
import contextlib
import difflib
import re
import time
import uuid
from collections.abc import AsyncGenerator, Sequence
from typing import Any, TypedDict

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from appliance.connection import Endpoint, FleetConnection
from appliance.errors import (
    DeadlineError,
    PayloadError,
    RefusedError,
    RobotError,
    SwiftbotError,
    UnreachableError,
    from_code,
)
from appliance.llm.api import SwapAsk, Swapped
from appliance.llm.stop_words import stop_request
from appliance.model import (
    Act,
    Enquiry,
    Lease,
    Notice,
    Plan,
    RobotReply,
    RunEvent,
    Site,
    SoftStop,
    SubtaskState,
    TaskRecord,
    TaskRequest,
    TaskState,
    encode,
)
from appliance.model.steering import MAX_STOPPED, MAX_WHY
from appliance.plane.dedup import Deduplicator
from appliance.pool.api import DecisionList, DecisionsAsk, EvictAsk, Evicted, ReleaseAsk, Released, WarmAsk, Warmed
from appliance.pool.transfer.protocol import Brought, FetchAsk
from appliance.robots.api import (
    LEASE_S,
    DriveAsk,
    Forgotten,
    GiveAsk,
    LinkAdd,
    LinkFacts,
    LinkList,
    LinkRemove,
    LinksAsk,
    RenewAsk,
    ResumeRobotsAsk,
    RobotForget,
    Standing,
    StandingAsk,
    StopAnswer,
    StopAsk,
    TakeAsk,
)
from appliance.robots.sender import tell_to_hold
from appliance.tasks.api import (
    ActList,
    ActsAsk,
    AnswerAsk,
    ApproveAsk,
    CancelTaskAsk,
    DrainAsk,
    DrainState,
    DrainStateAsk,
    EnquiriesAsk,
    EnquiryList,
    ExperienceAsk,
    ExperienceList,
    MigrateAsk,
    Migrated,
    MoveAsk,
    MoveCancelled,
    PauseAsk,
    PlanAnswer,
    PlanAsk,
    PlanCheckAsk,
    PlanChecked,
    RejectAsk,
    ResumeAsk,
    RetryAsk,
    SiteAsk,
    TaskAsk,
    TaskList,
    TasksAsk,
    UndrainAsk,
    WhyAsk,
)
from appliance.tasks.lines import Line
from appliance.tasks.migration.moving import MOVE_S
from appliance.tasks.stream import Stream
from appliance.tasks.views import TaskWhy

STOP_S = 6.0
"""How long a stop waits to be confirmed: by then it has long been put."""
SWAP_S = 300.0
"""Loading a large model from a slow disk, and its self-test."""

__all__ = [
    "Endpoint",
    "FleetClient",
    "Named",
    "SteeringCalls",
    "Stopped",
    "answer_text",
    "cancel_outcome",
    "named",
    "read_plan_file",
    "roster_of",
    "unknown_text",
]


def cancel_outcome(record: TaskRecord) -> str:
    """Return what came of a cancel, in words, by the record that answered it."""
    active = sum(each.state in (SubtaskState.DISPATCHED, SubtaskState.RUNNING) for each in record.subtasks)
    if record.state is TaskState.CANCELLED:
        return f"task {record.id} is cancelled"
    if record.state is TaskState.CANCELLING:
        return f"task {record.id} is being cancelled: {active} of its runs are being ended"
    if record.state.final:
        return f"task {record.id} {record.state} before the cancel came"
    return f"the cancel of task {record.id} is noted; its coordinator {record.coordinator} has not confirmed it yet"


class Signature(TypedDict):
    """The fields of `Signed`."""

    by: str
    why: str
    act: str


class SteeringCalls(FleetConnection):
    """The orders. All raise SwiftbotErrors; `ConflictError` says who was faster."""

    def _sign(self, why: str) -> Signature:
        return {"by": self.operator, "why": why, "act": f"o-{uuid.uuid4().hex[:16]}"}

    # --- tasks --------------------------------------------------------------------------------------------------

    async def approve(self, task: str, *, plan_hash: str, plan: Plan | None = None, why: str = "") -> TaskRecord:
        """Let the plan that waits take effect, or an edited one in its place; durable when this returns.

        Args:
            task: whose plan.
            plan_hash: `record.proposal.hash`, at least 8 characters of it: what the operator has looked at.
            plan: the plan as edited; checked by the gateway before it is taken.
            why: for the audit.

        Raises:
            ConflictError: somebody was faster (the message says who), or another plan waits by now.
            PlanError: the edited plan is not valid; `problems` says why, and the task waits on.
            RefusedError: nothing waits.
        """
        ask = ApproveAsk(id=task, hash=plan_hash, plan=plan, **self._sign(why))
        return await self._ask("approve", ask, TaskRecord)

    async def reject(self, task: str, *, why: str = "", plan_hash: str = "") -> TaskRecord:
        """Turn the plan that waits down. Errors as `approve`."""
        return await self._ask("reject", RejectAsk(id=task, hash=plan_hash, **self._sign(why)), TaskRecord)

    async def check_plan(self, plan: Plan, *, task: str = "") -> PlanChecked:
        """What is wrong with a plan just now, and its hash; runs nothing."""
        return await self._ask("plan_check", PlanCheckAsk(plan=plan, task=task), PlanChecked)

    async def pause(self, task: str, *, hold: bool = False, why: str = "") -> TaskRecord:
        """Start no further subtask of a task; with `hold`, end runs that go on from a checkpoint later."""
        return await self._ask("pause", PauseAsk(id=task, hold=hold, **self._sign(why)), TaskRecord)

    async def resume(self, task: str, *, why: str = "") -> TaskRecord:
        """Take an operator's pause back; RefusedError where there is none, or a soft stop is the reason."""
        return await self._ask("resume", ResumeAsk(id=task, **self._sign(why)), TaskRecord)

    async def retry(self, task: str, subtask: str = "", *, why: str = "") -> TaskRecord:
        """Try again what failed or was cancelled; what has succeeded is kept."""
        return await self._ask("retry", RetryAsk(id=task, subtask=subtask, **self._sign(why)), TaskRecord)

    async def cancel(self, task: str, *, why: str = "") -> TaskRecord:
        """Stop a task; returns what came of it, which `cancel_outcome` says in words."""
        return await self._ask("cancel", CancelTaskAsk(id=task, **self._sign(why)), TaskRecord)

    async def enquiries(self) -> EnquiryList:
        """Questions of skills and robots that wait for an answer, oldest first."""
        return await self._ask("enquiries", EnquiriesAsk(), EnquiryList)

    async def answer(self, enquiry: str, text: str, *, why: str = "") -> Enquiry:
        """Answer a question; ConflictError with who answered when somebody was faster."""
        return await self._ask("answer", AnswerAsk(id=enquiry, answer=text, **self._sign(why)), Enquiry)

    async def acts(self, limit: int = 100) -> tuple[tuple[Act, ...], dict[str, SwiftbotError]]:
        """What operators ordered lately, newest first; and which gateways did not tell, and why."""
        await self.gateway()
        found, failed = await self._each("", "acts", ActsAsk(limit=limit), ActList)
        acts = {each.id: each for answer in found.values() for each in answer.acts}
        return tuple(sorted(acts.values(), key=lambda each: each.at_ns, reverse=True)[:limit]), failed

    # --- robots -------------------------------------------------------------------------------------------------

    def knows_robot(self, name: str) -> bool:
        """Whether a robot of that name has been heard of here."""
        return name in self.plane.registry.robots

    async def stop(self, robots: Sequence[str] = (), *, why: str = "") -> StopAnswer:
        """Soft stop of some robots, or of the fleet: they hold, and are given no command until `resume_robots`.

        It is put before anybody is asked, so that every gateway that hears it acts on it, whoever answers; when none
        does, the robots that speak Zenoh themselves are told from here. Not a safety-rated emergency stop.

        Raises:
            UnreachableError, DeadlineError: no gateway confirms that it is kept; the message says what was told.
        """
        signed = self._sign(why)
        stop = SoftStop(
            id=signed["act"], robots=tuple(robots), by=signed["by"], why=signed["why"], at_ns=time.time_ns()
        )
        self.plane.session.put(self.plane.keys.soft_stop(stop.id), encode(stop))
        try:
            return await self._ask(
                "soft_stop", StopAsk(robots=stop.robots, **signed), StopAnswer, timeout_s=STOP_S, patience_s=STOP_S
            )
        except (UnreachableError, DeadlineError) as error:
            names = stop.robots or tuple(self.plane.registry.robots)
            held, _ = await tell_to_hold(self.plane.session, names, act=stop.id)
            told = f"told from here, and hold: {', '.join(held)}" if held else "no robot could be told from here either"
            raise UnreachableError(
                f"no gateway confirms the stop ({error.message}); {told}", remedy="stop the robots by their own means"
            ) from error

    async def resume_robots(
        self, robots: Sequence[str] = (), *, stops: Sequence[str] = (), why: str = ""
    ) -> StopAnswer:
        """Lift soft stops of some robots, or of all: one that is given while this is under way stays in force.

        Args:
            robots: which; none: all that the stops hold.
            stops: ids of those that the operator has seen; none: those that a gateway tells before the first try.
            why: for the audit.
        """
        seen = tuple(stops) or tuple(each.id for each in (await self.standing()).active)
        ask = ResumeRobotsAsk(robots=tuple(robots), stops=seen, **self._sign(why))
        return await self._ask("soft_resume", ask, StopAnswer)

    async def standing(self) -> Standing:
        """The soft stops and leases in force, as any one gateway knows them."""
        return await self._ask("standing", StandingAsk(), Standing)

    async def take_over(self, robot: str, *, lease_s: float = LEASE_S, why: str = "") -> Lease:
        """Take a robot over: from now on only commands with this lease move it; renew it before `lease_s` is over.

        Raises:
            ConflictError: somebody else has it; the message says who.
            NotFoundError: there is no such robot.
        """
        return await self._ask("control_take", TakeAsk(robot=robot, lease_s=lease_s, **self._sign(why)), Lease)

    async def renew(self, lease: Lease) -> Lease:
        """Keep a robot; ConflictError when the lease has ended, and with whom the robot is."""
        return await self._ask("control_renew", RenewAsk(robot=lease.robot, lease=lease.id), Lease, patience_s=2.0)

    async def give_back(self, lease: Lease, *, why: str = "") -> Lease:
        """Have a robot hold, and give it back to the tasks."""
        return await self._ask("control_give", GiveAsk(robot=lease.robot, lease=lease.id, **self._sign(why)), Lease)

    async def drive(self, lease: Lease, verb: str, *, timeout_s: float = 5.0, **args: Any) -> RobotReply:
        """Have a robot do a verb under a lease; RobotError and others with the robot's reason when it does not.

        `velocity` (`forward_mps`, `left_mps`, `up_mps`, `turn_dps`, `for_s`) moves it for `for_s` seconds, at most 1:
        repeat it while a key is held. Without a repeat the robot holds by itself.
        """
        ask = DriveAsk(robot=lease.robot, lease=lease.id, verb=verb, args=args, timeout_s=timeout_s)
        gateway = await self.gateway()
        reply = await self.plane.rpc.call(gateway, "control_move", ask, RobotReply, timeout_s=timeout_s + 1.0)
        if (failure := reply.failure) is not None:
            error = from_code(failure.code, failure.message, failure.remedy)
            raise error if type(error) is not SwiftbotError else RobotError(failure.message, remedy=failure.remedy)
        return reply

    # --- gateways -----------------------------------------------------------------------------------------------

    async def swap_model(self, gateway: str, folder: str, *, why: str = "") -> Swapped:
        """Have a gateway plan with another model folder of its own; the old one goes on when the new one cannot be.

        Raises:
            PrerequisiteError, UnreachableError, DeadlineError, PlanError: it cannot be loaded, or fails its self-test.
            RefusedError: another swap is under way.
            ConfigError: that gateway has no local tier.
        """
        await self._known(gateway)
        ask = SwapAsk(folder=folder, **self._sign(why))
        return await self.plane.rpc.call(gateway, "llm_swap", ask, Swapped, timeout_s=SWAP_S)


def read_plan_file(data: bytes) -> Plan:
    """Read a plan as `task show --json` or an editor writes it; PayloadError with the place otherwise."""
    try:
        return msgspec.json.decode(data, type=Plan)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise PayloadError(f"not a plan: {error}", remedy="see docs/schemas/Plan.json") from error


def _news(last: TaskRecord, record: TaskRecord) -> bool:
    """Whether a record tells more than the last one shown.

    A coordinator that comes later, be it the same gateway after a restart, goes on from the last *written* record,
    so that its transitions may be numbered lower than what was pushed before. Within one coordinator its own clock
    orders; an end is always news.
    """
    if record.state.final or record.coordinator != last.coordinator:
        return True
    return record.sequence > last.sequence or record.updated_ns > last.updated_ns


class FleetClient(SteeringCalls):
    """All that can be asked of a fleet; use it as an async context manager."""

    async def plan(self, instruction: str, *, private: bool = False) -> PlanAnswer:
        """Decompose, run nothing; `private`: ask no other machine."""
        asked = PlanAsk(instruction=instruction, private=private)
        return await self._ask("plan", asked, PlanAnswer, timeout_s=60.0)

    async def experience(self, limit: int, gateway: str = "") -> ExperienceList:
        """How skills have done on robots lately, by what a gateway has heard; any gateway's by default."""
        asked = ExperienceAsk(limit=limit)
        if not gateway:
            return await self._ask("experience", asked, ExperienceList)
        await self._known(gateway)
        return await self.plane.rpc.call(gateway, "experience", asked, ExperienceList)

    async def submit(self, request: TaskRequest) -> TaskRecord:
        """Hand in a task; durable when this returns. It gets its id here, so that asking twice is one task."""
        if not request.id:
            request = replace(request, id=f"t-{uuid.uuid4().hex[:10]}")
        return await self._ask("submit", request, TaskRecord, timeout_s=6.0, patience_s=15.0)

    async def task(self, task: str) -> TaskRecord:
        """One task's record."""
        return await self._ask("task", TaskAsk(id=task), TaskRecord)

    async def tasks(self, limit: int) -> TaskList:
        """The newest tasks of the fleet."""
        return await self._ask("tasks", TasksAsk(limit=limit), TaskList)

    async def site(self) -> Site:
        """The map by which any one gateway understands names of places."""
        return await self._ask("site", SiteAsk(), Site)

    async def why(self, task: str, subtask: str = "") -> TaskWhy:
        """Why a task waits, or was served where it was; NotFoundError when there is no such task or subtask."""
        return await self._ask("why", WhyAsk(id=task, subtask=subtask), TaskWhy)

    # --- moving runs --------------------------------------------------------------------------------------------

    async def migrate(self, ask: MigrateAsk) -> Migrated:
        """Move a subtask's run to another gateway; returns when it has started there.

        Raises:
            NotFoundError, RefusedError: it cannot be moved, with the reason; it goes on where it is.
            CancelledByOperatorError: somebody called it off.
        """
        signed = replace(ask, by=ask.by or self.operator)
        return await self.plane.rpc.call(await self.gateway(), "migrate", signed, Migrated, timeout_s=MOVE_S)

    async def migrate_cancel(self, task: str, subtask: str) -> bool:
        """Call off a move that is under way; False when it is too late, or there is none."""
        ask = MoveAsk(task=task, subtask=subtask)
        return (await self._ask("migrate_cancel", ask, MoveCancelled)).cancelled

    async def drain(self, gateway: str, deadline_s: float, *, why: str = "") -> DrainState:
        """Have a gateway give all its runs away and take no more; returns at once."""
        await self._known(gateway)
        return await self.plane.rpc.call(
            gateway, "drain", DrainAsk(deadline_s=deadline_s, **self._sign(why)), DrainState
        )

    async def undrain(self, gateway: str, *, why: str = "") -> DrainState:
        """Have a gateway take runs again."""
        await self._known(gateway)
        return await self.plane.rpc.call(gateway, "undrain", UndrainAsk(**self._sign(why)), DrainState)

    async def drain_state(self, gateway: str) -> DrainState:
        """How far a gateway is with giving its runs away."""
        return await self.plane.rpc.call(gateway, "drain_state", DrainStateAsk(), DrainState)

    # --- MAVLink links -----------------------------------------------------------------------------------------

    async def robot_links(self, gateway: str = "") -> tuple[dict[str, LinkList], dict[str, SwiftbotError]]:
        """The MAVLink links of all gateways, or one; and why the others did not tell."""
        await self._known(gateway)
        return await self._each(gateway, "robot_links", LinksAsk(), LinkList)

    async def robot_link_add(self, gateway: str, ask: LinkAdd) -> LinkFacts:
        """Have a gateway open a MAVLink link and keep it over restarts.

        Raises:
            ConfigError: it cannot be, or its port is taken.
            RefusedError: there is such a link with other settings.
        """
        await self._known(gateway)
        return await self.plane.rpc.call(gateway, "robot_link_add", ask, LinkFacts)

    async def robot_link_remove(self, gateway: str, ask: LinkRemove) -> LinkFacts:
        """Have a gateway close a MAVLink link for good; NotFoundError when it has none of that name."""
        await self._known(gateway)
        return await self.plane.rpc.call(gateway, "robot_link_remove", ask, LinkFacts, timeout_s=15.0)

    async def robot_forget(self, ask: RobotForget) -> Forgotten:
        """Remove the row of a robot that is offline, at the gateway that it was attached to, where that is there.

        Raises:
            NotFoundError: there is none of that name.
            RefusedError: it is online.
        """
        anyone = await self.gateway()
        known = self.plane.registry.robots.get(ask.robot)
        there = known is not None and known.gateway in self.plane.members()
        return await self.plane.rpc.call(known.gateway if known and there else anyone, "robot_forget", ask, Forgotten)

    # --- pools ------------------------------------------------------------------------------------------------

    async def pool_warm(self, gateway: str, ask: WarmAsk) -> Warmed:
        """Have a gateway keep containers of an image ready."""
        await self._known(gateway)
        signed = replace(ask, by=ask.by or self.operator)
        return await self.plane.rpc.call(gateway, "pool_warm", signed, Warmed, timeout_s=ask.wait_s + 5.0)

    async def image_fetch(
        self, gateway: str, reference: str, source: str = "", *, timeout_s: float = 900.0, why: str = ""
    ) -> Brought:
        """Have a gateway bring an image to itself, from `source` first; returns when it is there.

        Raises:
            NotFoundError: no gateway that answers has it.
        """
        await self._known(gateway)
        ask = FetchAsk(reference=reference, gateway=source, **self._sign(why))
        return await self.plane.rpc.call(gateway, "image_fetch", ask, Brought, timeout_s=timeout_s)

    def image_holders(self, reference: str) -> tuple[str, ...]:
        """Gateways whose status lists an image, by its full reference."""
        known = self.plane.registry.gateways
        return tuple(sorted(each for each, status in known.items() if reference in status.images))

    async def pool_evict(self, name: str, gateway: str = "", *, why: str = "") -> dict[str, Evicted]:
        """Give up a container, by its id or the beginning of it, or all idle ones of an image; answers by gateway.

        Raises:
            NotFoundError: no gateway has such a container, or image.
            RefusedError: several containers begin so, or it is not idle.
        """
        await self._known(gateway)
        held = [
            (each, container)
            for each, containers in self.plane.registry.containers.items()
            for container in containers
            if container.startswith(name) and gateway in ("", each)
        ]
        if len(held) > 1 and name not in (container for _, container in held):
            ids = ", ".join(sorted(container for _, container in held))
            raise RefusedError(f"several containers begin with {name}: {ids}", remedy="write more of it")
        if held:
            where, container = min(held, key=lambda each: (each[1] != name, each))
            ask = EvictAsk(container=container, **self._sign(why))
            return {where: await self.plane.rpc.call(where, "pool_evict", ask, Evicted)}
        return await self._all_of(gateway, "pool_evict", EvictAsk(image=name, **self._sign(why)), Evicted)

    async def pool_release(self, image: str, gateway: str = "", *, why: str = "") -> dict[str, Released]:
        """Have an image started again that is in quarantine, on one gateway or wherever it is."""
        ask = ReleaseAsk(image=image, **self._sign(why))
        return await self._all_of(gateway, "pool_release_quarantine", ask, Released)

    async def pool_decisions(
        self, limit: int, gateway: str = ""
    ) -> tuple[dict[str, DecisionList], dict[str, SwiftbotError]]:
        """What pools started and gave up lately, by gateway; and why the others did not tell."""
        await self._known(gateway)
        return await self._each(gateway, "pool_decisions", DecisionsAsk(limit=limit), DecisionList)

    # --- watching ---------------------------------------------------------------------------------------------

    async def watch(self, task: str, *, poll_s: float = 1.0) -> AsyncGenerator[TaskRecord]:
        """Yield a task's record whenever it changes, until it has ended; survives the loss of gateways.

        Changes are pushed; every `poll_s` the record is asked for as well, in case a push was missed.
        """
        queue: asyncio.Queue[TaskRecord] = asyncio.Queue()

        def take(key: str, record: TaskRecord | None) -> None:  # noqa: ARG001 - the record names its task
            if record is not None:
                queue.put_nowait(record)

        closer = self.plane.session.subscribe_typed(self.plane.keys.task(task), TaskRecord, take)
        try:
            last: TaskRecord | None = None
            silent = 0
            queue.put_nowait(await self.task(task))
            while last is None or not last.state.final:
                try:
                    async with asyncio.timeout(poll_s):
                        record = await queue.get()
                except TimeoutError:
                    try:
                        record = await self.task(task)
                        silent = 0
                    except SwiftbotError:
                        silent += 1
                        if silent > 30:
                            raise
                        continue
                if last is None or _news(last, record):
                    last = record
                    yield record
        finally:
            closer.close()

    async def stream(self, task: str, *, since_s: float | None = None) -> AsyncGenerator[Line]:
        """Yield what happens to a task, from all gateways in one order, until it has ended.

        Progress, log lines of handlers and of gateways, figures, what the monitor finds and does. What is still known
        of the past comes first; the queue is bounded, and what it drops is told in the stream.

        Args:
            task: its id.
            since_s: leave out what was said longer ago than so many seconds; None: all that is still known.

        Raises:
            NotFoundError: there is no such task.
        """
        follow = Stream(self.plane, task, lambda: self.task(task)).follow(since_s=since_s)
        async with contextlib.aclosing(follow) as lines:
            async for line in lines:
                yield line

    async def planned(self, task: str, *, timeout_s: float = 60.0) -> TaskRecord:
        """Wait until a task has a plan or has ended."""

        async def wait() -> TaskRecord:
            async with contextlib.aclosing(self.watch(task, poll_s=0.2)) as changes:
                async for record in changes:
                    if record.state is not TaskState.ACCEPTED:
                        return record
            raise DeadlineError(f"task {task} has no plan yet")

        try:
            async with asyncio.timeout(timeout_s):
                return await wait()
        except TimeoutError:
            raise DeadlineError(
                f"task {task} has no plan after {timeout_s:.0f} s", remedy=f"see `swiftbot task show {task}`"
            ) from None

    def on_notice(self, take: "asyncio.Queue[Notice]") -> None:
        """Have notices to people put into a queue, each once: both sides of a partition may have given it."""
        once = Deduplicator()

        def heard(_: str, notice: Notice | None) -> None:
            if notice is not None and once.new(notice.id):
                take.put_nowait(notice)

        self.plane.session.subscribe_typed(self.plane.keys.notice(), Notice, heard)

    def on_run(self, task: str, take: "asyncio.Queue[RunEvent]") -> None:
        """Have the events of a task's runs put into a queue."""
        self.plane.session.subscribe_typed(
            self.plane.keys.run(task), RunEvent, lambda _, event: take.put_nowait(event) if event else None
        )


class Named(Struct, frozen=True, kw_only=True):
    """What typed names mean."""

    robots: tuple[str, ...] = ()
    unknown: tuple[str, ...] = ()
    """Names that no robot has, as they were typed."""

    @property
    def fleet(self) -> bool:
        """Whether no robot is named, so that all are meant."""
        return not (self.robots or self.unknown)


def named(names: Sequence[str], roster: Sequence[str]) -> Named:
    """Return the robots that typed names mean: exact names, "Rover_1", "rover 1", "the drones", "all"."""
    if all(name in roster for name in names):
        return Named(robots=tuple(dict.fromkeys(names)))
    exact = [name for name in names if name in roster]
    # All words together: the shell splits "rover 1" and "rover_1 and drone_1".
    if (said := stop_request(f"stop {' '.join(names)}", roster)) is not None:
        typed = {_plain(name): name for name in names}
        both = (*said.robots, *exact) if said.robots or said.unknown else ()
        return Named(
            robots=tuple(dict.fromkeys(both)), unknown=tuple(typed.get(_plain(each), each) for each in said.unknown)
        )
    robots: list[str] = []
    unknown: list[str] = []
    for name in names:
        said = None if name in exact else stop_request(f"stop {name}", roster)
        if said is not None and not (said.robots or said.unknown):
            return Named()  # "all"
        found = [name] if name in exact else [each for each in roster if _plain(each) == _plain(name)]
        robots += found or (said.robots if said is not None else ())
        if not found and (said is None or said.unknown):
            unknown.append(name)
    return Named(robots=tuple(dict.fromkeys(robots)), unknown=tuple(dict.fromkeys(unknown)))


def unknown_text(name: str, roster: Sequence[str]) -> str:
    """Return what is said of a name that no robot has: first of all that nothing was stopped by it."""
    plain = {_plain(each): each for each in roster}
    near = difflib.get_close_matches(_plain(name), plain, n=1, cutoff=0.5)
    known = f"; robots: {', '.join(sorted(roster)[:12])}{', …' if len(roster) > 12 else ''}" if roster else ""
    hint = f"; did you mean {plain[near[0]]}?" if near else known
    return f"NOT STOPPED: no robot {name[:60]!r}{hint}"


def _plain(name: str) -> str:
    return re.sub(r"[\W_]+", "", name.casefold())


class Stopped(Struct, frozen=True, kw_only=True):
    """What came of a stop by names."""

    robots: tuple[str, ...] = ()
    """The robots that were stopped; empty with an answer: all."""
    unknown: tuple[str, ...] = ()
    roster: tuple[str, ...] = ()
    answer: StopAnswer | None = None
    """None: no robot was named that the fleet has, and none was stopped."""

    @staticmethod
    async def carry_out(client: SteeringCalls, names: Sequence[str], *, why: str = "") -> "Stopped":
        """Stop the robots of these names, all when there are none.

        Where no gateway answers, the names are taken as they are: a stop is put all the same.

        Raises:
            UnreachableError, DeadlineError: no gateway confirms that it is kept.
        """
        meant, roster = Named(robots=tuple(names)), ()
        if names:
            with contextlib.suppress(UnreachableError, DeadlineError):
                await client.gateway()
                roster = roster_of(client)
                meant = named(names, roster)
        robots = meant.robots if len(meant.robots) <= MAX_STOPPED else ()
        answer = await client.stop(robots, why=why[:MAX_WHY]) if meant.robots or meant.fleet else None
        return Stopped(robots=robots, unknown=meant.unknown, roster=roster, answer=answer)

    @property
    def confirmed(self) -> bool:
        """Whether every robot that was meant is stopped and every gateway keeps it."""
        return not self.unknown and self.answer is not None and not (self.answer.silent or self.answer.problems)

    def as_json(self) -> dict[str, Any]:
        """Return what `--json` prints: the answer's fields, and the names that no robot has."""
        answer: dict[str, Any] = msgspec.to_builtins(self.answer or StopAnswer(stops=()))
        return {**answer, "unknown": list(self.unknown)}

    def text(self) -> str:
        """Return what is printed: what was not stopped or not confirmed first, in capitals."""
        lines = [unknown_text(name, self.roster) for name in self.unknown]
        if self.answer is not None:
            lines.append(answer_text(self.answer, stopping=True))
        elif self.unknown:
            lines.append("no robot was stopped")
        if self.unknown:
            lines.append("to stop all robots: swiftbot stop")
        return "\n".join(lines)


def answer_text(answer: StopAnswer, *, stopping: bool = False) -> str:
    """Return what came of a stop, or of lifting one, in lines.

    Args:
        answer: of the gateway.
        stopping: whether it was a stop, so that what is not confirmed comes first.
    """
    lines: list[str] = []
    if stopping and (answer.problems or answer.silent):
        lost = [*sorted(answer.problems), *(f"gateway {each}" for each in answer.silent)]
        lines.append(f"NOT CONFIRMED by {', '.join(lost)}: use the switch at a robot that moves")
    lines += [f"{', '.join(each.robots) or 'the fleet'}: {each.text}" for each in answer.stops] or [
        "nothing is stopped"
    ]
    if answer.robots:
        lines.append(f"hold: {', '.join(answer.robots)}")
    lines += [f"{robot} did not confirm: {reason}" for robot, reason in sorted(answer.problems.items())]
    lines.append(f"kept by {', '.join(answer.gateways)}")
    if answer.silent:
        lines.append(f"no word yet from {', '.join(answer.silent)}")
    return "\n".join(lines)


def roster_of(client: SteeringCalls) -> tuple[str, ...]:
    """Return the names of the robots that a connected client knows."""
    return tuple(sorted(client.plane.registry.robots))
