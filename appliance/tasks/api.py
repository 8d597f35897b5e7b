"""The RPC interface of tasks: the request and reply structs of its verbs.

The command line, the terminal UI and other gateways speak through these alone; `docs/keyspace.md` lists the
verbs. Requests refuse unknown fields, so that a typing error is an error and not a silent default.

Moving runs, between gateways:

    migrate, migrate_here    MigrateAsk -> Migrated        move one run; `migrate_here` at the task's coordinator
    migrate_cancel           MoveAsk -> MoveCancelled      call off a move that is under way
    run_hold                 HoldAsk -> Held               make a run ready to be left: no commands, a fresh checkpoint
    run_resume               RunAsk -> RunStatus           it stays after all
    run_leave                RunAsk -> RunStatus           it was moved: end it; answers when it has ended
    run_reserve              RunRequest -> Reserved        have a container ready for a run that will be moved here
    run_unreserve            RunAsk -> RunStatus           it will not come
    drain                    DrainAsk -> DrainState        give all runs away and take no more; answers at once
    undrain                  UndrainAsk -> DrainState      take runs again
    drain_state              DrainStateAsk -> DrainState   how far it is

Operators' orders, at any gateway (`here` is for gateways among themselves):

    approve      ApproveAsk -> TaskRecord       let a plan that waits take effect, as it is or edited
    reject       RejectAsk -> TaskRecord        turn it down
    plan_check   PlanCheckAsk -> PlanChecked    what is wrong with a plan, and its hash; runs nothing
    pause        PauseAsk -> TaskRecord         start no further subtask
    resume       ResumeAsk -> TaskRecord        go on
    retry        RetryAsk -> TaskRecord         try again what has failed; what has succeeded is kept
    cancel       CancelTaskAsk -> TaskRecord    stop it
    answer       AnswerAsk -> Enquiry           answer a question of a skill or robot; the first answer counts
    enquiries    EnquiriesAsk -> EnquiryList    the questions that wait for an answer
    acts         ActsAsk -> ActList             what operators ordered of the asked gateway lately
"""

from enum import StrEnum
from typing import Annotated

from msgspec import Meta, Struct

from appliance.llm.analysis import Analysis
from appliance.llm.experience import Row
from appliance.model import Act, ContainerInfo, Enquiry, Need, Phase, Plan, RunEvent, Signed, TaskRecord, TierAttempt
from appliance.tasks.lines import Line


class TaskAsk(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`task`: which task."""

    id: str


class TasksAsk(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`tasks`: how many at most, newest first. `local` asks for the records of the answering gateway's shard alone."""

    limit: int = 100
    local: bool = False


class TaskList(Struct, frozen=True, kw_only=True):
    """Task records, newest first; `unreachable` names gateways that did not answer in time."""

    tasks: tuple[TaskRecord, ...]
    unreachable: tuple[str, ...] = ()


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


class RunAsk(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
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


class HoldAsk(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
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
