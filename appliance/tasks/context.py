"""What a coordinator needs of its gateway, and what it is told: the seam between driving a task and the world."""

import asyncio
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

from msgspec import Struct

from appliance.errors import RefusedError, SwiftbotError
from appliance.model import (
    Group,
    Need,
    Plan,
    RunAccepted,
    RunEvent,
    RunRequest,
    SoftStop,
    SubtaskRecord,
    TaskRecord,
    Word,
)
from appliance.plane.node import Plane
from appliance.skills.catalogue import SkillManifest
from appliance.tasks.api import ApproveAsk, PauseAsk, RejectAsk, ResumeAsk, RetryAsk
from appliance.tasks.checkpoints import Checkpoint
from appliance.tasks.placement import Place, Placement
from appliance.tasks.records import MAX_RUN_S
from appliance.tasks.replan import Robots
from appliance.tasks.settings import TasksConfig
from appliance.tasks.transition import Transition

PREFIX = "task/"
"""Of the keys of task records in the DHT."""


class Recovering(Protocol):
    """What finding runs that go wrong and revising plans needs; `tasks.recovery` provides it."""

    @property
    def manifests(self) -> Mapping[str, SkillManifest]:
        """Manifests by skill, of those known here."""
        ...

    def robots(self) -> Robots:
        """Return the roster as it is known now."""
        ...

    def experience(self, skill: str) -> Sequence[float]:
        """Return how long the last runs of a skill took, seconds."""
        ...

    def published(self, transition: Transition) -> None:
        """Hear of a transition that was published."""
        ...

    def note(self, what: str, record: TaskRecord, target: SubtaskRecord, why: str) -> None:
        """Count what was found or done, and say it in the log."""
        ...

    def against(self, record: TaskRecord, target: SubtaskRecord, plan: Plan, robot: str = "") -> tuple[str, ...]:
        """Say what a revised plan makes wrong that was not wrong before; `robot`: who takes over from `target`'s."""
        ...

    async def replan(self, record: TaskRecord) -> Plan:
        """Have the decomposer plan anew what is left; PlanError when it cannot."""
        ...


class Commands(Protocol):
    """What is known of who may command robots; `robots.authority` provides it."""

    @property
    def active(self) -> tuple[SoftStop, ...]:
        """Soft stops in force."""
        ...

    def holds(self, stop: SoftStop, robot: str) -> bool:
        """Whether a soft stop is in force for a robot."""
        ...

    def ended(self, stop: str, robots: Sequence[str]) -> bool:
        """Whether a soft stop is known to hold none of those robots any more."""
        ...

    def hindrance(self, robot: str) -> str:
        """Why tasks may not command a robot just now; empty when they may."""
        ...


class _Free:
    """Nobody stops a robot, or has taken one over."""

    active: tuple[SoftStop, ...] = ()

    def holds(self, stop: SoftStop, robot: str) -> bool:  # noqa: ARG002 - as Commands has it
        """No."""
        return False

    def ended(self, stop: str, robots: Sequence[str]) -> bool:  # noqa: ARG002 - as Commands has it
        """Not that it were known."""
        return False

    def hindrance(self, robot: str) -> str:  # noqa: ARG002 - as Commands has it
        """Nothing."""
        return ""


FREE: Commands = _Free()
"""For a task manager without robots."""


class Surroundings(Protocol):
    """What a driver needs of its gateway; the coordinator provides it."""

    plane: Plane
    config: TasksConfig

    @property
    def recovery(self) -> Recovering:
        """What finding runs that go wrong and revising plans needs."""
        ...

    @property
    def commands(self) -> Commands:
        """Who may command robots."""
        ...

    def approval(self, record: TaskRecord, plan: Plan) -> str:
        """Why a plan has to be approved before it takes effect; "" when it need not be."""
        ...

    def plan_problems(self, record: TaskRecord, plan: Plan) -> tuple[str, ...]:
        """What is wrong with an edited plan in place of the one that waits, a sentence each."""
        ...

    async def plan(self, record: TaskRecord) -> Plan:
        """Return a valid plan, the one handed in with the task or a new one; PlanError otherwise."""
        ...

    def manifest(self, skill: str) -> SkillManifest:
        """Return a skill's manifest; NotFoundError when this gateway does not know it."""
        ...

    def bind(self, record: TaskRecord, target: SubtaskRecord) -> tuple[str | None, str]:
        """Choose the robot of a subtask, or None with the reason for the wait."""
        ...

    def place(self, record: TaskRecord, target: SubtaskRecord, robot: str | None) -> Placement:
        """Order the gateways for a subtask."""
        ...

    def regroup(self, record: TaskRecord) -> Group | None:
        """Return the group that a task should have from now on, or None when the present one may stay."""
        ...

    def sent(self, record: TaskRecord, target: SubtaskRecord, placement: Placement) -> None:
        """Tell, for the log, how the gateways stood when a subtask was sent."""
        ...

    def turn(self, record: TaskRecord, target: SubtaskRecord, placement: Placement, left_s: float) -> Place:
        """Return where a ready subtask may go now, or its place among those that wait for room."""
        ...

    def expect(self, plan: Plan, *, deadline_s: float, elapsed_s: float) -> str:
        """Say in words what a plan must expect: a wait, a deadline that can hardly be met; "" when nothing."""
        ...

    async def order(self, gateway: str, request: RunRequest) -> RunAccepted:
        """Send a run order, to this gateway without a detour."""
        ...

    def plan_moved(self, record: TaskRecord, running_s: Mapping[str, float]) -> None:
        """Tell pools what the subtasks that are not ready will need; `running_s`: how long each active one has."""
        ...

    def took(self, skill: str, duration_ms: float) -> None:
        """Note how long a run that succeeded took."""
        ...

    async def checkpoint(self, task: str, subtask: str) -> Checkpoint | None:
        """Return the last checkpoint of a subtask, or None when there is none or it cannot be had."""
        ...

    async def forget_checkpoints(self, record: TaskRecord) -> None:
        """Remove the checkpoints of a task that has ended."""
        ...


class RunNews(Struct, frozen=True):
    """A run event came."""

    event: RunEvent


class GatewayLost(Struct, frozen=True):
    """A gateway is gone."""

    gateway: str


class CancelAsked(Struct, frozen=True):
    """Somebody wants it to stop."""

    word: Word | None = None


class Wake(Struct, frozen=True):
    """Look again: a timer, a new robot, a new gateway."""


class MoveReady(Struct, frozen=True, kw_only=True):
    """A run can be left for a new attempt elsewhere: its gateway holds it, the other one is ready to take it.

    `outcome` becomes the new attempt's number when the record with it is written; an error says why it was not.
    """

    subtask: str
    attempt: int
    next_attempt: int
    gateway: str
    why: str
    placed: str
    outcome: "asyncio.Future[int]"

    def give_up(self, reason: str) -> None:
        """Say that it cannot be any more."""
        if not self.outcome.done():
            self.outcome.set_exception(RefusedError(reason))

    def done(self) -> None:
        """Say that the record is written."""
        if not self.outcome.done():
            self.outcome.set_result(self.next_attempt)


class PlanMade(Struct, frozen=True, kw_only=True):
    """The decomposer has answered: the new plan, or None; `why` it was asked, and what it said."""

    subtask: str
    plan: Plan | None
    why: str


class Steered(Struct, frozen=True, kw_only=True):
    """An operator's order. `outcome` becomes the record when it is written with what followed, or says why not."""

    ask: ApproveAsk | RejectAsk | PauseAsk | ResumeAsk | RetryAsk
    outcome: "asyncio.Future[TaskRecord]"

    def refuse(self, error: SwiftbotError) -> None:
        """Say why it was not taken."""
        if not self.outcome.done():
            self.outcome.set_exception(error)

    def done(self, record: TaskRecord) -> None:
        """Say that it is written."""
        if not self.outcome.done():
            self.outcome.set_result(record)


class RunHeld(Struct, frozen=True, kw_only=True):
    """A run has saved a checkpoint and sends no command: it can be ended for a pause (`note`: why)."""

    subtask: str
    attempt: int
    note: str


Input = RunNews | GatewayLost | CancelAsked | MoveReady | PlanMade | Steered | RunHeld | Wake


def figures(plane: Plane, gateway: str) -> dict[str, Any]:
    """What is known of a gateway that is chosen, for the attempt's record: its load and its ready containers."""
    status = plane.registry.gateways.get(gateway)
    return {"load": round(status.load, 3), "free": status.ready} if status is not None else {}


def task_key(task: str) -> str:
    """Key of a task's record in the DHT."""
    return f"{PREFIX}{task}"


def need_of(manifest: SkillManifest) -> Need:
    """What a skill asks of a container."""
    return Need(image=manifest.image, cpu=manifest.cpu, memory_mb=manifest.memory_mb, volumes=manifest.volumes)


def deadline_s(manifest: SkillManifest, params: dict[str, Any]) -> float:
    """Time a run may take: the skill's own, beyond the duration that was asked for (within bounds)."""
    asked = params.get("duration_s", 0.0)
    # Compared before it becomes a float: an integer of a plan may be too large for one.
    extra = min(MAX_RUN_S, max(0.0, asked)) if isinstance(asked, int | float) and asked == asked else 0.0  # noqa: PLR0124 - not a number
    return manifest.timeout_s + float(extra)
