"""What is said when runs are moved: the request that is put, and the request and reply structs of the verbs.

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
"""

from enum import StrEnum

from msgspec import Struct

from appliance.model import Need, Phase, Signed
from appliance.tasks.api import RunAsk


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
