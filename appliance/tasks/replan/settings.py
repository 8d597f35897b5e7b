"""Configuration of replanning."""

from typing import Literal

from msgspec import Struct


class ReplanConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What may be done about a subtask that was given up, and how often."""

    robots: Literal["any", "all", "never"] = "any"
    """Which robots another may stand in for: those that the appliance chose itself (`any`), those that the operator
    named too (`all`), or none (`never`). Whoever names a robot usually means it."""
    robot_wait_s: float = 15.0
    """How long a robot that went offline is waited for before another takes over: a link that blinks, or a gateway
    that restarts, is back within seconds."""
    min_battery_percent: float = 20.0
    """A robot that tells less does not stand in for another: it would be the next to fail."""
    skills: bool = True
    """Whether alternatives that manifests declare may be used."""
    decompose: bool = True
    """Whether the decomposer may plan anew what is left. Never for a plan that was written by hand and came with its
    task."""
    max_replans: int = 2
    """New plans of the decomposer for one task; if two did not help, a person should look."""
    max_revisions: int = 6
    """All revisions of one task's plan."""
    confirm_s: float = 600.0
    """How long it waits; then the task fails."""
    ask_s: float = 90.0
    """How long the decomposer may take, all its tiers together."""
