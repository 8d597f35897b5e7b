"""How likely a plan of the rules is right."""

import pytest

from appliance.llm.rules.tier import RulesTier, odds_right
from appliance.llm.settings import PlanContext
from appliance.skills.catalogue import load_catalogue


def test_what_speaks_for_a_plan_of_the_rules() -> None:
    """Words understood, a short sentence, and many orders for its words: each makes it likelier."""
    plain = odds_right(1.0, words=10, subtasks=3)
    assert plain > odds_right(0.95, words=10, subtasks=3) > odds_right(0.7, words=10, subtasks=3)
    assert plain > odds_right(1.0, words=25, subtasks=3)
    assert plain > odds_right(1.0, words=10, subtasks=1)


@pytest.mark.parametrize(("understood", "words", "subtasks"), [(0.0, 0, 0), (1.0, 1, 64), (1.0, 4000, 1)])
def test_whatever_it_is_told_it_is_a_probability(understood: float, words: int, subtasks: int) -> None:
    """No words, more orders than words, and a book."""
    assert 0 <= odds_right(understood, words=words, subtasks=subtasks) <= 1


@pytest.mark.anyio
async def test_the_rules_say_how_likely_they_are_right() -> None:
    """A probability, not the share of the words that fitted a pattern."""
    proposal = await RulesTier(load_catalogue()).propose(
        PlanContext(instruction="Rex: go to dock 1, then take a photo")
    )
    assert 0.2 < proposal.confidence < 0.9
