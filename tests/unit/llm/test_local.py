"""Which of a model's answers the local tier takes; the model itself is real in tests/integration."""

from typing import Any

import pytest

from appliance.errors import PlanError
from appliance.llm.local import LocalTier
from appliance.llm.settings import LlmConfig, PlanContext
from appliance.model import RobotInfo
from appliance.skills.catalogue import load_catalogue

pytestmark = pytest.mark.anyio

CATALOGUE = load_catalogue()
GOTO = CATALOGUE.skills["goto"]
ROVER = RobotInfo(id="rover_1", kind="zenoh", uses=tuple(GOTO.uses), verbs=tuple(GOTO.verbs))
CONTEXT = PlanContext(instruction="rover_1 goes to dock 3", robots=(ROVER,))
RIGHT = ["navigation", "goto", "w0", "w0", "place:", "w3", "w4"]
NOWHERE = ["navigation", "goto", "w0", "w0"]
UNREADABLE = ["navigation", "goto", "w99", "w99", "place:", "w3", "w4"]
REFUSED = ["none", "chatter"]


class Model:
    """A model's process that answers what it was made with, likeliest first."""

    folder = "/models/fake"
    speaks = True

    def __init__(self, *answers: tuple[list[str], float]) -> None:
        (symbols, confidence), *others = answers
        self.reply: dict[str, Any] = {
            "symbols": symbols,
            "confidence": confidence,
            "others": [{"symbols": each, "confidence": sure} for each, sure in others],
            "tokens": 30,
            "ms": 5.0,
        }

    async def ready(self) -> None:
        """It is."""

    async def exchange(self, _: dict[str, Any]) -> dict[str, Any]:
        """Answer."""
        return self.reply


async def asked(*answers: tuple[list[str], float]) -> tuple[dict[str, object], float]:
    """Return parameters and confidence of what the tier proposes."""
    tier = LocalTier(LlmConfig(local_model=Model.folder), CATALOGUE)
    tier._process = Model(*answers)  # pyright: ignore[reportAttributeAccessIssue]
    proposal = await tier.propose(CONTEXT)
    return proposal.plan.subtasks[0].params, proposal.confidence


async def test_the_likeliest_answer_that_breaks_no_rule_is_taken() -> None:
    """With its own confidence: an unlikely plan does not borrow that of the one it replaces."""
    assert await asked((RIGHT, 0.9), (NOWHERE, 0.05)) == ({"place": "dock 3"}, 0.9)
    assert await asked((NOWHERE, 0.8), (UNREADABLE, 0.1), (REFUSED, 0.05), (RIGHT, 0.04)) == ({"place": "dock 3"}, 0.04)


async def test_when_all_break_a_rule_the_likeliest_is_told() -> None:
    """Its problems are what repair and refusal go by."""
    assert await asked((NOWHERE, 0.8), (UNREADABLE, 0.1), (NOWHERE, 0.05)) == ({}, 0.8)


async def test_a_refusal_is_no_plan() -> None:
    """Whatever else the model might have said, it found no order in the words."""
    with pytest.raises(PlanError, match="holds no order"):
        await asked((REFUSED, 0.9), (RIGHT, 0.1))
