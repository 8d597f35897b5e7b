"""The record of a task: its plan, what has become of each subtask, and who served it."""

from typing import Any

from msgspec import Struct

from appliance.model.messages import Failure
from appliance.model.placement import Choice, Phase
from appliance.model.plans import Plan, Subtask
from appliance.model.requests import PLAIN_PRIORITY
from appliance.model.revisions import Proposal, Revision
from appliance.model.states import SubtaskState, TaskState
from appliance.model.steering import Approval, Decision, Pause, Word


class Attempt(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One try at a subtask; `number` fences off late results of earlier tries."""

    number: int
    gateway: str
    container: str = ""
    phase: Phase | None = None
    failure: Failure | None = None
    placed: str = ""
    """Why this gateway: the coarse scores, in words."""
    choice: Choice | None = None
    """Why this container: what the gateway's selection weighed."""
    left: str = ""
    """Why it was left for the next one while nothing was wrong with it: it was moved, and where to."""
    load: float = 0.0
    """Load of the gateway when it was chosen, 0 to 1: concurrent versions are resolved by it."""
    free: int = 0
    """Ready containers it had then, for the same reason."""
    robot: str | None = None
    """The robot it commanded."""
    cpu_ms: float | None = None
    """CPU time of its process and of those it waited for, user and system."""
    peak_mb: float | None = None
    """Most memory its process held at once, what it shares with the waiting container included."""


class SubtaskRecord(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A subtask of the plan and what has become of it. `bound_robot` is the robot in place of `any`."""

    subtask: Subtask
    state: SubtaskState = SubtaskState.WAITING
    bound_robot: str | None = None
    gateway: str = ""
    container: str = ""
    phase: Phase | None = None
    startup_ms: float | None = None
    """Ready to the first line of the handler, on the coordinator's clock."""
    duration_ms: float | None = None
    """First line of the handler to its result."""
    progress: float = 0.0
    note: str = ""
    """What it does or waits for just now."""
    partial: dict[str, Any] | None = None
    """The last partial result that its run told, cut to size; gone once there is a result."""
    checkpoint_ns: int = 0
    """When its last checkpoint was kept, from which the next attempt would go on; 0 when there is none."""
    condition: str = ""
    """What the monitor finds of the current attempt: `stuck` or `straggling`; empty when nothing."""
    instead_of: tuple[str, ...] = ()
    """Skills that were given up in its place before it, oldest first."""
    attempts: tuple[Attempt, ...] = ()
    fence: int = 0
    """Attempts up to this number may have been made by a coordinator whose version lost; the next is above it."""
    result: dict[str, Any] | None = None
    failure: Failure | None = None

    @property
    def attempt(self) -> int:
        """Number of the current attempt, 0 before the first."""
        return self.attempts[-1].number if self.attempts else 0

    @property
    def next_attempt(self) -> int:
        """Number of the attempt after this one: higher than any that was ever made, here or elsewhere."""
        return max(self.attempt, self.fence) + 1


class LostRun(Struct, frozen=True, kw_only=True, omit_defaults=True, order=True):
    """A subtask as a version of a task had it that lost against another."""

    subtask: str
    attempt: int
    gateway: str
    state: SubtaskState


class LostOrder(Struct, frozen=True, kw_only=True, omit_defaults=True, order=True):
    """An operator's order that a version of a task had carried out which lost against another."""

    verb: str
    """`approve`, `reject`, `cancel`, `retry` or `pause`."""
    by: str
    act: str = ""
    """Id of the order in the audit log."""
    at_ns: int = 0


class Split(Struct, frozen=True, kw_only=True, omit_defaults=True, order=True):
    """A version of a task that lost: two coordinators had written it without knowing of each other (a partition)."""

    coordinator: str
    """Whose version it was."""
    sequence: int
    state: TaskState
    runs: tuple[LostRun, ...] = ()
    """Its subtasks that had an attempt: which, where, and what had become of it."""
    orders: tuple[LostOrder, ...] = ()
    """Operators' orders that it had carried out; those the version that stands has not are lost."""
    settled: bool = False
    """Whether its runs have been ended and people told."""
    note: str = ""
    """What that was, in words."""


class Remembered(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Marks a record that was trimmed: only the outcome of the task is kept, so that its id is not done again."""

    log: str = ""
    """Names of the log files that were written when the task ended; empty: not known."""
    request: str = ""
    """Digest of the request; empty: not known."""


class Group(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The dynamic group of a task: the gateways that may serve it (paper, Dynamic Groups).

    `root` is the member that owns the task's key on the ring, or the next one after it: it coordinates the task.
    """

    members: tuple[str, ...]
    """Best first by the score when it was formed."""
    root: str
    number: int = 1
    """Counts the group's formations, so that a change is told from a repetition."""
    why: str = ""
    """How it came to be, with the scores, in words."""


class TaskRecord(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A task as it stands in the DHT under `task/{id}`; its version vector is kept beside it by the store."""

    id: str
    instruction: str
    submitter: str = ""
    priority: int = PLAIN_PRIORITY
    """0 (whenever there is room) to 9 (before all others)."""
    deadline_s: float = 0.0
    """Seconds from acceptance after which it ends as failed, with code `deadline`; 0: none."""
    elapsed_s: float = 0.0
    """Seconds since acceptance at the last transition, each coordinator's by its own monotonic clock, added up."""
    within: tuple[str, ...] = ()
    """The gateways that may serve it, as its submitter wished; empty: any."""
    group: Group | None = None
    """None before the first subtask was placed."""
    note: str = ""
    """What it must expect, as was seen when it was accepted and when it was planned: a wait, a deadline too near."""
    state: TaskState = TaskState.ACCEPTED
    plan: Plan | None = None
    handed_in: bool = False
    """Whether its plan came with it, instead of from the decomposer."""
    subtasks: tuple[SubtaskRecord, ...] = ()
    approval: Approval = Approval.NEVER
    """Whether its submitter wanted its plan approved."""
    proposal: Proposal | None = None
    """A plan that has not taken effect; it may wait for an operator."""
    decision: Decision | None = None
    """The last word of an operator on a plan of it."""
    pauses: tuple[Pause, ...] = ()
    """Why no subtask is started; empty: nothing hinders that."""
    cancelled_by: Word | None = None
    """Who asked to stop it, and why."""
    retried_by: Word | None = None
    """Who had it tried again last, and why."""
    retries: int = 0
    """How often that was, after its end."""
    revisions: tuple[Revision, ...] = ()
    """The latest revisions of its plan, oldest first."""
    revised: int = 0
    """Revisions of its plan so far."""
    replans: int = 0
    """Those of them that the decomposer made."""
    retired: tuple[str, ...] = ()
    """Ids of subtasks that revisions took out: effects are known by them, so they are never given again."""
    failure: Failure | None = None
    coordinator: str = ""
    created_ns: int = 0
    updated_ns: int = 0
    sequence: int = 0
    """Number of transitions applied so far."""
    splits: tuple[Split, ...] = ()
    """Versions that lost against this one, at most 8."""
    remembered: Remembered | None = None
    """Set in a record that was trimmed after its end: plan, subtasks and results are gone."""

    @property
    def paused(self) -> str:
        """Why no subtask is started, in words; empty when nothing hinders that, or it has ended."""
        return "" if self.state.final else "; ".join(dict.fromkeys(each.text for each in self.pauses))

    def of(self, subtask_id: str) -> SubtaskRecord:
        """Return the record of one subtask; KeyError when the plan has none of that id."""
        for record in self.subtasks:
            if record.subtask.id == subtask_id:
                return record
        raise KeyError(subtask_id)
