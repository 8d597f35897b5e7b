"""The curve accuracy against share escalated, and the account of a load, as plain functions."""

import pytest

from workshop.bench.plan.load import INSTRUCTIONS, Told, account
from workshop.bench.plan.quality import Answered, curve, run

pytestmark = pytest.mark.anyio

RIGHT = {"decomposition": 1.0, "parallel_recall": None, "exact": 1.0}
WRONG = {"decomposition": 0.5, "parallel_recall": 0.0, "exact": 0.0}
GOLD = {"decomposition": 1.0, "parallel_recall": 1.0, "exact": 1.0}


def test_escalating_the_unsure_ones_trades_share_for_accuracy() -> None:
    """At 0 only what has no plan goes up, at 1 nearly all does; accuracy and latency rise with it."""
    answered = [
        Answered(confidence=0.9, latency_ms=2, row=RIGHT, gold=GOLD),
        Answered(confidence=0.4, latency_ms=2, row=WRONG, gold=GOLD),
        Answered(confidence=0.0, latency_ms=0, row=WRONG, gold=GOLD),
        Answered(confidence=1.0, latency_ms=2, row=RIGHT, gold=GOLD),
    ]
    points = curve(answered, thresholds=(0.0, 0.5, 1.0), upstream_ms=1000)
    assert [each["escalated"] for each in points] == [25.0, 50.0, 75.0]
    assert [each["decomposition"] for each in points] == [87.5, 100.0, 100.0]
    assert points[1]["p50_ms"] == 2
    assert points[2]["p50_ms"] == 1000
    assert points[0]["exact"] < points[1]["exact"]


def test_what_ends_in_nothing_is_lost() -> None:
    """Plans, clear answers and refusals with a time are accounted for; anything else is lost, with the reason."""
    told = [
        Told(kind="plan", ms=10),
        Told(kind="no plan", ms=5),
        Told(kind="refused", ms=1, why="later", retry_after_s=0.4),
        Told(kind="refused", ms=1, why="later"),
        Told(kind="deadline: none", ms=30_000),
    ]
    found = account(told, rate=20, seconds=1)
    assert (found["asked"], found["plans"], found["no_plan"], found["refused"], found["lost"]) == (5, 1, 1, 2, 1)
    assert found["refused_without_time"] == 1
    assert found["lost_why"] == {"deadline: none": 1}
    assert found["answered_ms"]["count"] == 2
    assert len(set(INSTRUCTIONS)) == len(INSTRUCTIONS)


async def test_the_real_cascade_with_a_stand_in() -> None:
    """The same cases through the real cascade: what the rules were not sure of is answered by the stand-in."""
    result = await run(limit=12)
    assert "rules" in result["routed_on"]
    assert "no local model" in result["routed_on"]
    escalated = [each["escalated"] for each in result["curve"]]
    assert escalated == sorted(escalated)
    assert result["curve"][-1]["decomposition"] >= result["curve"][0]["decomposition"]
    assert result["cascade"]["planless"] == 0
    assert result["cascade"]["figures"]["decomposition"] >= result["taken"]["decomposition"] - 1
