"""Events that a coordinator takes in, and the instructions that follow: what `decide` and `coordinator` exchange.

An instruction is carried out only when the record that it follows from is written.
"""

import asyncio

from msgspec import Struct

from appliance.errors import SwiftbotError
from appliance.model import Failure, Plan, RunEvent, RunRequest, SubtaskRecord, TaskRecord, Word
from appliance.model.task_api import ApproveAsk, FirstAsk, PauseAsk, RejectAsk, ResumeAsk, RetryAsk, RunStatus
from appliance.tasks.placement import PlacementCase


class RunReported(Struct, frozen=True):
    """A run has published an event."""

    event: RunEvent


class RunChecked(Struct, frozen=True, kw_only=True):
    """The answer to `AskRun`: what a gateway knows of a run; None when it did not answer."""

    subtask: str
    attempt: int
    gateway: str
    status: RunStatus | None


class RunHeld(Struct, frozen=True, kw_only=True):
    """The answer to `HoldRun`: a run has saved a checkpoint and sends no command, so it can be ended (`note`: why)."""

    subtask: str
    attempt: int
    note: str


class GatewayLost(Struct, frozen=True):
    """A gateway has left the fleet."""

    gateway: str


class GatewayRelinked(Struct, frozen=True):
    """What a gateway has put for a moment did not arrive here."""

    gateway: str


class PlanMade(Struct, frozen=True, kw_only=True):
    """The answer to `MakePlan`: a plan, or why there is none."""

    plan: Plan | None
    failure: Failure | None = None


class Replanned(Struct, frozen=True, kw_only=True):
    """The answer to `Replan`: the new plan, or None; `why` it was asked for, and what the decomposer said."""

    subtask: str
    plan: Plan | None
    why: str


class CancelAsked(Struct, frozen=True):
    """Somebody asks for the end of the task."""

    word: Word | None = None


class OperatorAsked(Struct, frozen=True, kw_only=True):
    """An operator's order; `outcome` gets the record when it is written with what followed, or the refusal."""

    ask: ApproveAsk | RejectAsk | PauseAsk | ResumeAsk | RetryAsk | FirstAsk
    outcome: "asyncio.Future[TaskRecord]"


class MoveReady(Struct, frozen=True, kw_only=True):
    """A run can be left for a new attempt elsewhere: its gateway holds it, the other one has reserved a container.

    `outcome` becomes the new attempt's number when the record with it is written; an error says why it was not.
    """

    subtask: str
    attempt: int
    next_attempt: int
    gateway: str
    why: str
    placed: str
    outcome: "asyncio.Future[int]"


class Wake(Struct, frozen=True):
    """Look again: a timer, a new robot, a new gateway."""


Event = (
    RunReported
    | RunChecked
    | RunHeld
    | GatewayLost
    | GatewayRelinked
    | PlanMade
    | Replanned
    | CancelAsked
    | OperatorAsked
    | MoveReady
    | Wake
)  # fmt: skip


class MakePlan(Struct, frozen=True):
    """Have the task planned; answered by `PlanMade`."""


class Replan(Struct, frozen=True, kw_only=True):
    """Have the rest of the task planned again (`why`); answered by `Replanned`."""

    subtask: str
    why: str


class StopPlanning(Struct, frozen=True):
    """Nobody needs the plan any more that is being made."""


class Dispatch(Struct, frozen=True, kw_only=True):
    """Order a run of a gateway."""

    gateway: str
    request: RunRequest
    case: PlacementCase | None = None
    """How the gateways stood, for the log; None when it is not logged."""


class MoveRun(Struct, frozen=True, kw_only=True):
    """End the run that is left, then order its next attempt of another gateway."""

    gateway: str
    request: RunRequest
    left: SubtaskRecord


class CancelRun(Struct, frozen=True):
    """Have a run end, once; its final event follows."""

    run: SubtaskRecord


class EndRun(Struct, frozen=True):
    """Have a run end that the record has left: asked again until its gateway says that it has ended."""

    run: SubtaskRecord


class AskRun(Struct, frozen=True):
    """Ask a run's gateway about it; answered by `RunChecked`."""

    run: SubtaskRecord


class HoldRun(Struct, frozen=True, kw_only=True):
    """Have a run save a checkpoint and send no commands for a moment; answered by `RunHeld` where it does."""

    run: SubtaskRecord
    why: str


class ResumeRun(Struct, frozen=True):
    """Let a run go on that was held."""

    run: SubtaskRecord


class Answer(Struct, frozen=True, kw_only=True):
    """Answer the caller: with the record or the attempt that is written, or with an error."""

    to: OperatorAsked | MoveReady
    error: SwiftbotError | None = None


class Notify(Struct, frozen=True, kw_only=True):
    """Count what the watchdog or replanning found or did, and log it."""

    what: str
    subtask: SubtaskRecord
    why: str


class Measured(Struct, frozen=True, kw_only=True):
    """A run that succeeded took so long."""

    skill: str
    duration_ms: float


Instruction = (
    MakePlan
    | Replan
    | StopPlanning
    | Dispatch
    | MoveRun
    | CancelRun
    | EndRun
    | AskRun
    | HoldRun
    | ResumeRun
    | Answer
    | Notify
    | Measured
)  # fmt: skip
