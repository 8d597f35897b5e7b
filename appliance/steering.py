"""What an operator may order of a fleet, as one asks for it: approve, pause, retry, stop robots, take one over, answer.

Every order is signed with the operator's name, carries why and an id of its own, so that one that is repeated because
an answer was lost is still one order; gateways put what came of it on the audit's key (`operator/act/{gateway}`).
"""

import time
import uuid
from collections.abc import Sequence
from typing import Any, TypedDict

import msgspec

from appliance.connection import FleetConnection
from appliance.errors import DeadlineError, PayloadError, RobotError, SwiftbotError, UnreachableError, from_code
from appliance.llm.api import SwapAsk, Swapped
from appliance.model import (
    Act,
    Enquiry,
    Lease,
    Plan,
    RobotReply,
    SoftStop,
    SubtaskState,
    TaskRecord,
    TaskState,
    encode,
)
from appliance.robots.api import (
    LEASE_S,
    DriveAsk,
    GiveAsk,
    RenewAsk,
    ResumeRobotsAsk,
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
    EnquiriesAsk,
    EnquiryList,
    PauseAsk,
    PlanCheckAsk,
    PlanChecked,
    RejectAsk,
    ResumeAsk,
    RetryAsk,
)

STOP_S = 6.0
"""How long a stop waits to be confirmed: by then it has long been put."""
SWAP_S = 300.0
"""Loading a large model from a slow disk, and its self-test."""


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
