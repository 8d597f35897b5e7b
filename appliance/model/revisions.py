"""Changes of a plan after a failure, made and proposed."""

from msgspec import Struct

from appliance.model.messages import Failure
from appliance.model.open_enum import OpenEnum
from appliance.model.plans import Plan
from appliance.model.states import SubtaskState


class RevisionKind(OpenEnum):
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
    """The task's `elapsed_s` when it was made: it expires so long after that, whoever coordinates the task then."""
    expires_s: float = 0.0
    """How long it waits; 0: not told."""
    at_ns: int = 0
