"""What somebody asks of the fleet: a task, with its priority and deadline."""

from typing import Annotated

from msgspec import Meta, Struct

from appliance.model.plans import Plan
from appliance.model.steering import Approval

PLAIN_PRIORITY = 5
"""Priority of what nobody gave one: as much room above it as below."""
HIGHEST_PRIORITY = 9
LONGEST_DEADLINE_S = 30 * 86_400.0
"""Beyond a month a deadline is no deadline; a bound keeps sums of seconds exact."""


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
    approval: Approval = Approval.NEVER
    """Whether an operator is to approve its plan before anything runs; the gateway's own setting may ask for more."""
