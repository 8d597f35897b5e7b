"""Says an order in other words that mean the same under the rules of plans (`wordings.toml`).

A verb is changed only right before the words of a parameter of its own skill, articles apart, so that "take" of "take
off" or of "take a photo" is never met; nothing that the plan points at is changed.
"""

import random
import tomllib
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path

from workshop.train.examples import DETERMINERS, Example, pointed, spans, substitute

Phrase = tuple[str, ...]
Others = dict[Phrase, tuple[Phrase, ...]]
"""What may stand for a phrase, by the phrase."""

_DOUBLED = {
    **{
        each: f"{each}{each[-1]}ing"
        for each in ("get", "put", "set", "shut", "cut", "grab", "map", "snap", "spot", "plug")
    },
    **{
        each: f"{each}{each[-1]}ing"
        for each in ("stop", "drop", "scrub", "mop", "trim", "chop", "pin", "tag", "split", "run")
    },
    "undo": "undoing",
}


def _third(verb: str) -> str:
    """Return the form of "it photographs"."""
    if verb == "have":
        return "has"
    if verb.endswith("y") and verb[-2] not in "aeiou":
        return f"{verb[:-1]}ies"
    return f"{verb}es" if verb.endswith(("s", "x", "z", "ch", "sh", "o")) else f"{verb}s"


def going_on(verb: str) -> str:
    """Return the form of "while photographing"."""
    if verb in _DOUBLED:
        return _DOUBLED[verb]
    return f"{verb[:-1]}ing" if verb.endswith("e") and not verb.endswith("ee") else f"{verb}ing"


def _forms(words: Phrase) -> Iterator[Phrase | None]:
    """Yield the forms of a phrase that begins with a verb, always as many; None for one that it does not have."""
    verb, *rest = words
    its = ["its" if each == "your" else each for each in rest]
    yield words
    yield None if "and" in rest else (_third(verb), *its)
    yield None if "and" in rest else (going_on(verb), *its)


def _others(words: Sequence[str], only: Sequence[str], *, verb: bool) -> Others:
    """Return what may stand for each of `only`, form by form."""
    found: Others = {}
    columns = zip(*(_forms(tuple(each.split())) if verb else ((tuple(each.split())),) for each in words), strict=True)
    for column in columns:
        for text, phrase in zip(words, column, strict=True):
            if text in only and phrase is not None:
                found[phrase] = tuple(each for each in column if each is not None and each != phrase)
    return found


class _Wordings:
    """The lists of the file, by what they are looked up with."""

    def __init__(self) -> None:
        lists = tomllib.loads(Path(__file__).with_name("wordings.toml").read_text(encoding="utf-8"))
        self.verbs: dict[tuple[str, str], Others] = {}
        self.phrases: defaultdict[str, list[Others]] = defaultdict(list)
        """By skill; those of order by ""."""
        for each in lists["verb"]:
            others = _others(each["words"], each.get("only", each["words"]), verb=True)
            for role in each["roles"]:
                self.verbs[each["skill"], role] = others
        for each in lists["phrase"]:
            self.phrases[each["skill"]].append(_others(each["words"], each.get("only", each["words"]), verb=True))
        for each in lists["order"]:
            self.phrases[""].append(_others(each["words"], each.get("only", each["words"]), verb=False))


_WORDINGS = _Wordings()
_LONGEST = 6


def reworded(example: Example, rng: random.Random, *, share: float = 0.5) -> Example:
    """Return an example with other words for some of its verbs and its words of order.

    Args:
        example: the example.
        rng: of everything that is random.
        share: of what can be changed.
    """
    if example.symbols[0] == "none":
        return example
    runs: dict[int, tuple[int, Phrase]] = {}
    taken = set(pointed(example))
    for first, last, others in _found(example, taken):
        place = range(first, last + 1)
        if taken.isdisjoint(place):
            taken.update(place)
            if rng.random() < share:
                runs[first] = (last, rng.choice(others))
    return substitute(example, [(first, last, words) for first, (last, words) in sorted(runs.items())])


def _found(example: Example, kept: set[int]) -> Iterator[tuple[int, int, Sequence[Phrase]]]:
    """Yield the first and the last word of what can be said in other words, and those."""
    words, symbols = example.words, example.symbols
    starts = [1, *(at + 1 for at, each in enumerate(symbols) if each == "|")]
    for span in spans(example):
        skill = symbols[max(start for start in starts if start <= span.at)]
        others = _WORDINGS.verbs.get((skill, span.role))
        if not others or span.first >= example.own:
            continue
        end = span.first
        while end and words[end - 1] in DETERMINERS and end - 1 not in kept:
            end -= 1
        for length in range(min(_LONGEST, end), 0, -1):
            if (phrase := words[end - length : end]) in others:
                # After an article it is a noun: "the lift to floor 2".
                if end == length or words[end - length - 1] not in DETERMINERS:
                    yield end - length, end - 1, others[phrase]
                break
    skills = ("", *dict.fromkeys(symbols[start] for start in starts))
    tables = [table for skill in skills for table in _WORDINGS.phrases.get(skill, ())]
    begins = {phrase[0] for table in tables for phrase in table}
    for first in range(example.own):
        if words[first] not in begins:
            continue
        for length in range(min(_LONGEST, example.own - first), 0, -1):
            phrase = words[first : first + length]
            if others := next((table[phrase] for table in tables if phrase in table), None):
                yield first, first + length - 1, others
                break
