"""Runs: one attempt of a subtask on one gateway, as ordered and as it tells of itself."""

from typing import Any

from msgspec import Struct, field

from appliance.model.messages import Failure
from appliance.model.open_enum import OpenEnum
from appliance.model.placement import Choice, Need, Phase
from appliance.model.requests import PLAIN_PRIORITY


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
