"""What a person's command does over Zenoh: one small client for the command line, the demo and the benchmarks.

It sits anywhere on the Zenoh network and asks any gateway by its verbs (`model.keyspace`).

What an operator may order (`SteeringCalls`): approve, pause, retry, stop robots, take one over, answer. Every order
is labelled with the operator's name, a reason and an ID of its own, so that one that is repeated because an answer
was lost is still one order; gateways publish its outcome on the audit's key (`operator/act/{gateway}`).

Soft stops go by the names that people type: "Rover_1" and "rover 1" are `rover_1`; an unknown name stops none.
"""

import asyncio
import contextlib
import difflib
import hashlib
import re
import time
import uuid
from collections.abc import AsyncGenerator, Mapping, Sequence
from typing import Any, Literal, TypedDict

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from appliance.connection import Endpoint, FleetConnection
from appliance.errors import (
    DeadlineError,
    NotFoundError,
    PayloadError,
    RefusedError,
    RobotError,
    SwiftbotError,
    UnreachableError,
    from_code,
)
from appliance.llm.stop_words import mentions_stop, stop_request
from appliance.model import (
    Act,
    Enquiry,
    Lease,
    Notice,
    Plan,
    RobotInfo,
    RobotReply,
    RunEvent,
    Site,
    SoftStop,
    SubtaskState,
    TaskRecord,
    TaskRequest,
    TaskState,
    keyspace,
)
from appliance.model.alerts import MOST_ACKED, Alert, AlertAck, AlertList, AlertsAcked, AlertsAsk
from appliance.model.closures import CloseAsk, Closure, ClosureList, ClosuresAsk, ReopenAsk, Rule
from appliance.model.learn_api import (
    LearnEvalAsk,
    LearnEvaluated,
    LearnExportAsk,
    LearnExported,
    LearnRunsAsk,
    LearnShowAsk,
    LearnShown,
    LearnStartAsk,
    LearnSteerAsk,
    Steering,
)
from appliance.model.learning import Recipe, Reference, RunRecord
from appliance.model.plane_api import SealedAsk, SealedTold
from appliance.model.planner_api import SwapAsk, Swapped
from appliance.model.pool_api import (
    DecisionList,
    DecisionsAsk,
    EvictAsk,
    Evicted,
    ReleaseAsk,
    Released,
    WarmAsk,
    Warmed,
)
from appliance.model.robot_api import (
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
    ScheduleSpec,
    ScheduleSteer,
)
from appliance.model.steering import MAX_STOPPED, MAX_WHY
from appliance.model.task_api import (
    ActsAsk,
    AnswerAsk,
    ApproveAsk,
    ArtifactAsk,
    CancelTaskAsk,
    DrainAsk,
    DrainState,
    DrainStateAsk,
    EnquiriesAsk,
    EnquiryList,
    ExperienceAsk,
    ExperienceList,
    FirstAsk,
    Line,
    MigrateAsk,
    Migrated,
    MoveAsk,
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
    TaskWhy,
    UndrainAsk,
    WhyAsk,
)
from appliance.model.transfer_api import Brought, FetchAsk
from appliance.plane.dedup import Deduplicator
from appliance.robots.sender import tell_to_hold
from appliance.tasks.stream import Stream

LEARN_LOOK_S = 0.5
"""How often a run of federated learning is asked for while it is followed."""
WATCH_SILENCE_S = 3.0
"""Longer than the pause between two signs of life of a run (`pool.runs.ALIVE_S`)."""
MOST_SILENT = 10
"""Failed looks in a row after which a watcher gives up."""
SUBMIT_S = 15.0
"""How long a gateway that takes a task is looked for."""
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
            ConflictError: another operator was faster (the message says who), or another plan waits by now.
            PlanError: the edited plan is not valid; `problems` says why, and the task waits on.
            RefusedError: nothing waits.
        """
        ask = ApproveAsk(id=task, hash=plan_hash, plan=plan, **self._sign(why))
        return await self._ask(keyspace.APPROVE, ask)

    async def reject(self, task: str, *, why: str = "", plan_hash: str = "") -> TaskRecord:
        """Turn the plan that waits down. Errors as `approve`."""
        return await self._ask(keyspace.REJECT, RejectAsk(id=task, hash=plan_hash, **self._sign(why)))

    async def check_plan(self, plan: Plan, *, task: str = "") -> PlanChecked:
        """What is wrong with a plan just now, and its hash; runs nothing."""
        return await self._ask(keyspace.PLAN_CHECK, PlanCheckAsk(plan=plan, task=task))

    async def pause(self, task: str, *, hold: bool = False, why: str = "") -> TaskRecord:
        """Start no further subtask of a task; with `hold`, end runs that go on from a checkpoint later."""
        return await self._ask(keyspace.PAUSE, PauseAsk(id=task, hold=hold, **self._sign(why)))

    async def resume(self, task: str, *, why: str = "") -> TaskRecord:
        """Take an operator's pause back; RefusedError where there is none, or a soft stop is the reason."""
        return await self._ask(keyspace.RESUME, ResumeAsk(id=task, **self._sign(why)))

    async def retry(self, task: str, subtask: str = "", *, why: str = "") -> TaskRecord:
        """Try again what failed or was cancelled; what has succeeded is kept."""
        return await self._ask(keyspace.RETRY, RetryAsk(id=task, subtask=subtask, **self._sign(why)))

    async def first(self, task: str, *, before: str = "", why: str = "") -> TaskRecord:
        """Put a task before all that wait for its robots, or right before one; RefusedError where none waits."""
        return await self._ask(keyspace.FIRST, FirstAsk(id=task, before=before, **self._sign(why)))

    async def cancel(self, task: str, *, why: str = "") -> TaskRecord:
        """Stop a task; returns what came of it, which `cancel_outcome` says in words."""
        return await self._ask(keyspace.CANCEL, CancelTaskAsk(id=task, **self._sign(why)))

    async def enquiries(self) -> EnquiryList:
        """Questions of skills and robots that wait for an answer, oldest first."""
        return await self._ask(keyspace.ENQUIRIES, EnquiriesAsk())

    async def answer(self, enquiry: str, text: str, *, why: str = "") -> Enquiry:
        """Answer a question; ConflictError with who answered when another operator was faster."""
        return await self._ask(keyspace.ANSWER, AnswerAsk(id=enquiry, answer=text, **self._sign(why)))

    async def alerts(self) -> AlertList:
        """What operators have to know of and do something about, the most urgent first."""
        return await self._ask(keyspace.ALERTS, AlertsAsk())

    async def acknowledge(self, ids: Sequence[str], *, why: str = "") -> AlertsAcked:
        """Acknowledge alerts; who was first stands there, and `unknown` has those that are over.

        Raises:
            NotFoundError: none of them is there.
        """
        found = AlertsAcked()
        for first in range(0, len(ids), MOST_ACKED):
            ask = AlertAck(ids=tuple(ids[first : first + MOST_ACKED]), **self._sign(why))
            some = await self._ask(keyspace.ALERT_ACK, ask)
            found = AlertsAcked(alerts=found.alerts + some.alerts, unknown=found.unknown + some.unknown)
        if not found.alerts:
            names = ", ".join(found.unknown)[:200]
            raise NotFoundError(f"no alert {names}: it is over, or never was", remedy="see `swiftbot alerts`")
        return found

    async def acts(self, limit: int = 100) -> tuple[tuple[Act, ...], dict[str, SwiftbotError]]:
        """What operators ordered lately, newest first; and which gateways did not tell, and why."""
        await self.gateway()
        found, failed = await self._each("", keyspace.ACTS, ActsAsk(limit=limit))
        acts = {each.id: each for answer in found.values() for each in answer.acts}
        return tuple(sorted(acts.values(), key=lambda each: each.at_ns, reverse=True)[:limit]), failed

    # --- places and robots out of use, standing rules ---------------------------------------------------------------

    async def close_place(self, name: str, *, until_ns: int = 0, why: str = "") -> Closure:
        """Close a place: no task goes there until it is opened, or until a moment, Unix nanoseconds."""
        return await self._ask(keyspace.CLOSE, CloseAsk(kind="place", name=name, until_ns=until_ns, **self._sign(why)))

    async def maintain(self, robot: str, *, until_ns: int = 0, why: str = "") -> Closure:
        """Take a robot into maintenance: tasks command it no more; an operator who takes it over does."""
        return await self._ask(keyspace.CLOSE, CloseAsk(kind="robot", name=robot, until_ns=until_ns, **self._sign(why)))

    async def add_rule(self, rule: Rule, *, until_ns: int = 0, why: str = "") -> Closure:
        """Add a standing rule, or change until when and why; it is returned as the fleet keeps it."""
        ask = CloseAsk(kind="rule", name=rule.id, rule=rule, until_ns=until_ns, **self._sign(why))
        return await self._ask(keyspace.CLOSE, ask)

    async def reopen(self, kind: Literal["place", "robot", "rule"], name: str, *, why: str = "") -> Closure:
        """Open a place, end a robot's maintenance, or remove a rule by its id; NotFoundError where there is none."""
        return await self._ask(keyspace.REOPEN, ReopenAsk(kind=kind, name=name, **self._sign(why)))

    async def closures(self) -> ClosureList:
        """Places and robots that are out of use, and standing rules, as any one gateway knows them."""
        return await self._ask(keyspace.CLOSURES, ClosuresAsk())

    # --- schedules and saved instructions -------------------------------------------------------------------------

    async def schedule_add(self, spec: ScheduleSpec, *, why: str = "") -> Schedule:
        """Add a schedule; the same again is the same one.

        Raises:
            PayloadError: an interval, expression, zone or time that cannot be.
            RefusedError: the name is taken, or the instruction is a stop.
        """
        return await self._ask(keyspace.SCHEDULE_ADD, ScheduleAdd(spec=spec, **self._sign(why)))

    async def schedule_steer(self, name: str, do: Literal["pause", "resume", "remove"], *, why: str = "") -> Schedule:
        """Pause, resume or remove a schedule; NotFoundError where there is none of that name."""
        return await self._ask(keyspace.SCHEDULE_STEER, ScheduleSteer(id=name, do=do, **self._sign(why)))

    async def schedules(self) -> ScheduleList:
        """All schedules, by name, and when each is due next."""
        return await self._ask(keyspace.SCHEDULES, SchedulesAsk())

    async def instruction_save(
        self, name: str, text: str, *, about: str = "", replace: bool = False, why: str = ""
    ) -> SavedInstruction:
        """Save an instruction with parameters; RefusedError where the name is taken and is not to be replaced."""
        ask = InstructionSave(id=name, text=text, about=about, replace=replace, **self._sign(why))
        return await self._ask(keyspace.INSTRUCTION_SAVE, ask)

    async def instruction_remove(self, name: str, *, why: str = "") -> SavedInstruction:
        """Remove a saved instruction; NotFoundError where there is none of that name."""
        return await self._ask(keyspace.INSTRUCTION_REMOVE, InstructionRemove(id=name, **self._sign(why)))

    async def instructions(self) -> InstructionList:
        """All saved instructions, by name."""
        return await self._ask(keyspace.INSTRUCTIONS, InstructionsAsk())

    # --- federated learning ---------------------------------------------------------------------------------------

    async def learn_start(self, run: str, recipe: Recipe, *, why: str = "") -> RunRecord:
        """Begin a run; the same again is the same run."""
        return await self._ask(keyspace.LEARN_START, LearnStartAsk(id=run, recipe=recipe, **self._sign(why)))

    async def learn_runs(self) -> tuple[tuple[RunRecord, ...], dict[str, SwiftbotError]]:
        """All runs, newest first; and which gateways did not tell, and why."""
        await self.gateway()
        found, failed = await self._each("", keyspace.LEARN_RUNS, LearnRunsAsk())
        runs: dict[str, RunRecord] = {}
        for run in (run for answer in found.values() for run in answer.runs):
            if run.id not in runs or run.updated_ns > runs[run.id].updated_ns:
                runs[run.id] = run
        return tuple(sorted(runs.values(), key=lambda run: (-run.started_ns, run.id))), failed

    async def learn_show(self, run: str) -> LearnShown:
        """One run, with its round as the round's coordinator knows it."""
        return await self._ask(keyspace.LEARN_SHOW, LearnShowAsk(run=run))

    async def learn_watch(self, run: str) -> AsyncGenerator[LearnShown]:
        """Yield a run as it is, twice a second; it never ends by itself, and outlasts gateways that do not answer.

        Raises:
            SwiftbotError: it is not known, or nobody answers the first question.
        """
        yield await self.learn_show(run)
        while True:
            await asyncio.sleep(LEARN_LOOK_S)
            with contextlib.suppress(UnreachableError, DeadlineError):
                yield await self.learn_show(run)

    async def learn_steer(
        self, run: str, do: Steering, *, client: str = "", model: int = 0, why: str = ""
    ) -> RunRecord:
        """Pause, resume or stop a run, exclude or include a client, mark a model."""
        ask = LearnSteerAsk(run=run, do=do, client=client, model=model, **self._sign(why))
        return await self._ask(keyspace.LEARN_STEER, ask)

    async def learn_eval(self, run: str, *, model: int | None = None, limit: int | None = None) -> LearnEvaluated:
        """Evaluate a model that a run keeps on its data set's test part."""
        return await self._ask(keyspace.LEARN_EVAL, LearnEvalAsk(run=run, model=model, limit=limit))

    async def learn_export(self, run: str, *, model: int | None = None) -> LearnExported:
        """Have a model that a run keeps written as an ONNX file."""
        return await self._ask(keyspace.LEARN_EXPORT, LearnExportAsk(run=run, model=model))

    async def artifact(self, reference: Reference) -> bytes:
        """Fetch a file from the gateways, verified.

        Raises:
            NotFoundError: no gateway that answers has it.
            PayloadError: what they have does not match its digest.
        """
        digest, first = str(reference.get("artifact", "")), str(reference.get("gateway", ""))
        await self.gateway()
        for member in sorted(self.plane.members(), key=lambda name: (name != first, name)):
            data = bytearray()
            with contextlib.suppress(NotFoundError, UnreachableError, DeadlineError):
                while True:
                    ask = ArtifactAsk(artifact=digest, offset=len(data))
                    piece = await self.plane.rpc.call(member, keyspace.ARTIFACT, ask)
                    data += piece.data
                    if len(data) >= piece.size or not piece.data:
                        break
                if hashlib.sha256(data).hexdigest() == digest:
                    return bytes(data)
        raise NotFoundError(f"file {digest[:12]}… is on no gateway that answers")

    # --- robots -------------------------------------------------------------------------------------------------

    def knows_robot(self, name: str) -> bool:
        """Whether a robot of that name has been heard of here."""
        return name in self.plane.registry.robots

    def known_robots(self) -> Mapping[str, RobotInfo]:
        """Return the robots as they were heard last, by name."""
        return self.plane.registry.robots

    async def stop(self, robots: Sequence[str] = (), *, why: str = "") -> StopAnswer:
        """Soft stop of some robots, or of the fleet: they hold, and are given no command until `resume_robots`.

        It is published before any gateway is asked, so that every gateway that hears it acts on it; when none answers,
        the Zenoh robots are stopped from here. Not a safety-rated emergency stop.

        Raises:
            UnreachableError, DeadlineError: no gateway confirms that it is kept; the message says what was told.
        """
        signed = self._sign(why)
        stop = SoftStop(
            id=signed["act"], robots=tuple(robots), by=signed["by"], why=signed["why"], at_ns=time.time_ns()
        )
        self.plane.session.publish(keyspace.STOP, stop, stop.id)
        try:
            return await self._ask(
                keyspace.SOFT_STOP, StopAsk(robots=stop.robots, **signed), timeout_s=STOP_S, patience_s=STOP_S
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
        return await self._ask(keyspace.SOFT_RESUME, ask)

    async def hand_roster(self, number: int, sealed: bytes) -> SealedTold:
        """Give a gateway the authority's roster, as its file has it; all others have it within seconds."""
        return await self._ask(keyspace.ROSTER, SealedAsk(number=number, sealed=sealed))

    async def hand_parts(self, number: int, sealed: bytes) -> SealedTold:
        """Give a gateway a signed list of parts, as its file has it; all others have it within seconds."""
        return await self._ask(keyspace.PARTS, SealedAsk(number=number, sealed=sealed))

    async def standing(self) -> Standing:
        """The soft stops and leases in force, as any one gateway knows them."""
        return await self._ask(keyspace.STANDING, StandingAsk())

    async def take_over(self, robot: str, *, lease_s: float = LEASE_S, why: str = "") -> Lease:
        """Take a robot over: from now on only commands with this lease move it; renew it before `lease_s` is over.

        Raises:
            ConflictError: another operator has it; the message says who.
            NotFoundError: there is no such robot.
        """
        return await self._ask(keyspace.CONTROL_TAKE, TakeAsk(robot=robot, lease_s=lease_s, **self._sign(why)))

    async def renew(self, lease: Lease) -> Lease:
        """Keep a robot; ConflictError when the lease has ended, and with whom the robot is."""
        return await self._ask(keyspace.CONTROL_RENEW, RenewAsk(robot=lease.robot, lease=lease.id), patience_s=2.0)

    async def give_back(self, lease: Lease, *, why: str = "") -> Lease:
        """Have a robot hold, and give it back to the tasks."""
        return await self._ask(keyspace.CONTROL_GIVE, GiveAsk(robot=lease.robot, lease=lease.id, **self._sign(why)))

    async def drive(self, lease: Lease, verb: str, *, timeout_s: float = 5.0, **args: Any) -> RobotReply:
        """Have a robot do a verb under a lease; RobotError and others with the robot's reason when it does not.

        `velocity` (`forward_mps`, `left_mps`, `up_mps`, `turn_dps`, `for_s`) moves it for `for_s` seconds, at most 1:
        repeat it while a key is held. Without a repeat the robot holds by itself.
        """
        ask = DriveAsk(robot=lease.robot, lease=lease.id, verb=verb, args=args, timeout_s=timeout_s)
        gateway = await self.gateway()
        reply = await self.plane.rpc.call(gateway, keyspace.CONTROL_MOVE, ask, timeout_s=timeout_s + 1.0)
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
        return await self.plane.rpc.call(gateway, keyspace.LLM_SWAP, ask, timeout_s=SWAP_S)


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
    """Client of a fleet; use it as an async context manager."""

    async def plan(self, instruction: str, *, private: bool = False) -> PlanAnswer:
        """Decompose, run nothing; `private`: ask no other machine."""
        asked = PlanAsk(instruction=instruction, private=private)
        return await self._ask(keyspace.PLAN, asked)

    async def experience(self, limit: int, gateway: str = "") -> ExperienceList:
        """How skills have done on robots lately, by what a gateway has heard; any gateway's by default."""
        asked = ExperienceAsk(limit=limit)
        if not gateway:
            return await self._ask(keyspace.EXPERIENCE, asked)
        await self._known(gateway)
        return await self.plane.rpc.call(gateway, keyspace.EXPERIENCE, asked)

    async def submit(self, request: TaskRequest) -> TaskRecord:
        """Submit a task; durable when this returns. It gets its id here, so that asking twice is one task.

        A gateway that is taking too many others says when to come back, which is waited for.

        Raises:
            RefusedError: the instruction is not taken, or there is no room within `SUBMIT_S`.
        """
        if not request.id:
            request = replace(request, id=f"t-{uuid.uuid4().hex[:10]}")
        give_up = time.monotonic() + SUBMIT_S
        while True:
            try:
                return await self.submit_once(request)
            except RefusedError as error:
                if not error.retry_after_s or time.monotonic() + error.retry_after_s > give_up:
                    raise
                await asyncio.sleep(error.retry_after_s)

    async def submit_once(self, request: TaskRequest) -> TaskRecord:
        """Submit a task that has an id, at the gateway that will coordinate it; a refusal says when to come back.

        Many tasks are handed in by `submission.submit_all`, which heeds that.
        """
        owner = self.plane.ring.owner(f"{keyspace.TASK_RECORD.prefix}{request.id}") if self.plane.members() else ""
        return await self._ask(keyspace.SUBMIT, request, patience_s=SUBMIT_S, first=owner)

    async def task(self, task: str) -> TaskRecord:
        """One task's record."""
        return await self._ask(keyspace.TASK, TaskAsk(id=task))

    async def tasks(
        self, limit: int = 100, *, wanted: TasksAsk | None = None, after: TaskRecord | None = None
    ) -> TaskList:
        """The newest tasks of the fleet, `more`: there are older ones.

        Args:
            limit: how many at most.
            wanted: which; None: all that are kept whole.
            after: the last task of the page before.
        """
        ask = replace(wanted or TasksAsk(), limit=limit)
        if after is not None:
            ask = replace(ask, before_ns=after.created_ns, before=after.id)
        return await self._ask(keyspace.TASKS, ask)

    async def history(self, wanted: TasksAsk) -> AsyncGenerator[TaskList]:
        """Yield the tasks that are meant page after page, to the oldest; a page is at most `wanted.limit` long."""
        after: TaskRecord | None = None
        while True:
            page = await self.tasks(wanted.limit, wanted=wanted, after=after)
            yield page
            if not page.more or not page.tasks:
                return
            after = page.tasks[-1]

    async def duplicate(self, task: str) -> TaskRecord:
        """Submit a task's instruction once more, as a new task of this operator; it is planned and reviewed again.

        Priority, gateways, approval and time allowed are those of the task.

        Raises:
            NotFoundError: there is no such task.
            RefusedError: its instruction, or the plan that was submitted with it, is not kept as it was.
        """
        known = await self.task(task)
        if known.remembered is not None and known.instruction.endswith("…"):  # cut: see `tasks.records.trimmed`
            raise RefusedError(
                f"task {task} is remembered by the beginning of its instruction only",
                remedy=f"submit the whole instruction: {known.instruction}",
            )
        if known.handed_in and (known.plan is None or known.revised):
            raise RefusedError(f"the plan that came with task {task} is not kept as it was", remedy="submit it again")
        request = TaskRequest(
            instruction=known.instruction, submitter=self.operator, priority=known.priority,
            deadline_s=known.deadline_s, group=known.within, approval=known.approval,
            plan=known.plan if known.handed_in else None,
        )  # fmt: skip
        return await self.submit(request)

    async def site(self) -> Site:
        """The map by which any one gateway understands names of places."""
        return await self._ask(keyspace.SITE, SiteAsk())

    async def why(self, task: str, subtask: str = "") -> TaskWhy:
        """Why a task waits, or was served where it was; NotFoundError when there is no such task or subtask."""
        return await self._ask(keyspace.WHY, WhyAsk(id=task, subtask=subtask))

    # --- moving runs --------------------------------------------------------------------------------------------

    async def migrate(self, ask: MigrateAsk) -> Migrated:
        """Move a subtask's run to another gateway; returns when it has started there.

        Raises:
            NotFoundError, RefusedError: it cannot be moved, with the reason; it goes on where it is.
            CancelledByOperatorError: an operator called it off.
        """
        signed = replace(ask, by=ask.by or self.operator)
        return await self.plane.rpc.call(await self.gateway(), keyspace.MIGRATE, signed)

    async def migrate_cancel(self, task: str, subtask: str) -> bool:
        """Call off a move that is under way; False when it is too late, or there is none."""
        ask = MoveAsk(task=task, subtask=subtask)
        return (await self._ask(keyspace.MIGRATE_CANCEL, ask)).cancelled

    async def drain(self, gateway: str, deadline_s: float, *, why: str = "") -> DrainState:
        """Have a gateway give all its runs away and take no more; returns at once."""
        await self._known(gateway)
        return await self.plane.rpc.call(gateway, keyspace.DRAIN, DrainAsk(deadline_s=deadline_s, **self._sign(why)))

    async def undrain(self, gateway: str, *, why: str = "") -> DrainState:
        """Have a gateway take runs again."""
        await self._known(gateway)
        return await self.plane.rpc.call(gateway, keyspace.UNDRAIN, UndrainAsk(**self._sign(why)))

    async def drain_state(self, gateway: str) -> DrainState:
        """How far a gateway is with giving its runs away."""
        return await self.plane.rpc.call(gateway, keyspace.DRAIN_STATE, DrainStateAsk())

    # --- MAVLink links -----------------------------------------------------------------------------------------

    async def robot_links(self, gateway: str = "") -> tuple[dict[str, LinkList], dict[str, SwiftbotError]]:
        """The MAVLink links of all gateways, or one; and why the others did not tell."""
        await self._known(gateway)
        return await self._each(gateway, keyspace.ROBOT_LINKS, LinksAsk())

    async def robot_link_add(self, gateway: str, ask: LinkAdd) -> LinkFacts:
        """Have a gateway open a MAVLink link and keep it over restarts.

        Raises:
            ConfigError: it cannot be, or its port is taken.
            RefusedError: there is such a link with other settings.
        """
        await self._known(gateway)
        return await self.plane.rpc.call(gateway, keyspace.ROBOT_LINK_ADD, ask)

    async def robot_link_remove(self, gateway: str, ask: LinkRemove) -> LinkFacts:
        """Have a gateway close a MAVLink link for good; NotFoundError when it has none of that name."""
        await self._known(gateway)
        return await self.plane.rpc.call(gateway, keyspace.ROBOT_LINK_REMOVE, ask)

    async def robot_forget(self, ask: RobotForget) -> Forgotten:
        """Remove the row of a robot that is offline, at the gateway that it was attached to, where that is there.

        Raises:
            NotFoundError: there is none of that name.
            RefusedError: it is online.
        """
        anyone = await self.gateway()
        known = self.plane.registry.robots.get(ask.robot)
        there = known is not None and known.gateway in self.plane.members()
        return await self.plane.rpc.call(known.gateway if known and there else anyone, keyspace.ROBOT_FORGET, ask)

    # --- pools ------------------------------------------------------------------------------------------------

    async def pool_warm(self, gateway: str, ask: WarmAsk) -> Warmed:
        """Have a gateway keep containers of an image ready."""
        await self._known(gateway)
        signed = replace(ask, by=ask.by or self.operator)
        return await self.plane.rpc.call(gateway, keyspace.POOL_WARM, signed, timeout_s=ask.wait_s + 5.0)

    async def image_fetch(
        self, gateway: str, reference: str, source: str = "", *, timeout_s: float = 900.0, why: str = ""
    ) -> Brought:
        """Have a gateway bring an image to itself, from `source` first; returns when it is there.

        Raises:
            NotFoundError: no gateway that answers has it.
        """
        await self._known(gateway)
        ask = FetchAsk(reference=reference, gateway=source, **self._sign(why))
        return await self.plane.rpc.call(gateway, keyspace.IMAGE_FETCH, ask, timeout_s=timeout_s)

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
            return {where: await self.plane.rpc.call(where, keyspace.POOL_EVICT, ask)}
        return await self._all_of(gateway, keyspace.POOL_EVICT, EvictAsk(image=name, **self._sign(why)))

    async def pool_release(self, image: str, gateway: str = "", *, why: str = "") -> dict[str, Released]:
        """Have an image started again that is in quarantine, on one gateway or wherever it is."""
        ask = ReleaseAsk(image=image, **self._sign(why))
        return await self._all_of(gateway, keyspace.POOL_RELEASE_QUARANTINE, ask)

    async def pool_decisions(
        self, limit: int, gateway: str = ""
    ) -> tuple[dict[str, DecisionList], dict[str, SwiftbotError]]:
        """What pools started and gave up lately, by gateway; and why the others did not tell."""
        await self._known(gateway)
        return await self._each(gateway, keyspace.POOL_DECISIONS, DecisionsAsk(limit=limit))

    # --- watching ---------------------------------------------------------------------------------------------

    async def watch(self, task: str, *, silence_s: float = WATCH_SILENCE_S) -> AsyncGenerator[TaskRecord]:
        """Yield a task's record whenever it changes, until it has ended; survives the loss of gateways.

        Changes are pushed. The record is asked for only after `silence_s` without a push of the record or a sign of
        life of a run, in case a push was missed.
        """
        queue: asyncio.Queue[TaskRecord | None] = asyncio.Queue()
        session, keys = self.plane.session, self.plane.keys
        closers = (
            session.subscribe_typed(keyspace.TASK_UPDATE, lambda _, record: queue.put_nowait(record), task),
            session.subscribe(keys(keyspace.RUN_EVENT, task), lambda _: queue.put_nowait(None)),
        )
        try:
            last: TaskRecord | None = None
            silent = 0
            queue.put_nowait(await self.task(task))
            while last is None or not last.state.final:
                try:
                    async with asyncio.timeout(silence_s):
                        record = await queue.get()
                except TimeoutError:
                    try:
                        record = await self.task(task)
                        silent = 0
                    except SwiftbotError:
                        silent += 1
                        if silent > MOST_SILENT:
                            raise
                        continue
                if record is not None and (last is None or _news(last, record)):
                    last = record
                    yield record
        finally:
            for closer in closers:
                closer.close()

    async def stream(self, task: str, *, since_s: float | None = None) -> AsyncGenerator[Line]:
        """Yield what happens to a task, from all gateways in one order, until it has ended.

        Progress, log lines of handlers and of gateways, figures, what the monitor finds and does. What is still known
        of the past comes first; the queue is bounded, and what it drops is noted in the stream.

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
            async with contextlib.aclosing(self.watch(task)) as changes:
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

    def on_alert(self, take: "asyncio.Queue[Alert]") -> None:
        """Have each change of an alert put into a queue; with `cleared_ns` it is over."""
        self.plane.session.subscribe_typed(keyspace.ALERT, lambda _, alert: take.put_nowait(alert) if alert else None)

    def on_notice(self, take: "asyncio.Queue[Notice]") -> None:
        """Have notices to people put into a queue, each once: both sides of a partition may have given it."""
        once = Deduplicator()

        def heard(_: str, notice: Notice | None) -> None:
            if notice is not None and once.new(notice.id):
                take.put_nowait(notice)

        self.plane.session.subscribe_typed(keyspace.NOTICE, heard)

    def on_run(self, task: str, take: "asyncio.Queue[RunEvent]") -> None:
        """Have the events of a task's runs put into a queue."""
        self.plane.session.subscribe_typed(
            keyspace.RUN_EVENT, lambda _, event: take.put_nowait(event) if event else None, task
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

    @staticmethod
    async def by_words(client: SteeringCalls, text: str) -> "Stopped | None":
        """Carry an instruction out that says to stop; None when it does not. Errors as `carry_out`."""
        if not mentions_stop(text):
            return None
        there = False
        with contextlib.suppress(UnreachableError):
            await client.gateway()
            there = True
        if (stop := stop_request(text, roster_of(client))) is None:
            return None
        # Without a gateway the names are unknown: then all robots that hear it stop.
        names = (*stop.robots, *(stop.unknown if there else ()))
        return await Stopped.carry_out(client, names, why=text)

    @property
    def confirmed(self) -> bool:
        """Whether every robot that was meant is stopped and every gateway keeps it."""
        return not self.unknown and self.answer is not None and not (self.answer.silent or self.answer.problems)

    def as_json(self) -> dict[str, Any]:
        """Return what `--json` prints: the answer's fields, and the names that no robot has."""
        answer = self.answer or StopAnswer(stops=())
        return {name: getattr(answer, name) for name in answer.__struct_fields__} | {"unknown": self.unknown}

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
        "no soft stop is in force"
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
