"""Gives what an example names other names, each the same wherever it is said."""

import random
from collections.abc import Sequence

from appliance.llm import values
from workshop.train.examples import ROBOT, Example, Span, spans, substitute
from workshop.train.lexicon import Lexicon

_NUMERIC = frozenset({"laps", "count", "epochs", "fps"})


def renamed(example: Example, lexicon: Lexicon, rng: random.Random, *, share: float = 0.7) -> Example:
    """Return an example with other names for what it names, each the same wherever it is said."""
    found = list(spans(example))
    if any(span.first >= example.own for span in found):
        return example  # a group was resolved by the roster: the names' kinds matter
    runs: dict[tuple[str, ...], Span] = {}
    for span in found:
        numeric = span.role in _NUMERIC or values.unit_of(span.role)
        if span.alone and not numeric and span.role not in values.FREE:
            runs.setdefault(example.words[span.first : span.last + 1], span)
    swaps: list[tuple[int, int, Sequence[str]]] = []
    taken: set[int] = set()
    roster = {word: word for word in example.words[example.own :]}
    # The longest first: "red box" before "box".
    for words, span in sorted(runs.items(), key=lambda each: -len(each[0])):
        if rng.random() > share:
            continue
        places = [at for at in range(example.own - len(words) + 1) if example.words[at : at + len(words)] == words]
        places = [at for at in places if not taken & set(range(at, at + len(words)))]
        if not all(_movable(found, at, at + len(words) - 1) for at in places):
            continue
        other = lexicon.noun(span.role, rng)
        name = values.robot(" ".join(words))
        if span.role == ROBOT and name in roster:
            roster[name] = values.robot(" ".join(other))
        elif name in roster:
            continue
        for at in places:
            swaps.append((at, at + len(words) - 1, other))
            taken.update(range(at, at + len(words)))
    for number in range(example.own, len(example.words)):
        word = example.words[number]
        if roster[word] != word:
            swaps.append((number, number, (roster[word],)))
    return substitute(example, sorted(swaps, key=lambda each: each[0])) if swaps else example


def _movable(found: Sequence[Span], first: int, last: int) -> bool:
    """Whether every pointer keeps clear of a run, is the run, or covers it."""
    return all(
        span.last < first
        or span.first > last
        or (
            span.first <= first
            and span.last >= last
            and span.role not in values.FREE
            and (span.first, span.last) == (first, last)
        )
        or (span.first <= first and span.last >= last and span.role in values.FREE)
        for span in found
    )
