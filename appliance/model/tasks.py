"""Tasks from request to record: what is asked, states, choice of containers, runs, revisions of plans, records.

A request becomes a record, which holds the plan, what has become of each subtask, and who served it. A run is one
attempt of a subtask on one gateway, as ordered and as it tells of itself; `Need` is what it asks of a container, and
`Choice` how one was chosen for it (paper, Algorithm 1). A revision changes the plan after a failure.
"""

from typing import Annotated, Any

from msgspec import Meta, Struct, field

from appliance.model.messages import Failure, Need, OpenEnum
from appliance.model.plans import Plan, Subtask
from appliance.model.steering import Approval, Decision, Pause, Word

PLAIN_PRIORITY = 5
"""Priority of what nobody gave one: as much room above it as below."""
HIGHEST_PRIORITY = 9
LONGEST_DEADLINE_S = 30 * 86_400.0
"""Beyond a month a deadline is no deadline; a bound keeps sums of seconds exact."""


class TaskRequest(Struct, frozen=True, kw_only=True, omit_defaults=True, forbid_unknown_fields=True):
    """A person's or robot's wish. `id` makes a repeated submission the same task; `plan` skips planning."""

    instruction: str
    id: str = ""
    submitter: str = ""
    plan: Plan | None = None
    priority: Annotated[int, Meta(ge=0, le=HIGHEST_PRIORITY)] = PLAIN_PRIORITY
    """0 (whenever there is room) to 9 (before all others)."""
    deadline_s: Annotated[float, Meta(ge=0, le=LONGEST_DEADLINE_S)] = 0.0
    """Seconds from acceptance after which it is of no use any more and ends as failed; 0: none."""
    group: Annotated[tuple[str, ...], Meta(max_length=64)] = ()
    """Gateways that alone may serve it, by id; empty: whichever can."""
    approval: Approval = Approval.NEVER
    """Whether an operator is to approve its plan before anything runs; the gateway's own setting may ask for more."""


class TaskState(OpenEnum):
    """Life of a task. The last three are final."""

    ACCEPTED = "accepted"
    """Durable, not yet planned."""
    PROPOSED = "proposed"
    """Planned; its plan waits for an operator's approval, and nothing runs."""
    RUNNING = "running"
    CANCELLING = "cancelling"
    """Somebody asked to stop it; runs are being ended."""
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"

    @property
    def final(self) -> bool:
        """Whether nothing will follow."""
        return self in (TaskState.SUCCEEDED, TaskState.FAILED, TaskState.CANCELLED)


class SubtaskState(OpenEnum):
    """Life of a subtask. The last three are final."""

    WAITING = "waiting"
    """Its predecessors have not all succeeded."""
    READY = "ready"
    """Could start now; waits for a place (robot, gateway, retry delay)."""
    DISPATCHED = "dispatched"
    """Attempt written to the record and sent to a gateway."""
    RUNNING = "running"
    """Its handler has run its first line."""
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"

    @property
    def final(self) -> bool:
        """Whether nothing will follow."""
        return self in (SubtaskState.SUCCEEDED, SubtaskState.FAILED, SubtaskState.CANCELLED)


class Phase(OpenEnum):
    """Which phase of container selection served a subtask (paper, Algorithm 1)."""

    LOCAL_WARM = "local warm"
    REMOTE_WARM = "remote warm"
    COLD = "cold"


class Way(OpenEnum):
    """How a container comes to serve a subtask; the cheaper of the last two is taken (algorithms: selection)."""

    HERE = "here"
    """It is on the gateway that decides, with the state the subtask asks for."""
    RUN_THERE = "run there"
    """The subtask goes to the container: input bytes / bandwidth + round trip."""
    BRING_HERE = "bring here"
    """State volumes come to a container here: state bytes / bandwidth + serialise + deserialise + start."""
    NEW = "new"
    """A cold start."""


class Considered(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One possibility that a selection weighed. `verdict` says in words why it was (not) taken."""

    gateway: str
    container: str = ""
    image: str = ""
    way: Way = Way.HERE
    score: float = 0.0
    cost_ms: float = 0.0
    taken: bool = False
    verdict: str = ""


class Choice(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """How a container was selected for an attempt, kept in the task's record for `swiftbot pool why`."""

    phase: Phase
    way: Way
    by: str
    """The gateway that decided."""
    gateway: str
    container: str = ""
    cold_ms: float = 0.0
    """What a cold start was expected to cost there and then."""
    considered: tuple[Considered, ...] = ()
    """The best ones first, at most 12."""
    why: str = ""


class RevisionKind(OpenEnum):
    """How a plan was changed after a failure, cheapest first."""

    ROBOT = "robot"
    """Another robot does what one cannot do any more."""
    SKILL = "skill"
    """A skill that its manifest names as an alternative takes the place of one that was given up."""
    PLAN = "plan"
    """The decomposer has replanned what was left."""


class Dropped(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A subtask that a revision took out of the plan, as it stood then."""

    id: str
    skill: str
    robot: str | None = None
    state: SubtaskState = SubtaskState.WAITING
    failure: Failure | None = None


class Revision(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A change of a task's plan after a failure. Finished subtasks are in every plan of a task."""

    number: int
    """Counts a task's revisions from 1."""
    kind: RevisionKind
    at_ns: int = 0
    subtask: str = ""
    """Whose failure led to it."""
    why: str = ""
    """What had failed."""
    note: str = ""
    """What was done about it, and why nothing simpler was."""
    plan: Plan | None = None
    """The plan before; of the latest revisions only."""
    dropped: tuple[Dropped, ...] = ()
    added: tuple[str, ...] = ()


class Proposal(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A plan that has not taken effect: a task's first one, or what the decomposer proposes after a failure."""

    plan: Plan
    """The whole plan as proposed; after a failure with ids of its own."""
    subtask: str = ""
    """Whose failure led to it; empty: it is the task's first plan."""
    note: str = ""
    """Why it waits, or how it came to be."""
    waits: bool = False
    """Whether an operator has to approve it first."""
    hash: str = ""
    """Of its canonical form: an approval names it (`tasks.steering.hashing`)."""
    since_s: float = 0.0
    """The task's `elapsed_s` when it was made: it expires so long after that, on any coordinator."""
    expires_s: float = 0.0
    """How long it waits; 0: not told."""
    at_ns: int = 0


class RunRequest(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Order to run one attempt of a subtask; `inputs` are the results of the subtasks it comes after."""

    task: str
    subtask: str
    attempt: int
    skill: str
    need: Need
    robot: str | None = None
    others: tuple[str, ...] = ()
    """The further robots of a joint skill."""
    params: dict[str, Any] = field(default_factory=dict[str, Any])
    inputs: dict[str, dict[str, Any]] = field(default_factory=dict[str, dict[str, Any]])
    coordinator: str = ""
    deadline_s: float = 120.0
    hops: int = 0
    """How often it was passed on to a gateway with a warm container; one is the most."""
    resume: dict[str, Any] | None = None
    """The last checkpoint of an earlier attempt, from which the handler may go on."""
    calls: int = 0
    """How many calls had been made when that was saved: those that follow are numbered from there."""
    priority: int = PLAIN_PRIORITY
    """Of its task: orders those who wait for a container."""
    due_s: float = 0.0
    """Seconds until its task's deadline when the order was sent; 0: none."""
    submitter: str = ""
    """Whose task it is: those who wait for a container are served in fair turns."""
    group: tuple[str, ...] = ()
    """Gateways that it may be passed on to, as the task's submitter wished; empty: any. The task's own group is no
    limit here: its members are asked first, but a container that is ready elsewhere counts for more."""
    new_container: bool = False
    """Passed on, it may be started in a new container as well: the gateway that passes it on has no room for one."""
    moves: int = 0
    """How often the subtask was moved from one gateway to another before."""
    expected_s: float = 0.0
    """How long runs of the skill take by the coordinator's experience; 0 when it has none."""
    avoid: tuple[str, ...] = ()
    """Gateways where earlier attempts failed: it is not passed on to them."""
    owner: str = ""
    """Key of the record that its files belong to and go with; empty: its task's."""

    @property
    def run_id(self) -> str:
        """`task/subtask/attempt`, unique in the fleet."""
        return f"{self.task}/{self.subtask}/{self.attempt}"


class RunAccepted(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Answer to a run order: where it runs, and how that was decided."""

    gateway: str
    container: str
    phase: Phase
    why: str = ""
    choice: Choice | None = None


class RunEventKind(OpenEnum):
    """What a run tells: `started`, any number of the next five, then `succeeded` or `failed`."""

    STARTED = "started"
    PROGRESS = "progress"
    LOG = "log"
    PARTIAL = "partial"
    CHECKPOINT = "checkpoint"
    """`result` is data from which a later attempt can go on."""
    ALIVE = "alive"
    """A sign of life and nothing more: the handler said so, or waits for an answer of the appliance."""
    SUCCEEDED = "succeeded"
    FAILED = "failed"


class RunEvent(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """News of a run, published under the task's key and kept by the executing gateway until the task ends."""

    task: str
    subtask: str
    attempt: int
    kind: RunEventKind
    gateway: str = ""
    container: str = ""
    phase: Phase | None = None
    progress: float = 0.0
    note: str = ""
    result: dict[str, Any] | None = None
    failure: Failure | None = None
    choice: Choice | None = None
    """On the `progress` that tells of a run which was passed on while it waited: why it was."""
    startup_ms: float | None = None
    """On `started`: request received to first line of the handler, on the executing gateway's clock."""
    duration_ms: float | None = None
    cpu_ms: float | None = None
    """At the end: CPU time of its process and of those it waited for, user and system."""
    peak_mb: float | None = None
    """At the end: most memory its process held at once, what it shares with the waiting container included."""
    number: int = 0
    """Counts what the executing gateway has published of this attempt, from 1: a listener sees what it has missed."""
    at_ns: int = 0
    """When it was published, by the executing gateway's clock."""
    calls: int = 0
    """On `checkpoint`: how many calls the handler had made by then."""


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
    others: tuple[str, ...] = ()
    """The further robots of a joint skill, bound together with `bound_robot`, in the order of the plan."""
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
    def bound(self) -> dict[str, str]:
        """The robots that it is bound to, by their names in the plan; empty before it is dispatched."""
        return (
            dict(zip(self.subtask.robots, (self.bound_robot, *self.others), strict=False)) if self.bound_robot else {}
        )

    @property
    def robots(self) -> tuple[str, ...]:
        """All its robots: those it is bound to, and by their names in the plan those it is not yet."""
        bound = self.bound
        return tuple(bound.get(each, each) for each in self.subtask.robots)

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
    """Counts the group's formations, which distinguishes a change from a repetition."""
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
    place_ns: int = 0
    """Orders it among tasks of the same priority that wait for the same robot; 0: `created_ns` does."""
    ranked_by: Word | None = None
    """Who has put it before others last, and why."""
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
