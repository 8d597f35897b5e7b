"""Numbers and letters that are meant without being said: those between the ends of "pumps 4 to 7" and "bays A to D"."""

import re
from collections.abc import Iterator

from appliance.llm.language.words import Words

MOST = 20
"""A longer range is no list of things to do one after the other."""
_TO = frozenset({"to", "through", "thru", "till", "until", "-", "–", "—", "up"})
_MARK = re.compile(r"\d{1,4}|[a-z]")


def between(words: Words) -> tuple[str, ...]:
    """Return what lies between the ends of an instruction's ranges, in order, each once; not the ends."""
    return tuple(dict.fromkeys(mark for first, last in _ends(words) for mark in _inside(first, last)))


def _ends(words: Words) -> Iterator[tuple[str, str]]:
    said = [words[number].lower() for number in range(words.own)]
    for at, first in enumerate(said):
        if not _MARK.fullmatch(first):
            continue
        end = at + 1
        while end < len(said) and said[end] in _TO:
            end += 1
        if at + 1 < end < len(said) and _MARK.fullmatch(said[end]):
            yield first, said[end]


def _inside(first: str, last: str) -> list[str]:
    if first.isdigit() and last.isdigit():
        low, high = int(first), int(last)
        return [str(each) for each in range(low + 1, high)] if high - low <= MOST and first == str(low) else []
    if first.isalpha() and last.isalpha():
        return [chr(each) for each in range(ord(first) + 1, ord(last))] if ord(last) - ord(first) <= MOST else []
    return []
