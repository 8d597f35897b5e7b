"""Configuration of the task manager: scheduling, migration (section `[tasks.migration]`) and replanning."""

from typing import Annotated, Literal

from msgspec import Meta, Struct, field

from appliance.errors import ConfigError
from appliance.model import Approval

Positive = Annotated[float, Meta(gt=0)]
Part = Annotated[float, Meta(ge=0, le=1)]


class MigrationConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Marks, pauses, rations and weights (algorithms: migration)."""

    overload: bool = True
    """Whether an overloaded gateway has runs moved away by itself; drains and operators may in any case."""
    every_s: Positive = 0.5
    """How often a gateway looks at its own load."""
    above_s: Annotated[float, Meta(ge=0)] = 3.0
    """How long a mark must be exceeded before the gateway counts as overloaded: peaks pass by themselves."""
    cpu_high: Part = 0.95
    """Part of its processors from which a gateway is overloaded; 0: not looked at, where gateways share a machine."""
    cpu_low: Part = 0.75
    """Below this it is no longer, and only a gateway below this is given runs."""
    queue_high: Annotated[int, Meta(ge=0)] = 1
    """Runs waiting for a container from which a gateway is overloaded; 0: not looked at."""
    settle_s: Positive = 10.0
    """For so long a gateway that received a run gives none away, and one that gave some away is given none: what was
    moved must show in the figures before they are gone by again."""
    rest_s: Positive = 60.0
    """For so long a run that was moved is not moved again by overload."""
    max_moves: Annotated[int, Meta(ge=0)] = 3
    """How often a subtask is moved by overload at most."""
    moves_per_s: Positive = 4.0
    """Runs that one gateway gives away, or takes, per second."""
    fleet_moves_per_s: Positive = 40.0
    """The same for the whole fleet: overloaded gateways share it."""
    at_once: Annotated[int, Meta(ge=1)] = 4
    """Moves away from one gateway under way at the same time by overload; twice as many when it drains."""
    nearly_done_s: Annotated[float, Meta(ge=0)] = 2.0
    """A run expected to end sooner than this is left where it is: the move would take longer."""
    checkpoint_wait_s: Positive = 1.5
    """How long a handler is given to save a fresh checkpoint before it is moved from the last one."""
    command_wait_s: Annotated[float, Meta(ge=0)] = 2.0
    """How long the end of a robot command is waited for, of a run that moves between commands only."""
    hold_s: Positive = 10.0
    """How long a run that is to be moved sends no robot commands; then it goes on where it is."""
    warm_weight: float = 0.4
    """Closest node: weight of a ready container of the image."""
    load_weight: float = 0.3
    """Closest node: weight of idle capacity."""
    near_weight: float = 0.2
    """Closest node: weight of holding the subtask's data, or its robot's link."""
    history_weight: float = 0.1
    """Closest node: weight of how earlier moves there went."""


class ReplanConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What may be done about a subtask that was given up, and how often."""

    robots: Literal["any", "all", "never"] = "any"
    """Which robots another may stand in for: those that the appliance chose itself (`any`), those that the operator
    named too (`all`), or none (`never`). A robot that an operator names is usually meant."""
    robot_wait_s: float = 15.0
    """How long a robot that went offline is waited for before another takes over: a link that blinks, or a gateway
    that restarts, is back within seconds."""
    skills: bool = True
    """Whether alternatives that manifests declare may be used."""
    decompose: bool = True
    """Whether the decomposer may replan what is left. Never for a plan that was written by hand and came with its
    task."""
    max_replans: int = 2
    """New plans of the decomposer for one task; if two did not help, a person should look."""
    max_revisions: int = 6
    """All revisions of one task's plan."""
    confirm_s: float = 600.0
    """How long it waits; then the task fails."""
    ask_s: float = 90.0
    """How long the decomposer may take, all its tiers together."""


class BatteryConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How much charge tasks leave a robot, and how much they are expected to use up."""

    reserve_percent: Annotated[float, Meta(ge=0, le=95)] = 20.0
    """No robot is chosen for a task that would leave it less, nor stands in for another, and a model's plan that would
    is held for approval. A task that takes the robot to a charger may. 0: charge is not looked at."""
    range_m: Positive = 5000.0
    """How far a full battery takes a robot that does not tell its own `limits.range_m`, metres."""
    lasts_s: Positive = 28_800.0
    """How long a full battery lasts on the ground, moving or not: 8 hours, a shift."""
    flies_s: Positive = 1200.0
    """How long it lasts in the air: 20 minutes, as a usual copter's."""
    auto_charge: bool = False
    """Whether a robot on the ground that has nothing to do and less than its reserve goes to a free charger by itself,
    a place with `charg` in its name or aliases. Needs `plane.voters`, which grant ways and chargers."""
    charged_percent: Annotated[float, Meta(gt=0, le=100)] = 80.0
    """With `auto_charge`: a robot that stands at a charger is chosen for tasks again from this charge on, and makes
    room there for one that waits."""

    def check(self, *, reserved: bool) -> None:
        """Check what types cannot tell; ConfigError. `reserved`: whether the floor is."""
        if self.auto_charge and not reserved:
            raise ConfigError(
                "tasks.battery.auto_charge is on, and ways and places are not reserved",
                remedy="name the gateways that grant ways in plane.voters, and leave floor.enabled on",
            )
        if self.auto_charge and not 0 < self.reserve_percent < self.charged_percent:
            raise ConfigError(
                f"tasks.battery: a reserve of {self.reserve_percent:g} %, charged at {self.charged_percent:g} %",
                remedy="with auto_charge the reserve must be more than 0 and less than charged_percent",
            )


class DetectionConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """When a run is taken for stuck or straggling."""

    stuck_factor: float = 6.0
    """A silent run of a skill that promises no signs of life is stuck after so many times what runs of it take (at the
    quantile): ending one that only has more to do than usual costs more than waiting."""
    stuck_minimum_s: float = 60.0
    """Never before, unless the manifest promises signs of life more often."""
    straggler_factor: float = 2.0
    """A run straggles after so many times what others take (Spark's `speculation.multiplier` is 1.5, later 3)."""
    straggler_minimum_s: float = 5.0
    """Never before: below it moving on costs about as much as it saves."""
    quantile: float = 0.9
    """Which of the known durations counts: not the median, or a tenth of all runs in a spread of two would straggle."""
    samples: int = 5
    """Runs of a skill that must be known before its durations are believed."""
    siblings: int = 3
    """Finished siblings of the same skill in the same task that do as well; their largest duration counts."""


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
    max_tasks: Annotated[int, Meta(ge=1)] = 200
    """Tasks that one gateway works on at once as their coordinator; those beyond wait their turn. While they fill the
    places, two of each other submitter are worked on beside them, up to twice as many in all."""
    max_queue: Annotated[int, Meta(ge=0)] = 50_000
    """Tasks that may wait for their turn at one coordinator, durable like all; further submissions are refused with the
    reason and the time to come back. Each takes 1 kB of memory, and its record 2 kB of disk on three gateways."""
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
    artifact_copies: Annotated[int, Meta(ge=1, le=8)] = 2
    """Gateways that keep each file of a handler, the one that made it included; with 1 it is lost with that one."""
    artifact_reserve_mb: Annotated[int, Meta(ge=0)] = 512
    """Disk left free where handlers' files are kept, MB: one that would take it is refused."""
    max_result_bytes: int = 48 * 1024
    """Largest result of a subtask, as JSON: 64 of them still fit into one record. Larger things are files."""
    max_checkpoint_bytes: int = 256 * 1024
    """Largest checkpoint of a run, as JSON: it travels with the order of the next attempt. Larger things are files."""
    retention_s: float = 60.0
    """How often old records are looked for."""
    keep_runs: Annotated[int, Meta(ge=0)] = 50
    """Runs of federated learning that have ended which are kept in this gateway's shard, the newest; of older ones the
    records and models are removed, unless one of the models is marked."""
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
    """Put each placement, and each step of a round of federated learning, with all that it rested on, so that `swiftbot
    log check` can make it again: 1 kB a subtask, 1 kB a client and round."""
    approval: Approval = Approval.NEVER
    """Which first plans wait for an operator's approval: `never`, `dangerous` (a skill that its manifest calls so, or
    one that moves a robot that flies) or `always`. A request may ask for more, never for less. Never by default: robots
    hand tasks in where nobody watches."""
    approval_s: Annotated[float, Meta(gt=0, le=604800)] = 600.0
    """How long a first plan waits to be approved; then the task fails: by later the site is another one."""
    battery: BatteryConfig = field(default_factory=BatteryConfig)
    """Charge that tasks leave robots."""
    detection: DetectionConfig = field(default_factory=DetectionConfig)
    """When a run is taken for stuck or straggling."""
    replan: ReplanConfig = field(default_factory=ReplanConfig)
    """What may be done about a subtask that was given up."""
    migration: MigrationConfig = field(default_factory=MigrationConfig)
    """Moving runs in progress to other gateways."""
