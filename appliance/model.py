"""The words everybody shares: plans, task records, containers, gateways, robots, and their wire forms.

All structs are frozen facts; a change makes a new one (`msgspec.structs.replace`). They travel as JSON over
Zenoh and into MCAP; `docs/schemas/` holds the JSON schemas made from them. Times: `*_ns` are Unix
nanoseconds for people and logs, never compared between gateways to decide anything; durations are `*_ms` or
`*_s`, measured on one machine's monotonic clock.
"""

from enum import StrEnum
from typing import Annotated, Any

import msgspec
from msgspec import Meta, Struct, field

VersionVector = dict[str, int]
"""Gateway id -> number of writes by that gateway seen in this version (Dynamo's version vectors)."""


class Tier(StrEnum):
    """Where a plan came from, cheapest first (algorithms: cascade)."""

    CACHE = "cache"
    LOCAL = "local"
    UPSTREAM = "upstream"
    RULES = "rules"


class Subtask(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One node of a plan: a skill of the catalogue on a robot (`None`: computed on a gateway), after others.

    `robot` is a roster name, or `any`, `any1`, ... until the task manager binds it, or `all`.
    """

    id: str
    skill: str
    robot: str | None = None
    params: dict[str, Any] = field(default_factory=dict[str, Any])
    after: tuple[str, ...] = ()


class Plan(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A graph of subtasks for one instruction, with where it came from and how sure that tier is (0 to 1)."""

    domain: str
    subtasks: tuple[Subtask, ...]
    tier: Tier = Tier.RULES
    confidence: float = 0.0
    latency_ms: float = 0.0


class TaskState(StrEnum):
    """Life of a task. The last three are final."""

    ACCEPTED = "accepted"
    """Durable, not yet planned."""
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


class SubtaskState(StrEnum):
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


class Phase(StrEnum):
    """Which phase of container selection served a subtask (paper, Algorithm 1)."""

    LOCAL_WARM = "local warm"
    REMOTE_WARM = "remote warm"
    COLD = "cold"


class Failure(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Why something did not work, as told to people; `retryable` when another attempt may succeed."""

    code: str
    message: str
    remedy: str = ""
    retryable: bool = False


class Way(StrEnum):
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


class Split(Struct, frozen=True, kw_only=True, omit_defaults=True, order=True):
    """A version of a task that lost: two coordinators had written it without knowing of each other (a partition)."""

    coordinator: str
    """Whose version it was."""
    sequence: int
    state: TaskState
    runs: tuple[LostRun, ...] = ()
    """Its subtasks that had an attempt: which, where, and what had become of it."""
    settled: bool = False
    """Whether its runs have been ended and people told."""
    note: str = ""
    """What that was, in words."""


PLAIN_PRIORITY = 5
"""Priority of what nobody gave one: as much room above it as below."""
HIGHEST_PRIORITY = 9
LONGEST_DEADLINE_S = 30 * 86_400.0
"""Beyond a month a deadline is no deadline; a bound keeps sums of seconds exact."""


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


class RevisionKind(StrEnum):
    """How a plan was changed after a failure, cheapest first."""

    ROBOT = "robot"
    """Another robot does what one cannot do any more."""
    SKILL = "skill"
    """A skill that its manifest names as an alternative takes the place of one that was given up."""
    PLAN = "plan"
    """The decomposer has planned anew what was left."""


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
    """What the decomposer proposes after a failure, until it takes effect or is turned down."""

    plan: Plan
    """The whole plan as proposed, with ids of its own."""
    subtask: str
    """Whose failure led to it."""
    note: str = ""
    waits: bool = False
    """Whether an operator has to agree first."""
    at_ns: int = 0


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
    proposal: Proposal | None = None
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

    def of(self, subtask_id: str) -> SubtaskRecord:
        """Return the record of one subtask; KeyError when the plan has none of that id."""
        for record in self.subtasks:
            if record.subtask.id == subtask_id:
                return record
        raise KeyError(subtask_id)


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


# --- runs: one attempt of a subtask on one gateway ---------------------------------------------------------


class Need(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What a subtask asks of a container: T = (image, cpu, mem, volumes) of Algorithm 1."""

    image: str
    cpu: float = 0.5
    memory_mb: int = 128
    volumes: tuple[str, ...] = ()


class RunRequest(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Order to run one attempt of a subtask; `inputs` are the results of the subtasks it comes after."""

    task: str
    subtask: str
    attempt: int
    skill: str
    need: Need
    robot: str | None = None
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
    anew: bool = False
    """Passed on, it may be started in a new container as well: whoever passes it on has no room for one."""
    moves: int = 0
    """How often the subtask was moved from one gateway to another before."""
    expected_s: float = 0.0
    """How long runs of the skill take by the coordinator's experience; 0 when it has none."""
    avoid: tuple[str, ...] = ()
    """Gateways where earlier attempts failed: it is not passed on to them."""

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


class RunEventKind(StrEnum):
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


# --- facts with one owner ----------------------------------------------------------------------------------


class ContainerState(StrEnum):
    """Life of a pooled container."""

    STARTING = "starting"
    READY = "ready"
    RESERVED = "reserved"
    BUSY = "busy"
    DRAINING = "draining"
    DEAD = "dead"


class ContainerInfo(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A pooled container, spoken for by the gateway that holds it."""

    id: str
    gateway: str
    image: str
    state: ContainerState
    cpu: float = 1.0
    memory_mb: int = 256
    volumes: tuple[str, ...] = ()
    compatible: tuple[str, ...] = ()
    """Other images whose skills it can run as well (same base, requirements present)."""
    runs: int = 0
    run: str = ""
    """Run id while busy."""
    cold_ms: float | None = None
    """What its own cold start took."""
    since_ns: int = 0


class VolumeInfo(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A named state volume as the gateway that holds its newest state tells it. It outlives its containers."""

    name: str
    gateway: str
    generation: int = 0
    """Grows with each run that changed it; the highest is the newest."""
    size_bytes: int = 0


class PoolHint(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What a plan will need of a pool: so many containers of an image, in about so long (algorithms: prewarming)."""

    image: str
    count: int = 1
    in_s: float = 0.0
    """From now until it is needed, on the receiver's clock."""
    keep_s: float = 60.0
    """How long beyond that it is worth keeping."""
    task: str = ""
    need: Need | None = None


class GatewayStatus(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A gateway's own account of itself, pushed on change and every few seconds."""

    id: str
    fleet: str
    version: str = ""
    load: float = 0.0
    """0 idle to 1 saturated: the larger of CPU and pool use."""
    cpu_percent: float = 0.0
    memory_mb: float = 0.0
    """Resident memory of the daemon."""
    capacity: int = 0
    """Containers it may hold."""
    containers: int = 0
    ready: int = 0
    running: int = 0
    """Runs in progress."""
    queue: int = 0
    tasks: int = 0
    """Tasks it coordinates that have not ended."""
    draining: bool = False
    drain: str = ""
    """While it drains: how far it is, and what the runs that are left wait for."""
    overloaded: str = ""
    """Why runs are moved away from it, or were lately: it is given none meanwhile. Empty when all is well."""
    catalogue: str = ""
    """Digest of the skills it knows (verb `skills`); empty: not told."""
    cores: int = 0
    """Processor cores of the machine; 0: not told."""
    pool_memory_mb: int = 0
    """Memory that all its containers together may have; 0: not told."""
    searches: dict[str, int] = field(default_factory=dict[str, int])
    """How ready containers of others were looked for since it started: `asked` counts queries to other gateways,
    `saved` those that were not needed because what was known was enough, `moved` runs that waited here and were
    passed on."""
    limits_enforced: bool = True
    """False where the kernel's cgroups do not let rootless containers be limited."""
    pool_problem: str = ""
    """Why the pool cannot start containers, or holds fewer than it may for want of memory; empty when all is well."""
    images: tuple[str, ...] = ()
    """References of the images it has and can give to others."""
    volumes: tuple[VolumeInfo, ...] = ()
    """State volumes whose newest state is there."""
    models: tuple[str, ...] = ()
    """Language models it plans with, in order of asking, as `tier:name`; `rules` stands for the parser."""
    robots: tuple[str, ...] = ()
    endpoints: tuple[str, ...] = ()
    refused: dict[str, int] = field(default_factory=dict[str, int])
    """Counters of bad input by kind, since start."""
    monitor: dict[str, int] = field(default_factory=dict[str, int])
    """What the execution monitor found and did as coordinator, by kind, since start."""
    started_ns: int = 0
    pid: int = 0
    age_ms: int = 0
    """How old its figures were when it was put."""
    untold_ms: int = 0
    """For how long its containers had changed without being told; 0: all that was put of them held."""
    again_ms: int = 0
    """It will be put again within so long, changed or not."""
    asked: dict[str, float] = field(default_factory=dict[str, float])
    """Image -> placements a second that this gateway decides, to the next power of two."""


class Pose(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Where a robot is: metres east (x), north (y) and up (z) of the site's origin; heading in degrees from north."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    heading_deg: float = 0.0


class RobotInfo(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A robot as its speaker (a MAVLink gateway, or the Zenoh robot itself) describes it."""

    id: str
    kind: str
    """`mavlink` or `zenoh`."""
    gateway: str = ""
    """The gateway it is attached to; empty for one that speaks Zenoh itself."""
    uses: tuple[str, ...] = ()
    """Actuators and sensors it has, in the catalogue's words: base, arm, camera, ..."""
    verbs: tuple[str, ...] = ()
    """Commands it answers on `robot/{id}/command`."""
    flies: bool = False
    pose: Pose | None = None
    battery_percent: float | None = None
    armed: bool = False
    mode: str = ""
    holding: str = ""
    online: bool = True
    note: str = ""


class RobotCommand(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """An order to a robot. Same `id`: same order, answered again with the same reply and not done twice.

    `attempt` fences: a robot that has seen a higher attempt of `task`/`subtask` refuses a lower one.
    """

    id: str
    verb: str
    args: dict[str, Any] = field(default_factory=dict[str, Any])
    task: str = ""
    subtask: str = ""
    attempt: int = 0


class RobotReply(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What came of a command: `result` or `failure`; `blobs` are files such as pictures (name -> bytes)."""

    id: str
    result: dict[str, Any] = field(default_factory=dict[str, Any])
    blobs: dict[str, bytes] = field(default_factory=dict[str, bytes])
    failure: Failure | None = None


class Notice(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A message to a person, by `notify` or by the appliance itself."""

    id: str
    to: str
    text: str
    task: str = ""
    gateway: str = ""
    at_ns: int = 0


class LogLine(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One structured log line of a gateway or of a run."""

    at_ns: int
    level: str
    source: str
    event: str
    fields: dict[str, Any] = field(default_factory=dict[str, Any])
    number: int = 0
    """Counts a process's lines from 1."""


# --- the site: what names in instructions mean ------------------------------------------------------------


class Place(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A named place in site coordinates, metres."""

    x: float
    y: float
    z: float = 0.0
    aliases: tuple[str, ...] = ()


class Box(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """An axis-aligned rectangle on the ground, metres: an obstacle or a forbidden area."""

    name: str
    x: tuple[float, float]
    y: tuple[float, float]


class SiteObject(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A thing that the simulated world holds: colour name, size in metres, where it is at first."""

    name: str
    colour: str
    at: str
    size: float = 0.4


class Site(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The map of a site: places by name (lower case), obstacles, forbidden areas, and its geographic origin."""

    name: str = "site"
    latitude_deg: float = 47.397742
    longitude_deg: float = 8.545594
    altitude_m: float = 488.0
    places: dict[str, Place] = field(default_factory=dict[str, Place])
    obstacles: tuple[Box, ...] = ()
    forbidden: tuple[Box, ...] = ()
    objects: tuple[SiteObject, ...] = ()
    altitude_limit_m: float = 60.0
    speed_limit_mps: float = 8.0

    def find(self, name: str) -> Place | None:
        """Return the place of that name or alias (case and articles ignored), or None."""
        wanted = " ".join(word for word in name.lower().replace("_", " ").split() if word not in ("the", "a", "an"))
        for key, place in self.places.items():
            if wanted == key or wanted in place.aliases:
                return place
        return None


# --- wire --------------------------------------------------------------------------------------------------


class ErrorReply(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What an RPC answers when it cannot do what was asked; see `errors.from_code`."""

    code: str
    message: str
    remedy: str = ""
    problems: tuple[str, ...] = ()
    retry_after_s: float = 0.0
    """When what was refused for want of room is worth asking again, by the measured rate; 0: not known."""


def encode(value: Any) -> bytes:
    """Encode a struct as JSON."""
    return msgspec.json.encode(value)
