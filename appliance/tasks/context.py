"""What coordinators decide with: the parts of their gateway, and who may command robots."""

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import structlog
from msgspec import Struct

from appliance.errors import NotFoundError
from appliance.model import Plan, SoftStop, SubtaskRecord, TaskRecord
from appliance.model.transitions import Transition
from appliance.plane.node import Plane
from appliance.skills.catalogue import Catalogue, SkillManifest
from appliance.tasks.admission import expectation, longest_s
from appliance.tasks.lookahead import LookAhead
from appliance.tasks.plans import Plans
from appliance.tasks.records import clean
from appliance.tasks.scheduler import Scheduler
from appliance.tasks.settings import TasksConfig

log = structlog.get_logger(__name__)


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


class Context(Struct, frozen=True, kw_only=True):
    """The parts of one gateway, shared by its coordinators."""

    plane: Plane
    config: TasksConfig
    catalogue: Catalogue
    scheduler: Scheduler
    plans: Plans
    ahead: LookAhead
    commands: Commands = FREE
    on_transition: Callable[[Transition], None] = lambda _: None
    """Gets each transition that is published here."""
    findings: Counter[str]
    """What the watchdog and replanning found and did, by kind, since start."""

    def manifest(self, skill: str) -> SkillManifest:
        """Return a skill's manifest; NotFoundError when this gateway does not know it (another may)."""
        if (found := self.catalogue.skills.get(skill)) is None:
            raise NotFoundError(
                f"{self.plane.gateway} has no skill {clean(skill, 80)!r}", remedy="give all gateways the same skills"
            )
        return found

    def durations(self, skill: str) -> Sequence[float]:
        """Return how long the last runs of a skill took, seconds."""
        return self.ahead.durations.seen(skill)

    def expected_s(self, skill: str, params: dict[str, Any]) -> float:
        """Return how long a run is expected to take, seconds; 0.0 when no run of its skill was seen."""
        durations = self.ahead.durations
        return durations.of(skill, params) if durations.seen(skill) else 0.0

    def expect(self, plan: Plan | None, *, deadline_s: float, elapsed_s: float = 0.0, tasks_before: int = 0) -> str:
        """Say in words what a task must expect: a wait, a deadline that can hardly be met; "" when nothing."""
        line, work_s = self.scheduler.line, None
        if plan is not None:
            durations = self.ahead.durations
            seen = [subtask for subtask in plan.subtasks if durations.seen(subtask.skill)]  # no warning from a guess
            work_s = longest_s(plan, {subtask.id: durations.of(subtask.skill, subtask.params) for subtask in seen})
        return expectation(
            tasks_before=tasks_before,
            waiting=len(line),
            wait_s=line.expected_s(len(line) + 1),
            work_s=work_s,
            deadline_s=deadline_s,
            elapsed_s=elapsed_s,
        )

    def measured(self, skill: str, duration_ms: float) -> None:
        """Note how long a run that succeeded took."""
        self.ahead.durations.add(skill, duration_ms / 1e3)
        self.scheduler.line.completions.ended(duration_ms / 1e3)

    def notify(self, what: str, record: TaskRecord, target: SubtaskRecord, why: str) -> None:
        """Count what the watchdog or replanning found or did, and log it."""
        self.findings[what] += 1
        log.info(
            f"monitor: {what}",
            task=record.id,
            subtask=target.subtask.id,
            attempt=target.attempt,
            skill=target.subtask.skill,
            why=why,
        )
