"""What a gateway tells of its planner: the tiers, the model's process, the plan cache, what upstream may still cost."""

from msgspec import Struct, field


class TierFigures(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A tier since the gateway started."""

    asked: int = 0
    failed: int = 0
    """Times it gave no plan that was taken."""
    p50_ms: float = 0.0
    """Median latency of its latest answers."""


class SlotStatus(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The process of the local model."""

    model: str
    """Name of its folder."""
    state: str = "loading"
    """`ready`, `loading`, `down`, or `swapping` while another model is tried beside it."""
    problem: str = ""
    """Why it is down."""
    tokens_s: float = 0.0
    """Tokens computed a second, prompts included, over the latest answers."""
    queue: int = 0
    """Instructions that wait for it or are answered just now."""
    queue_most: int = 0
    memory_mb: float = 0.0
    """Resident memory of the process."""
    threads: int = 0
    """0: as the model's own configuration says."""
    restarts: int = 0
    answered: int = 0
    refused: int = 0
    """Instructions that found the queue full."""
    cancelled: int = 0
    """Answers that were broken off because nobody waited for them any more."""
    reused_tokens: int = 0
    """Of the latest answer: tokens of its prompt that were computed before (warm prefix)."""


class CacheFigures(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The plan cache since the gateway started."""

    entries: int = 0
    hits: int = 0
    misses: int = 0
    dropped: int = 0
    """Plans that were forgotten because carrying them out failed."""


class UpstreamStatus(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The larger model elsewhere."""

    state: str = "closed"
    """Of the circuit breaker: `closed` (asked), `open` (not asked for a while), `half-open` (one is tried)."""
    retry_after_s: float = 0.0
    """While open: when it is tried again."""
    requests: int = 0
    """Today."""
    spent: float = 0.0
    """Today, in the currency of the configured prices."""
    budget: float = 0.0
    """A day; 0: no bound."""
    withheld: int = 0
    """Instructions that the privacy policy kept here, since start."""


class PlannerStatus(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """All of it."""

    tiers: dict[str, TierFigures] = field(default_factory=dict[str, TierFigures])
    slot: SlotStatus | None = None
    cache: CacheFigures = field(default_factory=CacheFigures)
    upstream: UpstreamStatus | None = None
    waiting: int = 0
    """Instructions in the planner's queue."""
    refused: int = 0
    """Instructions refused because that queue was full."""
    planned: int = 0
    escalated: int = 0
    """Of the planned ones: those whose plan did not come from the first tier that was asked."""
    thresholds: dict[str, float] = field(default_factory=dict[str, float])
    """Tier -> confidence from which its plans run unasked, as experience has moved it."""
