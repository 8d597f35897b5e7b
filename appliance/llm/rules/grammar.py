"""The whole grammar: its parts in the order in which they are tried.

Going comes last, inside `handling`: "move" and "take" mean it only when nothing is moved or taken.
"""

from appliance.llm.rules import handling, moving, sensing, telling
from appliance.llm.rules.phrases import Scope, Step

_PARTS = (sensing.PATTERNS, telling.PATTERNS, moving.PATTERNS, handling.PATTERNS)


def steps_of(lemma: str, rest: str, scope: Scope) -> tuple[list[Step], str] | None:
    """Return the steps of "verb rest" and the words before its first slot, or None when no pattern fits."""
    text = f"{lemma} {rest}".strip()
    for part in _PARTS:
        if found := part.match(lemma, text, scope):
            return found
    return None
