"""What operators say and what follows from it: approvals, pauses, soft stops, leases of robots, questions, the audit.

Every order of an operator carries who gives it (`by`), why, and an id of its own (`act`): given twice, for instance
because an answer was lost, it is one order. Times are for people; nothing is decided by them.
"""

from typing import Annotated

from msgspec import Meta, Struct

from appliance.model.messages import OpenEnum
from appliance.model.plans import Plan

MAX_BY = 120
MAX_WHY = 500
MAX_ACT = 64
MAX_STOPPED = 256
"""Robots that one soft stop names; beyond that it is the fleet that is meant."""

Short = Annotated[str, Meta(max_length=MAX_BY)]
Reason = Annotated[str, Meta(max_length=MAX_WHY)]
ActId = Annotated[str, Meta(max_length=MAX_ACT)]


class Signed(Struct, frozen=True, kw_only=True, omit_defaults=True, forbid_unknown_fields=True):
    """What every order of an operator carries; requests of such verbs extend it."""

    by: Short = ""
    """The operator's name, as the operator's own tool gives it."""
    why: Reason = ""
    act: ActId = ""
    """Id of the order: the same again is the same order."""


class Act(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The audit: an order of an operator and what came of it, put by the gateway that it was given to."""

    id: str
    verb: str
    by: str
    target: str = ""
    """The task, robot, gateway or image it was about."""
    why: str = ""
    outcome: str = "done"
    """`done`, or the code of the error; `denied`: refused for whom it was from; `unverified`: a soft stop that was
    carried out without a good signature."""
    problem: str = ""
    """Why it was not done."""
    gateway: str = ""
    at_ns: int = 0
    took_ms: float = 0.0


class Approval(OpenEnum):
    """Which first plans wait for an operator, mildest first; of a configuration and a request the stricter holds."""

    NEVER = "never"
    DANGEROUS = "dangerous"
    """Those with a skill that its manifest calls dangerous, or that flies."""
    ALWAYS = "always"

    def stricter(self, other: "Approval") -> "Approval":
        """The stricter of two."""
        order = tuple(Approval)
        return max(self, other, key=order.index)


class Word(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Who said something of a task, and why."""

    by: str
    why: str = ""
    act: str = ""
    at_ns: int = 0


class Decision(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """An operator's word on a plan that waited, as the record keeps it: the last one."""

    approved: bool
    by: str
    why: str = ""
    hash: str = ""
    """Of the plan that the operator had before them."""
    edited: bool = False
    """Whether another plan was approved in its place."""
    plan: Plan | None = None
    """The plan that was turned down, or in whose place another was approved, with where it came from."""
    note: str = ""
    """Why that plan waited for an operator."""
    act: str = ""
    at_ns: int = 0


class Pause(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Why no subtask of a task is started: an operator's wish, or a soft stop of a robot that it needs (`stop`)."""

    by: str
    why: str = ""
    stop: str = ""
    """Id of the soft stop it follows from; it ends with that."""
    robots: tuple[str, ...] = ()
    """Of those stopped, the ones that the task needs."""
    act: str = ""
    at_ns: int = 0

    @property
    def text(self) -> str:
        """The reason in words."""
        who = self.by or "an operator"
        said = f": {self.why}" if self.why else ""
        if self.stop:
            return f"{', '.join(self.robots) or 'the fleet'} stopped by {who}{said}"
        return f"paused by {who}{said}"


class SoftStop(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Robots hold, and get no command until it is lifted. Not a safety-rated emergency stop."""

    id: Annotated[str, Meta(min_length=1, max_length=MAX_ACT)]
    robots: Annotated[tuple[str, ...], Meta(max_length=MAX_STOPPED)] = ()
    """Empty: all of the fleet, those that come later too."""
    by: Short = ""
    why: Reason = ""
    at_ns: int = 0

    @property
    def text(self) -> str:
        """It in words."""
        said = f": {self.why}" if self.why else ""
        return f"stopped by {self.by or 'an operator'}{said}"


class Lifted(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Soft stops that are lifted, by their ids, for some robots or (empty) for all that they named."""

    id: Annotated[str, Meta(min_length=1, max_length=MAX_ACT)]
    stops: Annotated[tuple[str, ...], Meta(max_length=1024)]
    robots: Annotated[tuple[str, ...], Meta(max_length=MAX_STOPPED)] = ()
    by: Short = ""
    why: Reason = ""
    at_ns: int = 0


class Lease(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """An operator has taken a robot over: only commands that carry its `id` move it until it ends."""

    id: Annotated[str, Meta(min_length=1, max_length=MAX_ACT)]
    robot: str
    by: Short = ""
    why: Reason = ""
    lease_s: Annotated[float, Meta(ge=1, le=120)] = 10.0
    """It ends so long after its last renewal, by each gateway's own clock."""
    renewal: int = 0
    ended: str = ""
    """How it ended: `given back`, `expired`; empty while it holds."""
    at_ns: int = 0

    @property
    def text(self) -> str:
        """It in words."""
        said = f": {self.why}" if self.why else ""
        return f"taken over by {self.by or 'an operator'}{said}"


class Enquiry(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A question of a skill or robot to people, and its answer once there is one; a record of the DHT and a put."""

    id: str
    question: str
    choices: tuple[str, ...] = ()
    """Answers that are understood; empty: any text."""
    to: str = ""
    robot: str = ""
    task: str = ""
    subtask: str = ""
    expires_s: float = 0.0
    """So long after it was asked it is no longer waited for; 0: as long as its run may last."""
    at_ns: int = 0
    answer: str | None = None
    by: str = ""
    answered_ns: int = 0
    closed: str = ""
    """Why it needs no answer any more: `expired`, `withdrawn`."""

    @property
    def open(self) -> bool:
        """Whether it waits for an answer."""
        return self.answer is None and not self.closed
