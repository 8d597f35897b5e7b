"""What escalating brings: accuracy against the share of instructions that go to a better model, by threshold.

The better model is stood in for by the gold plans, given after the delay that the paper measured for a hosted one. So
the curve is an upper bound of what any upstream model can bring, and says at what price. Routed on is the confidence of
the first tier: the local model's, or the rules' where there is no local model, and the result says which.
"""

import asyncio
from collections.abc import Mapping, Sequence
from typing import Any

from msgspec import Struct

from appliance.llm.settings import PlanContext
from appliance.llm.tier import Proposal
from appliance.model import Plan, Subtask, Tier
from workshop.bench.figures import quantile

UPSTREAM_MS = 1280.0
"""GPT-4o's latency in the paper (Table: task decomposition across models)."""
THRESHOLDS = tuple(round(0.05 * step, 2) for step in range(21))


class Answered(Struct, frozen=True, kw_only=True):
    """What the first tier made of a case."""

    confidence: float
    """0 for a case that it had no plan for."""
    latency_ms: float
    row: Mapping[str, Any]
    """The scorer's figures of it."""
    gold: Mapping[str, Any]
    """The same of the gold plan itself: not every figure is defined for every case."""


def curve(
    answered: Sequence[Answered], *, thresholds: Sequence[float] = THRESHOLDS, upstream_ms: float = UPSTREAM_MS
) -> list[dict[str, Any]]:
    """Return accuracy, share escalated and latency for each threshold. Pure.

    Args:
        answered: what the first tier made of each case.
        thresholds: confidences below which a case is escalated.
        upstream_ms: latency of an escalated case, beside the first tier's own.
    """
    points: list[dict[str, Any]] = []
    for threshold in thresholds:
        escalated = [each.confidence < threshold or not each.confidence for each in answered]
        rows = [each.gold if up else each.row for each, up in zip(answered, escalated, strict=True)]
        times = sorted(
            each.latency_ms + (upstream_ms if up else 0.0) for each, up in zip(answered, escalated, strict=True)
        )
        points.append(
            {
                "threshold": threshold,
                "escalated": round(100 * sum(escalated) / max(1, len(answered)), 1),
                "decomposition": _mean(rows, "decomposition"),
                "parallel_recall": _mean(rows, "parallel_recall"),
                "exact": _mean(rows, "exact"),
                "mean_ms": round(sum(times) / max(1, len(times)), 1),
                "p50_ms": round(quantile(times, 0.5), 1) if times else None,
                "p99_ms": round(quantile(times, 0.99), 1) if times else None,
            }
        )
    return points


def _mean(rows: Sequence[Mapping[str, Any]], name: str) -> float | None:
    values = [float(row[name]) for row in rows if row[name] is not None]
    return round(100 * sum(values) / len(values), 1) if values else None


class GoldTier:
    """An upstream model that is always right: gives the gold plan of an instruction after a while.

    Args:
        plans: by instruction.
        delay_ms: how long it takes.
    """

    name = Tier.UPSTREAM
    repairs = False
    model = "gold"

    def __init__(self, plans: Mapping[str, Plan], *, delay_ms: float = UPSTREAM_MS) -> None:
        self._plans = plans
        self._delay_s = delay_ms / 1000

    async def start(self) -> None:
        """It is ready."""

    async def propose(
        self, context: PlanContext, *, previous: Plan | None = None, problems: tuple[str, ...] = ()
    ) -> Proposal:
        """Give the gold plan."""
        del previous, problems
        await asyncio.sleep(self._delay_s)
        return Proposal(plan=self._plans[context.instruction], confidence=1.0, model=self.model)

    async def close(self) -> None:
        """Nothing to release."""


def gold_plan(gold: Mapping[str, Any]) -> Plan:
    """Return the gold plan of a case as a plan."""
    return Plan(
        domain=str(gold.get("domain", "")),
        subtasks=tuple(
            Subtask(
                id=str(each["id"]),
                skill=str(each["skill"]),
                robot=each.get("robot"),
                params=dict(each.get("params") or {}),
                after=tuple(each.get("after") or ()),
            )
            for each in gold["subtasks"]
        ),
    )
