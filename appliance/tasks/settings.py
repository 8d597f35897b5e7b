"""Configuration of the task manager."""

from typing import Annotated

from msgspec import Meta, Struct, field

from appliance.model import Approval
from appliance.tasks.detection import DetectionConfig
from appliance.tasks.migration.settings import MigrationConfig
from appliance.tasks.replan.settings import ReplanConfig


class TasksConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Scheduling weights, bounds and deadlines."""

    load_weight: float = 0.4
    """Coarse score: weight of idle capacity."""
    data_weight: float = 0.3
    """Coarse score: weight of holding the inputs or the robot's link."""
    warm_weight: float = 0.3
    """Coarse score: weight of a ready container of the image."""
    group_size: Annotated[int, Meta(ge=1, le=64)] = 8
    """Gateways in a task's dynamic group at most: as many as can know of each other's containers without a search."""
    regroup_s: Annotated[float, Meta(gt=0)] = 5.0
    """How often a group is looked at as a whole while all its members can serve: often enough to follow the fleet, and
    seldom enough for what it costs (a look at all gateways)."""
    backlog: Annotated[float, Meta(ge=0)] = 1.0
    """Runs that a coordinator lets be at a gateway beyond its containers, as a part of these: enough that none stands
    idle until its coordinator hears of it (70 ms), few enough that turns are taken here and not in its queue."""
    max_tasks: int = 200
    """Unfinished tasks one gateway coordinates; further submissions are refused with the reason."""
    max_instruction_chars: int = 2000
    """Longer instructions are refused: no plain instruction is, and prompts must stay bounded."""
    run_timeout_s: float = 3.0
    """How long a gateway may take to accept a run before another is tried."""
    check_s: float = 2.0
    """How often runs in progress are checked against their gateway, in case an event was lost."""
    grace_s: float = 10.0
    """How long after its deadline, or after a cancel, a silent run is given up."""
    max_artifact_mb: int = 64
    """Largest file a handler may store."""
    artifact_reserve_mb: Annotated[int, Meta(ge=0)] = 512
    """Disk left free where handlers' files are kept, MB: one that would take it is refused."""
    max_result_bytes: int = 48 * 1024
    """Largest result of a subtask, as JSON: 64 of them still fit into one record. Larger things are files."""
    max_checkpoint_bytes: int = 256 * 1024
    """Largest checkpoint of a run, as JSON: it travels with the order of the next attempt. Larger things are files."""
    retention_s: float = 60.0
    """How often old records are looked for."""
    keep_finished: int = 500
    """Finished task records kept whole in this gateway's shard; of older ones the id and the outcome are remembered."""
    remember_days: Annotated[float, Meta(ge=0, le=365)] = 7.0
    """How long after its end the id of a task whose record was trimmed is remembered with its outcome, days: handed in
    again it is answered with that and not done again. A week: longer than a script or a store-and-forward link repeats
    a request. 0: not at all."""
    remember_most: Annotated[int, Meta(ge=0, le=100_000)] = 5000
    """Ids remembered so in this gateway's shard, some 400 B each; beyond it the oldest are forgotten before their time,
    which is counted (`forgotten` in the gateway's status) and said in the log."""
    tell_decisions: bool = True
    """Put each placement with all that it rested on, so that `swiftbot log check` can make it again: 1 kB a subtask."""
    approval: Approval = Approval.NEVER
    """Which first plans wait for an operator's approval: `never`, `dangerous` (a skill that its manifest calls so, or
    one that moves a robot that flies) or `always`. A request may ask for more, never for less. Never by default: robots
    hand tasks in where nobody watches."""
    approval_s: Annotated[float, Meta(gt=0, le=604800)] = 600.0
    """How long a first plan waits to be approved; then the task fails: by later the site is another one."""
    detection: DetectionConfig = field(default_factory=DetectionConfig)
    """When a run is taken for stuck or straggling."""
    replan: ReplanConfig = field(default_factory=ReplanConfig)
    """What may be done about a subtask that was given up."""
    migration: MigrationConfig = field(default_factory=MigrationConfig)
    """Moving runs in progress to other gateways."""
