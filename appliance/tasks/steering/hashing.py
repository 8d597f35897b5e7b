"""The hash of a plan as an operator gives it: it may be cut short. Pure."""

from appliance.model import plan_hash

__all__ = ["SHORTEST", "matches", "plan_hash"]

SHORTEST = 8
"""Characters of a hash that an approval must give at least: a person reads them from a screen."""


def matches(given: str, known: str) -> bool:
    """Whether a hash that an operator gives, or the beginning of it, means this plan."""
    return len(given) >= SHORTEST and known.startswith(given.lower())
