"""What the planner counts, for the status of its gateway."""

from collections import deque
from collections.abc import Sequence
from statistics import median

from msgspec import Struct, field

from appliance.llm.experience.memory import Memory
from appliance.llm.routing.gate import Gate
from appliance.llm.tiers import Slot
from appliance.model import PlannerStatus, SlotStatus, Tier, TierAttempt, TierFigures, UpstreamStatus

_LATEST = 64


def _latencies() -> deque[float]:
    return deque(maxlen=_LATEST)


class Counted(Struct):
    """Of one tier."""

    asked: int = 0
    failed: int = 0
    ms: deque[float] = field(default_factory=_latencies)


class Figures:
    """Since the start."""

    def __init__(self) -> None:
        self.tiers: dict[str, Counted] = {}
        self.withheld = 0
        """Instructions that were not sent upstream for privacy."""
        self._planned = 0
        self._escalated = 0

    def asked(self, tier: str) -> None:
        """Count a question to a tier."""
        self.tiers.setdefault(tier, Counted()).asked += 1

    def failed(self, tier: str) -> None:
        """Count a tier's answer that was not taken."""
        self.tiers.setdefault(tier, Counted()).failed += 1

    def took(self, tier: str, ms: float) -> None:
        """Note how long a tier took."""
        self.tiers.setdefault(tier, Counted()).ms.append(ms)

    def planned(self, tier: Tier, attempts: Sequence[TierAttempt]) -> None:
        """Count a plan; it was escalated when another tier was asked before."""
        self._planned += 1
        asked = [each.tier for each in attempts if not any(text.startswith("not asked") for text in each.problems)]
        self._escalated += bool(asked) and asked[0] != tier.value

    def status(self, slots: Sequence[Slot], memory: Memory, gate: Gate) -> PlannerStatus:
        """Return it all."""
        told: list[object] = [getattr(slot.planner, "status", None) for slot in slots]
        upstream = next((each for each in told if isinstance(each, UpstreamStatus)), None)
        return PlannerStatus(
            tiers={
                tier: TierFigures(
                    asked=each.asked, failed=each.failed, p50_ms=round(median(each.ms), 3) if each.ms else 0.0
                )
                for tier, each in self.tiers.items()
            },
            slot=next((each for each in told if isinstance(each, SlotStatus)), None),
            cache=memory.cache.figures,
            upstream=None
            if upstream is None
            else UpstreamStatus(
                state=upstream.state,
                retry_after_s=upstream.retry_after_s,
                requests=upstream.requests,
                spent=upstream.spent,
                budget=upstream.budget,
                withheld=self.withheld,
            ),
            waiting=gate.waiting,
            refused=gate.refused,
            planned=self._planned,
            escalated=self._escalated,
            thresholds=memory.thresholds.all,
        )
