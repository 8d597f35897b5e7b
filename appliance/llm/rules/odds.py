"""How likely a plan of the rules is right, so that it can be compared with a model's that is as sure of its own.

How much of the words was understood says little alone: of the held-out instructions that were understood word for word
a third had an exact plan, since a pattern fits sooner than it means the same. Long sentences are read wrong more often
than short ones, and such that give few orders for their words more often than plain lists of orders.
"""

import math

_BIAS, _WHOLE, _LOST, _LENGTH, _ORDERS = 0.45, 0.83, -1.69, -1.23, 0.66
"""Of a logistic regression on half of the held-out pairs; the other half was to verify it (docs/benchmarks.md)."""


def odds_right(understood: float, *, words: int, subtasks: int) -> float:
    """Return the probability, 0 to 1, that a plan of the rules is exactly what was meant.

    Args:
        understood: share of the words that fitted a pattern.
        words: of the instruction.
        subtasks: of the plan.
    """
    words = max(1, words)
    score = _BIAS + _WHOLE * (understood >= 1) + _LOST * (1 - understood)
    score += _LENGTH * math.log(words) + _ORDERS * 10 * subtasks / words
    return 1 / (1 + math.exp(-max(-60.0, min(60.0, score))))
