"""The inputs of the task state machine: what can happen to a task, as it is published and logged."""

import hashlib
from enum import StrEnum
from typing import Any

from msgspec import Struct

from appliance.errors import SwiftbotError
from appliance.model import (
    PLAIN_PRIORITY,
    Approval,
    Choice,
    Decision,
    Failure,
    Group,
    Pause,
    Phase,
    Plan,
    Split,
    TaskRecord,
    Word,
)


class TransitionKind(StrEnum):
    """What happened to a task."""

    ACCEPTED = "accepted"
    PLANNED = "planned"
    PLAN_FAILED = "plan failed"
    ADOPTED = "adopted"
    """Another gateway now coordinates it (takeover)."""
    GROUPED = "grouped"
    """Its dynamic group was formed, or formed again (`group`)."""
    DISPATCHED = "dispatched"
    STARTED = "started"
    PROGRESS = "progress"
    PARTIAL = "partial"
    """A run told a partial result (`result`)."""
    CHECKPOINT = "checkpoint"
    """A checkpoint of a run was kept, from which the next attempt would go on."""
    SUCCEEDED = "succeeded"
    ATTEMPT_FAILED = "attempt failed"
    MOVED = "moved"
    """A run in progress was left for a new attempt on another gateway (`gateway`; `note`: why)."""
    HEALED = "healed"
    """Versions that lost against this one were found (`splits`); their attempts are fenced off (`fences`)."""
    CANCEL = "cancel"
    NOTICED = "noticed"
    """The monitor has found something of a subtask (`condition`, `note`), or says how its replanning stands."""
    REBOUND = "rebound"
    """Another robot (`robot`) takes over what one cannot do any more; `plan` is the plan from now on."""
    SUBSTITUTED = "substituted"
    """An alternative skill takes the place of one that was given up; `plan` is the plan from now on."""
    PROPOSED = "proposed"
    """A plan is there and may have to be approved (`waits`): the first one (no `subtask`), or a new one of the
    decomposer after a failure, as it gave it."""
    APPROVED = "approved"
    """An operator approves what was proposed (`decision`), or another plan in its place (`plan`)."""
    REJECTED = "rejected"
    """An operator turns it down (`decision`)."""
    PAUSED = "paused"
    """No subtask is started from now on (`pause`)."""
    RESUMED = "resumed"
    """A pause has ended: an operator's, or that of the soft stop `pause.stop`."""
    HELD = "held"
    """A run is ended, and its subtask waits for another attempt although nothing was wrong with it (`note`: why)."""
    RETRIED = "retried"
    """An operator has what has failed tried again: a task that has ended, or one `subtask` (`word`)."""
    RANKED = "ranked"
    """An operator puts it before others that wait for the same robot (`priority`, `place_ns`, `word`)."""
    REPLANNED = "replanned"
    """What was proposed takes effect; `plan` is the plan from now on, with all that is finished."""
    REPLAN_FAILED = "replan failed"
    """Nothing could be done about a subtask that was given up: the task fails with its failure."""


class Transition(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One input of the state machine, as published under `task/{id}/transition`. `sequence` counts from 1."""

    task: str
    sequence: int
    kind: TransitionKind
    at_ns: int
    coordinator: str
    instruction: str = ""
    submitter: str = ""
    plan: Plan | None = None
    priority: int = PLAIN_PRIORITY
    place_ns: int = 0
    """On `ranked`: as `TaskRecord.place_ns`."""
    deadline_s: float = 0.0
    within: tuple[str, ...] = ()
    group: Group | None = None
    elapsed_s: float = 0.0
    """Seconds since the task was accepted (see `TaskRecord.elapsed_s`)."""
    subtask: str = ""
    attempt: int = 0
    robot: str | None = None
    others: tuple[str, ...] = ()
    """On `dispatched`: the further robots of a joint skill."""
    gateway: str = ""
    container: str = ""
    phase: Phase | None = None
    startup_ms: float | None = None
    duration_ms: float | None = None
    progress: float = 0.0
    note: str = ""
    result: dict[str, Any] | None = None
    failure: Failure | None = None
    placed: str = ""
    """On `dispatched`: why that gateway."""
    choice: Choice | None = None
    """How the container of the attempt was chosen, on the first transition after that was heard."""
    give_up: bool = False
    """Of a failed attempt: no further one will be made."""
    load: float = 0.0
    """On `dispatched` and `moved`: load of that gateway as the coordinator knew it."""
    free: int = 0
    """On `dispatched` and `moved`: ready containers it had."""
    splits: tuple[Split, ...] = ()
    """On `healed`: all that the record has of them from now on."""
    fences: dict[str, int] = {}
    """On `healed`: by subtask, the highest attempt that may have been made elsewhere."""
    replan: bool = False
    """Of an attempt that is given up: the task goes on, and its plan is to be revised."""
    condition: str = ""
    waits: bool = False
    retries: int | None = None
    """Of a failed attempt: how many more its skill allows, where that is what decided about `give_up`."""
    approval: Approval = Approval.NEVER
    """On `accepted`: what its submitter wanted."""
    expires_s: float = 0.0
    """On `proposed`: how long it waits to be approved."""
    decision: Decision | None = None
    pause: Pause | None = None
    word: Word | None = None
    """On `cancel` and `retried`: who, and why."""
    cpu_ms: float | None = None
    peak_mb: float | None = None
    base: str = ""
    """Of a takeover (`TAKES_OVER`): fingerprint of the record it was applied to. Two coordinators can have written as
    many transitions; a log is checked against the right one."""


TAKES_OVER = (TransitionKind.ADOPTED, TransitionKind.HEALED, TransitionKind.RETRIED)
"""What a coordinator may begin with where another has been: a task that has ended is only healed, or tried again."""


def fingerprint(record: TaskRecord) -> str:
    """Return 16 hexadecimal digits that tell a version of a task from others with as many transitions."""
    parts = [record.id, str(record.sequence), record.coordinator, record.state, str(record.revised)]
    for each in record.subtasks:
        parts += [each.subtask.id, each.state, str(each.attempt), each.gateway, each.bound_robot or "", *each.others]
    return hashlib.blake2b("\0".join(parts).encode(), digest_size=8).hexdigest()


class StaleTransitionError(SwiftbotError):
    """The transition does not fit the record: an outdated attempt, a repeated event, a final task."""

    code = "stale"
