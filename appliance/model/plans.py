"""Plans: graphs of subtasks for one instruction, and where they came from."""

import hashlib
from typing import Any, cast

import msgspec
from msgspec import Struct, field

from appliance.model.messages import OpenEnum


class Tier(OpenEnum):
    """Where a plan came from, cheapest first (algorithms: cascade)."""

    CACHE = "cache"
    LOCAL = "local"
    PEER = "peer"
    """The local model of another gateway."""
    UPSTREAM = "upstream"
    RULES = "rules"


class Subtask(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One node of a plan: a skill of the catalogue on a robot (`None`: computed on a gateway), after others.

    `robot` is a roster name, or `any`, `any1`, ... until the task manager binds it, or `all`.
    """

    id: str
    skill: str
    robot: str | None = None
    params: dict[str, Any] = field(default_factory=dict[str, Any])
    after: tuple[str, ...] = ()

    @property
    def robots(self) -> tuple[str, ...]:
        """All robots that do it, `robot` first: more than one where its skill is joint (its parameter `robots`)."""
        if self.robot is None:
            return ()
        listed: object = self.params.get("robots")
        more = cast("list[object]", listed) if isinstance(listed, list | tuple) else ()
        return tuple(dict.fromkeys((self.robot, *(each for each in more if isinstance(each, str)))))


class TierAttempt(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What one tier made of an instruction; `problems` says why its plan was not taken."""

    tier: str
    ok: bool
    confidence: float = 0.0
    latency_ms: float = 0.0
    problems: tuple[str, ...] = ()


class Severity(OpenEnum):
    """What a finding means for a plan."""

    NOTE = "note"
    """It is shown."""
    HOLD = "hold"
    """The plan waits until an operator approves it."""
    REFUSE = "refuse"
    """The plan cannot run."""


class Verdict(OpenEnum):
    """What becomes of an instruction."""

    RUN = "run"
    HOLD = "hold"
    """Its plan waits until an operator approves it."""
    REFUSE = "refuse"
    STOP = "stop"
    """It is a soft stop, and no plan is made."""


class Finding(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What one check says of a plan."""

    check: str
    """Name of the check, such as `negation`."""
    severity: Severity
    message: str
    words: tuple[str, ...] = ()
    """The words of the instruction that it is about."""
    hint: str = ""
    """What to do, where there is something."""


class Provenance(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Where a plan came from; it stays with the plan in the task's record."""

    tier: Tier
    model: str = ""
    """The model that wrote it; empty for rules."""
    gateway: str = ""
    """The gateway that decomposed the instruction."""
    confidence: float = 0.0
    latency_ms: float = 0.0
    """All tiers together, waiting included."""
    attempts: tuple[TierAttempt, ...] = ()
    """Every tier that was asked, in order."""
    hash: str = ""
    """`plan_hash` when it was made: a plan that was changed since has another."""
    key: str = ""
    """Under which it would be found in the plan cache, once it has been carried out with success."""
    cache: str = ""
    """How the plan cache was hit, in words; empty when it was not."""
    confirm: tuple[str, ...] = ()
    """Why an operator should agree before it runs; empty: nothing is against it."""
    findings: tuple[Finding, ...] = ()
    """What the review of the plan found, by the name of the check."""
    edited: bool = False
    """Whether an operator changed the plan before it ran: all else here is of the plan before that."""


MAX_SUBTASKS = 64
"""Subtasks that a plan may have. A longer one is a model that loops, or work for several tasks; the record of a task
holds a result of up to `tasks.max_result_bytes` for each."""
SPLIT = f"split it into tasks of at most {MAX_SUBTASKS} subtasks"
"""The remedy for a plan that is longer."""


class Plan(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A graph of subtasks for one instruction, with where it came from and how sure that tier is (0 to 1)."""

    domain: str
    subtasks: tuple[Subtask, ...]
    tier: Tier = Tier.RULES
    confidence: float = 0.0
    latency_ms: float = 0.0
    provenance: Provenance | None = None
    """None for a plan that was written by hand."""


def oversize(count: int) -> str:
    """Return what is wrong with a plan of so many subtasks, with the limit; "" when it has room."""
    return f"the plan has {count} subtasks, at most {MAX_SUBTASKS} are possible" if count > MAX_SUBTASKS else ""


def plan_hash(plan: Plan) -> str:
    """Return the hash of what a plan does, not of how it came to be: what an approval is bound to.

    SHA-256, as hex, of domain and subtasks as JSON with sorted keys, every field written out.
    """
    subtasks = [
        {"id": each.id, "skill": each.skill, "robot": each.robot, "params": each.params, "after": list(each.after)}
        for each in plan.subtasks
    ]
    canonical = msgspec.json.encode({"domain": plan.domain, "subtasks": subtasks}, order="sorted")
    return hashlib.sha256(canonical).hexdigest()
