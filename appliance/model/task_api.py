"""Requests and replies of the verbs that have to do with tasks, and the lines of a task's stream.

The command line, the terminal UI and other gateways speak through these alone. Requests refuse unknown fields, so that
a typing error is an error and not a silent default.
"""

from enum import StrEnum
from typing import Annotated, Any

from msgspec import Meta, Struct, field

from appliance.model import (
    PLAIN_PRIORITY,
    Act,
    Choice,
    ContainerInfo,
    Enquiry,
    Failure,
    Group,
    Need,
    Phase,
    Plan,
    RunEvent,
    Signed,
    TaskRecord,
    TierAttempt,
)
from appliance.model.planner_api import Analysis, Row


class LineKind(StrEnum):
    """What a line tells."""

    STATE = "state"
    """The record has changed: an input of the task's state machine, by its coordinator."""
    MONITOR = "monitor"
    """The same, where the monitor or replanning has found or done something."""
    PROGRESS = "progress"
    LOG = "log"
    """A line of a handler."""
    GATEWAY = "gateway"
    """A log line of a gateway about the task."""
    PARTIAL = "partial"
    CHECKPOINT = "checkpoint"
    METRICS = "metrics"
    """How long it took to start and to run, CPU time, memory, container, phase."""
    NOTICE = "notice"
    """A message to a person."""
    DROPPED = "dropped"
    """So many lines are missing here."""


class Line(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One line of a task's stream."""

    kind: LineKind
    task: str
    at_ns: int
    """Unix nanoseconds by the clock of the gateway that said it; in a merged stream by the reader's own."""
    gateway: str = ""
    subtask: str = ""
    attempt: int = 0
    level: str = "info"
    text: str = ""
    fields: dict[str, Any] = field(default_factory=dict[str, Any])
    source: str = ""
    """Who counts `number`: a run, a gateway's log, the record."""
    number: int = 0

    @property
    def key(self) -> tuple[str, str, int, int]:
        """What tells one line from another, however it came, before its time was brought to the reader's clock."""
        return (self.gateway, self.source, self.number, self.at_ns)

    @property
    def counted(self) -> bool:
        """Whether its source counts nothing but lines of this stream, so that a number left out is a line missed."""
        return self.source.startswith("run ")


class AttemptWhy(Struct, frozen=True, kw_only=True):
    """One attempt; `choice` is None where it was never served, or by a version that did not tell."""

    number: int
    gateway: str
    container: str | None
    phase: str | None
    placed: str
    """Why this gateway was asked first: coarse scores, best first."""
    choice: Choice | None
    """Which gateway decided, and what it weighed."""
    failure: Failure | None


class CandidateWhy(Struct, frozen=True, kw_only=True):
    """A gateway with its coarse score for a subtask, or why it is no candidate."""

    gateway: str
    score: float | None = None
    excluded: str = ""


class Waits(Struct, frozen=True, kw_only=True):
    """What a subtask that has not ended waits for, as its coordinator knows it just now."""

    reason: str
    at: str = ""
    """The gateway in whose queue it is; empty: it is with its coordinator."""
    position: int = 0
    """Its place in that queue or among those that wait for room, from 1; 0: in none."""
    waiting: int = 0
    expected_s: float | None = None
    """In how many seconds it is expected to start; None: not known."""
    candidates: tuple[CandidateWhy, ...] = ()
    """The best first, then those that cannot serve it."""


class SubtaskWhy(Struct, frozen=True, kw_only=True):
    """A subtask with its attempts; `note` says what one without any waits for."""

    id: str
    skill: str
    state: str
    note: str
    attempts: tuple[AttemptWhy, ...]
    waits: Waits | None = None
    """None where it has ended, or the coordinator was not asked."""


class TaskWhy(Struct, frozen=True, kw_only=True):
    """A task with the reasons for where its subtasks ran."""

    id: str
    state: str
    coordinator: str
    subtasks: tuple[SubtaskWhy, ...]
    submitter: str = ""
    priority: int = PLAIN_PRIORITY
    deadline_s: float = 0.0
    left_s: float | None = None
    """Seconds until its deadline; None without one, or where the coordinator was not asked."""
    note: str = ""
    """What it had to expect when it was accepted and planned."""
    group: Group | None = None
    """The gateways that serve it, its root, and how that came about."""
    waits: str = ""
    """What the task or subtasks of it wait for: an operator's approval, the end of a pause, a robot that was lost."""
    done: str = ""
    """Of a task whose record was trimmed: when it was done, and where its details are."""


class TaskAsk(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`task`: which task."""

    id: str


class TasksAsk(Struct, frozen=True, kw_only=True, omit_defaults=True, forbid_unknown_fields=True):
    """`tasks`: how many at most, newest first. `local` asks for the records of the answering gateway's shard alone.

    The others are filters; a task that is meant matches all that are given.
    """

    limit: int = 100
    local: bool = False
    status: Annotated[tuple[str, ...], Meta(max_length=16)] = ()
    """States, of the state machine or as people see them (`tasks.views.status`); any of them."""
    robot: Annotated[str, Meta(max_length=120)] = ""
    """A robot of one of its subtasks."""
    by: Annotated[str, Meta(max_length=120)] = ""
    """Who submitted it, without regard to case."""
    since_ns: int = 0
    """Accepted then or later, Unix nanoseconds."""
    text: Annotated[str, Meta(max_length=400)] = ""
    """Part of its id, instruction or failure, without regard to case."""
    before_ns: int = 0
    """With `before`, the last task of a page: only older ones. `created_ns` of that task; 0: from the newest."""
    before: Annotated[str, Meta(max_length=120)] = ""
    """The id of that task."""
    remembered: bool = False
    """Also tasks of which only the outcome is remembered: without plan, robots and results."""


class TaskList(Struct, frozen=True, kw_only=True):
    """Task records, newest first; `unreachable` names gateways that did not answer in time."""

    tasks: tuple[TaskRecord, ...]
    unreachable: tuple[str, ...] = ()
    more: bool = False
    """Whether there are older ones that match: ask again with `before`."""


class TaskLinesAsk(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`task_lines`: the last lines that the asked gateway has said about a task."""

    task: str
    limit: int = 1000


class TaskLines(Struct, frozen=True, kw_only=True):
    """Lines, oldest first; `now_ns` is the gateway's clock, `dropped` how many it has forgotten or left out."""

    gateway: str
    now_ns: int
    lines: tuple[Line, ...] = ()
    dropped: int = 0


class PlanAsk(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`plan`: decompose, run nothing."""

    instruction: str
    private: bool = False
    """The text must not leave the asked gateway."""


class PlanAnswer(Struct, frozen=True, kw_only=True):
    """A valid plan and what each tier that was asked made of the instruction."""

    plan: Plan
    attempts: tuple[TierAttempt, ...] = ()
    analysis: Analysis | None = None
    """What it asks for: parameters with units, constraints, who can do it, which containers it will need."""


class ExperienceAsk(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`experience`: how have skills done on robots lately, by what this gateway has heard?"""

    limit: int = 200


class ExperienceList(Struct, frozen=True, kw_only=True):
    """The least reliable pairs of skill and robot first, and the thresholds that experience has moved."""

    gateway: str
    rows: tuple[Row, ...]
    thresholds: dict[str, float] = {}
    """Tier -> confidence from which its plans run unasked."""


class RunAsk(Struct, frozen=True, kw_only=True):
    """`run_status` and `run_cancel`: which attempt of which subtask."""

    task: str
    subtask: str
    attempt: int

    @property
    def run_id(self) -> str:
        """`task/subtask/attempt`."""
        return f"{self.task}/{self.subtask}/{self.attempt}"


class RunStatus(Struct, frozen=True, kw_only=True):
    """Whether a gateway runs that attempt now, and the last of its events that it keeps (`None`: never heard of it)."""

    running: bool
    last: RunEvent | None = None
    silent_s: float | None = None
    """Seconds since the run's last sign of life, by that gateway's own clock; None when it does not run there."""
    position: int = 0
    """Its place among those who wait for a container there, from 1; 0: it does not."""
    queue: int = 0
    """How many wait there."""
    expected_s: float | None = None
    """In how many seconds it may have one; None: not known."""


class WhyAsk(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`why`: what does a task wait for, or one of its subtasks? `here` asks the coordinator itself."""

    id: str
    subtask: str = ""
    here: bool = False


class SiteAsk(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`site`: what do names of places mean here? Answered with the Site."""


class SkillsAsk(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`skills`: which skills does this gateway know?"""


class SkillList(Struct, frozen=True, kw_only=True):
    """The skills that can be run, and the digest of them that stands in the gateway's status."""

    digest: str
    skills: tuple[str, ...]


class ContainerList(Struct, frozen=True, kw_only=True):
    """`find_containers`: ready containers that the asked gateway knows for a need, its own and others'."""

    containers: tuple[ContainerInfo, ...]


class ArtifactAsk(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`artifact`: a piece of a stored file, by its SHA-256."""

    artifact: str
    offset: int = 0
    length: int = 1 << 20


class ArtifactPiece(Struct, frozen=True, kw_only=True):
    """A piece of a stored file; `size` is that of the whole."""

    data: bytes
    size: int


class ArtifactKeep(Struct, frozen=True, kw_only=True):
    """`artifact_keep`: fetch a file from a gateway that has it and keep it for an owner, the key of a record."""

    artifact: str
    source: str
    owner: str


class ArtifactKept(Struct, frozen=True, kw_only=True):
    """That a file is kept, and where."""

    artifact: str
    gateway: str


class Reason(StrEnum):
    """Why a run is to leave its gateway."""

    OVERLOAD = "overload"
    DRAIN = "drain"
    OPERATOR = "operator"


class MigrationRequest(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Step 1 of the paper's migration, put by the gateway that wants runs moved away from it."""

    reason: Reason
    node: str
    """That gateway."""
    operation: str = "relocate"
    num_containers: int = 0
    """How many containers are to be found elsewhere: one for each run."""
    requirements: tuple[Need, ...] = ()
    """What each of them must offer."""
    runs: tuple[RunAsk, ...] = ()
    why: str = ""
    """The figures behind it, in words."""
    at_ns: int = 0


class MigrateAsk(Signed, frozen=True, kw_only=True):
    """`migrate`: move a subtask's run, to `to` or wherever is best."""

    task: str
    subtask: str
    attempt: int = 0
    """Only this attempt; 0: whichever runs."""
    to: str = ""
    reason: Reason = Reason.OPERATOR
    why: str = ""


class Weighed(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A gateway as a target of a move: its score (0 to 1), or why it is none."""

    gateway: str
    score: float = 0.0
    verdict: str = ""


class Migrated(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What came of a move. `moved`: the record says so; then the run is ended on `source` and goes on on `target`."""

    task: str
    subtask: str
    moved: bool
    source: str = ""
    target: str = ""
    attempt: int = 0
    """Its attempt from now on."""
    why: str = ""
    """How the target was found; or why it was not moved, and what became of it."""
    checkpoint: str = ""
    """What the new attempt goes on from: `fresh`, `last` or nothing."""
    started: bool = False
    """Whether its first line has run there by now."""
    took_ms: float = 0.0
    steps_ms: dict[str, float] = {}
    """By step."""
    considered: tuple[Weighed, ...] = ()


class MoveAsk(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`migrate_cancel`: which subtask is not to be moved after all."""

    task: str
    subtask: str


class MoveCancelled(Struct, frozen=True, kw_only=True):
    """Whether there was a move to call off; one whose record is written is done."""

    cancelled: bool


class HoldAsk(Struct, frozen=True, kw_only=True):
    """`run_hold`: an attempt that is about to be moved."""

    task: str
    subtask: str
    attempt: int


class Held(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """It is held for `hold_s` seconds, in which it sends no robot commands. `began`: its handler had."""

    began: bool
    fresh: bool = False
    """Whether it has saved a checkpoint for this."""
    saved: bool = False
    """Whether it has ever saved one."""
    hold_s: float = 0.0


class Reserved(Struct, frozen=True, kw_only=True):
    """A container is held for the run for `lease_s` seconds."""

    gateway: str
    container: str
    phase: Phase
    lease_s: float


class DrainAsk(Signed, frozen=True, kw_only=True):
    """`drain`: give all runs away. After `deadline_s` those left are cancelled and repeated elsewhere; 0: never."""

    deadline_s: float = 0.0


class DrainStateAsk(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`drain_state`."""


class UndrainAsk(Signed, frozen=True, kw_only=True):
    """`undrain`."""


class Remaining(Struct, frozen=True, kw_only=True):
    """A run that is still there, and what it waits for."""

    run: str
    skill: str
    why: str


class DrainState(Struct, frozen=True, kw_only=True):
    """How far a gateway is with giving its runs away. `done`: none is left."""

    gateway: str
    draining: bool
    done: bool
    moved: int
    ended: int
    """Runs that ended there meanwhile by themselves."""
    left: tuple[Remaining, ...] = ()
    elapsed_s: float = 0.0
    deadline_s: float = 0.0


MAX_ANSWER = 2000


class ApproveAsk(Signed, frozen=True, kw_only=True):
    """`approve`: the plan with that hash (8 characters of it at least), or `plan` in its place.

    Without a hash whatever waits is approved: for programs that have just read the record.
    """

    id: str
    hash: Annotated[str, Meta(max_length=64)] = ""
    plan: Plan | None = None
    """The plan as edited; checked like any plan before it is taken."""
    here: bool = False


class RejectAsk(Signed, frozen=True, kw_only=True):
    """`reject`: a task whose first plan is turned down is cancelled, one with a new plan after a failure fails."""

    id: str
    hash: Annotated[str, Meta(max_length=64)] = ""
    here: bool = False


class PlanCheckAsk(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`plan_check`: is this plan valid just now; with a task, in place of the one that waits there?"""

    plan: Plan
    task: str = ""


class PlanChecked(Struct, frozen=True, kw_only=True):
    """What is wrong with the plan, a sentence each; its hash; and why it would have to be approved, if it would."""

    problems: tuple[str, ...]
    hash: str
    approval: str = ""


class PauseAsk(Signed, frozen=True, kw_only=True):
    """`pause`: no subtask is started. With `hold`, runs whose skill saves checkpoints are ended and go on from there.

    Others go on to their end; the notes of the subtasks say which do what.
    """

    id: str
    hold: bool = False
    here: bool = False


class ResumeAsk(Signed, frozen=True, kw_only=True):
    """`resume`: takes an operator's pause back; one by a soft stop ends with that."""

    id: str
    here: bool = False


class RetryAsk(Signed, frozen=True, kw_only=True):
    """`retry`: a task that failed or was cancelled, or one subtask of a task that goes on. New attempts are fenced."""

    id: str
    subtask: str = ""
    here: bool = False


class FirstAsk(Signed, frozen=True, kw_only=True):
    """`first`: a task goes before the others that wait for its robots, or right before the one that is named."""

    id: str
    before: str = ""
    here: bool = False


class CancelTaskAsk(Signed, frozen=True, kw_only=True):
    """`cancel`, `cancel_here`: which task."""

    id: str


class AnswerAsk(Signed, frozen=True, kw_only=True):
    """`answer`: to the question of that id."""

    id: str
    answer: Annotated[str, Meta(max_length=MAX_ANSWER)]


class EnquiriesAsk(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`enquiries`: of the fleet, or (`local`) those whose records the asked gateway owns."""

    local: bool = False


class EnquiryList(Struct, frozen=True, kw_only=True):
    """Open questions, oldest first; `unreachable` names gateways that did not answer in time."""

    enquiries: tuple[Enquiry, ...]
    unreachable: tuple[str, ...] = ()


class ActsAsk(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`acts`: how many at most, newest first."""

    limit: int = 100


class ActList(Struct, frozen=True, kw_only=True):
    """Orders of operators, newest first."""

    acts: tuple[Act, ...]


class Decided(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What the published decisions of a gateway have in common: `placement`, `selection`, `eviction`, `way`, ..."""

    task: str = ""
    subtask: str = ""
