"""What the task manager answers over RPC: the request and reply structs of its verbs.

The command line, the terminal UI and other gateways speak through these alone; `docs/keyspace.md` lists the
verbs. Requests refuse unknown fields, so that a typing error is an error and not a silent default.
"""

from msgspec import Struct

from appliance.llm.analysis import Analysis
from appliance.llm.experience.statistic import Row
from appliance.model import ContainerInfo, Plan, RunEvent, TaskRecord, TierAttempt
from appliance.tasks.watch.lines import Line


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
