"""What gateways tell of themselves, their containers, state volumes and planners: facts with one owner.

Of its planner a gateway tells the tiers, the model's process, the plan cache, and what upstream may still cost.
"""

from collections.abc import Iterable

from msgspec import Struct, field

from appliance.model.messages import Need, OpenEnum
from appliance.model.steering import Lease, SoftStop
from appliance.model.tasks import PLAIN_PRIORITY


class TierFigures(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A tier since the gateway started."""

    asked: int = 0
    failed: int = 0
    """Times it gave no plan that was taken."""
    p50_ms: float = 0.0
    """Median latency of its latest answers."""


class SlotStatus(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The process of the local model."""

    model: str
    """Name of its folder."""
    state: str = "loading"
    """`ready`, `loading`, `down`, or `swapping` while another model is tried beside it."""
    problem: str = ""
    """Why it is down."""
    tokens_s: float = 0.0
    """Tokens computed a second, prompts included, over the latest answers."""
    queue: int = 0
    """Instructions that wait for it or are answered just now."""
    queue_most: int = 0
    memory_mb: float = 0.0
    """Resident memory of the process."""
    threads: int = 0
    """0: as the model's own configuration says."""
    restarts: int = 0
    answered: int = 0
    refused: int = 0
    """Instructions that found the queue full."""
    cancelled: int = 0
    """Answers that were broken off because nobody waited for them any more."""
    reused_tokens: int = 0
    """Of the latest answer: tokens of its prompt that were computed before (warm prefix)."""


class CacheFigures(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The plan cache since the gateway started."""

    entries: int = 0
    hits: int = 0
    misses: int = 0
    dropped: int = 0
    """Plans that were forgotten because carrying them out failed."""


class UpstreamStatus(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The larger model elsewhere."""

    state: str = "closed"
    """Of the circuit breaker: `closed` (asked), `open` (not asked for a while), `half-open` (one is tried)."""
    retry_after_s: float = 0.0
    """While open: when it is tried again."""
    requests: int = 0
    """Today."""
    spent: float = 0.0
    """Today, in the currency of the configured prices."""
    budget: float = 0.0
    """A day; 0: no bound."""
    withheld: int = 0
    """Instructions that the privacy policy kept here, since start."""


class PlannerStatus(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """All of it."""

    tiers: dict[str, TierFigures] = field(default_factory=dict[str, TierFigures])
    slot: SlotStatus | None = None
    cache: CacheFigures = field(default_factory=CacheFigures)
    upstream: UpstreamStatus | None = None
    waiting: int = 0
    """Instructions in the planner's queue."""
    refused: int = 0
    """Instructions refused because that queue was full."""
    planned: int = 0
    escalated: int = 0
    """Of the planned ones: those whose plan did not come from the first tier that was asked."""
    thresholds: dict[str, float] = field(default_factory=dict[str, float])
    """Tier -> confidence from which its plans run unasked, as experience has moved it."""


class ContainerState(OpenEnum):
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


class RecorderNote(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A recorder of the fleet, as a gateway hears it."""

    id: str
    state: str = ""
    """As in RecorderStatus, or `silent`: not heard any more, since it is gone or says nothing for more than 5 s."""
    problem: str = ""
    """Why it does not record; empty when it does."""
    going: str = ""
    """Which of its logs are removed soon if nobody keeps them, in words; empty when none are."""
    missed: int = 0
    """Messages of the fleet that are not in its log, since it was started."""
    keys: dict[str, int] = field(default_factory=dict[str, int])
    """The same by kind of key, such as `gw/*/log`; the ten largest."""
    missed_at_ns: int = 0
    """Time of the last one that is missing."""


class Deliveries(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """How a gateway does that delivers alerts to addresses outside of the fleet."""

    sent: int = 0
    """Messages that were taken, since start."""
    failed: int = 0
    """Attempts that were refused or came to nothing."""
    problem: str = ""
    """Why it does not deliver, by address; empty when all is well."""


PROTOCOL = 1
"""What gateways of this version say to each other: keys, messages and records. One higher with each change that an
older one cannot ignore: a new field with a default is none."""
OLDEST_PROTOCOL = 1
"""The oldest that a gateway of this version works beside: that of the version before, so that a fleet is upgraded one
gateway after another."""


class RobotWork(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What a task still has to do with a robot, as its coordinator tells it."""

    robot: str
    task: str
    takes_s: float = 0.0
    """As long as that is expected to take."""
    state: str = "later"
    """`runs`: a run of it has the robot; `begun`: the task has begun, and the robot is its own up to its end;
    `ready`: it waits for its turn; `later`: it waits for something else first, and others go before it."""
    priority: int = PLAIN_PRIORITY
    place_ns: int = 0
    """Among tasks of the same priority the lower goes first: when it was accepted, unless an operator has moved it."""
    uses: tuple[str, ...] = ()
    """Parts of the robot that it needs: tasks that share none do not wait for each other."""

    @property
    def rank(self) -> tuple[bool, int, int, str]:
        """The lower goes first. The order is the same for all robots, so that no two tasks wait for each other."""
        return self.state not in ("runs", "begun"), -self.priority, self.place_ns, self.task


MOST_WORK = 200
"""Rows of `GatewayStatus.work`."""


class GatewayStatus(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A gateway's own account of itself, pushed on change and every few seconds."""

    id: str
    fleet: str
    version: str = ""
    protocol: int = 1
    """What it says to other gateways; versions before there were numbers say nothing, which is 1."""
    oldest_protocol: int = 1
    """The oldest that it works beside."""
    load: float = 0.0
    """0 idle to 1 saturated: the larger of CPU and pool use."""
    cpu_percent: float = 0.0
    memory_mb: float = 0.0
    """Resident memory of the daemon."""
    disk_free_mb: int = 0
    """Free on the disk of its data, MiB, in steps of 64."""
    disk_total_mb: int = 0
    """Size of that disk, MiB; 0: not told."""
    capacity: int = 0
    """Containers it may hold."""
    containers: int = 0
    ready: int = 0
    running: int = 0
    """Runs in progress."""
    queue: int = 0
    tasks: int = 0
    """Tasks it coordinates that have not ended."""
    tasks_waiting: int = 0
    """Of these, those that wait for their turn."""
    work: tuple[RobotWork, ...] = ()
    """What the tasks that it coordinates have for robots; at most `MOST_WORK`."""
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
    passed on, `unanswered` orders to other gateways without an answer, which may have been taken."""
    limits_enforced: bool = True
    """False where the kernel's cgroups do not let rootless containers be limited."""
    pool_problem: str = ""
    """Why the pool cannot start containers, or holds fewer than it may for want of memory; empty when all is well."""
    site_problem: str = ""
    """What the site's map lacks to keep robots on it, such as a fence, or that its file has changed or broken since the
    start; empty when all is well."""
    keys_problem: str = ""
    """What is to be done about certificates soon, such as one that expires; empty when nothing is."""
    parts: str = ""
    """Which signed list of parts it goes by, in words, or that it checks none (development mode)."""
    parts_problem: str = ""
    """Images, skills and models that it refuses since they are not in that list; empty when there are none."""
    images: tuple[str, ...] = ()
    """References of the images it has and can give to others."""
    volumes: tuple[VolumeInfo, ...] = ()
    """State volumes whose newest state is there."""
    models: tuple[str, ...] = ()
    """Language models it plans with, in order of asking, as `tier:name`; `rules` stands for the parser."""
    planner: PlannerStatus | None = None
    """How its planner does; a change of it alone goes out with the next status."""
    recorders: tuple[RecorderNote, ...] = ()
    """The fleet's recorders as this gateway hears them; told at once when one misses messages."""
    delivery: Deliveries | None = None
    """How it delivers alerts outside of the fleet; None: it is not set to."""
    robots: tuple[str, ...] = ()
    endpoints: tuple[str, ...] = ()
    refused: dict[str, int] = field(default_factory=dict[str, int])
    """Counters of bad input by kind, since start."""
    forgotten: int = 0
    """Ids of finished tasks forgotten before their time since start: there were more than `tasks.remember_most`."""
    monitor: dict[str, int] = field(default_factory=dict[str, int])
    """What the execution monitor found and did as coordinator, by kind, since start."""
    started_ns: int = 0
    pid: int = 0
    age_ms: int = 0
    """How old its figures were when it was put."""
    at_ns: int = 0
    """When it was put, Unix nanoseconds, by its own clock; 0: not told."""
    stops: tuple[SoftStop, ...] = ()
    """Soft stops in force, as it knows them; at most 32, those of the whole fleet first."""
    leases: tuple[Lease, ...] = ()
    """Robots that operators have taken over, as it knows; at most 32."""
    untold_ms: int = 0
    """For how long its containers had changed without being told; 0: all that was put of them held."""
    again_ms: int = 0
    """It will be put again within so long, changed or not."""
    asked: dict[str, float] = field(default_factory=dict[str, float])
    """Image -> placements a second that this gateway decides, to the next power of two."""


def queues(statuses: Iterable[GatewayStatus]) -> list[RobotWork]:
    """Return what tasks have for robots, robot by robot, in the order in which they go (pure).

    While a task changes hands two gateways tell of it; it is listed once.
    """
    found = {(each.robot, each.task): each for status in statuses for each in status.work}
    return sorted(found.values(), key=lambda each: (each.robot, each.state != "runs", each.state == "later", each.rank))


def works_beside(status: GatewayStatus) -> bool:
    """Whether a gateway of this version can be in one fleet with another (pure)."""
    return status.oldest_protocol <= PROTOCOL and status.protocol >= OLDEST_PROTOCOL
