"""When runs are moved to other gateways, and how many; section `[tasks.migration]`."""

from typing import Annotated

from msgspec import Meta, Struct

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
