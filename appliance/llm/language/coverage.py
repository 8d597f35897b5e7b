"""How much of what an instruction says stands in an answer: a planner that is short of words leaves things out.

A model's likeliest answer tends to be one that passes over a clause, since each thing that is said costs probability.
Machine translation counters that with a coverage term (Wu et al. 2016, "Google's Neural Machine Translation System",
section 7); here, where an answer points at words, coverage is what it points at.
"""

from collections.abc import Sequence

from appliance.llm.language.words import Words

_SMALL = frozenset(
    "a an the this that of to in on at onto into from by up down out off with for as "  # noqa: SIM905 - a list of words
    "and or but if so then when while after before once just not no please "
    "i me my you your we us our he him his she her it its they them their "
    "is are be been do does".split()
)
"""Words that a right answer may or may not have in its runs."""


def covered(symbols: Sequence[str], words: Words) -> int:
    """Return how many words of an instruction an answer points at, small ones, marks and the roster left out."""
    pointed = [int(each[1:]) for each in symbols if each[0] == "w" and each[1:].isdigit()]
    inside: set[int] = set()
    for first, last in zip(pointed[::2], pointed[1::2], strict=False):
        inside.update(range(first, last + 1))
    return sum(number < words.own and _weighs(words[number]) for number in inside)


def _weighs(word: str) -> bool:
    return word[0].isalnum() and word.lower() not in _SMALL
