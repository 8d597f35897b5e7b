"""Nouns that variation draws from: what the corpus itself names, made-up words, codes and numbers.

Copying must work for names that no training data has, so a part of the nouns are words that do not exist: built of
syllables, and codes as machines have them. They differ from example to example, which leaves nothing to learn by heart.
"""

import random
import tomllib
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path

from workshop.train.examples import ROBOT, Example, said, spans

_NOUNS = {
    name: tuple(words.split())
    for name, words in tomllib.loads(Path(__file__).with_name("nouns.toml").read_text(encoding="utf-8")).items()
}
_ONSETS = (
    (*"bcdfghjklmnprstvwyz", "br", "ch", "cl", "dr", "fl", "gr", "kl", "pl", "qu", "sc", "sh", "sk", "st", "tr"),
    tuple("bdfgklmnprstvz"),
)
_VOWELS = (*"aeioaeiou", "ai", "ea", "ee", "ie", "oo", "ou")
_CODAS = (*"bdlmnprstx", "ck", "ll", "nd", "ng", "nk", "rd", "rk", "rn", "sh", "ss", "st")
PLACE_ROLES = frozenset({"place", "area", "at", "station", "into", "path"})
PERSON_ROLES = frozenset({"to", "person"})


class Lexicon:
    """Draws nouns for a role.

    Args:
        examples: whose names are drawn again, by role.
    """

    def __init__(self, examples: Iterable[Example]) -> None:
        found: defaultdict[str, set[tuple[str, ...]]] = defaultdict(set)
        for example in examples:
            for span in spans(example):
                if span.alone:
                    words = example.words[span.first : span.last + 1]
                    if said(example, span) == " ".join(words):
                        found[span.role].add(words)
        self._found = {role: sorted(each) for role, each in found.items()}

    def noun(self, role: str, rng: random.Random) -> tuple[str, ...]:
        """Return a name of one to three words for a role; a made-up one now and then."""
        roll = rng.random()
        known = self._found.get(role)
        if known and roll < 0.35:
            return rng.choice(known)
        if role == ROBOT:
            return (self._robot(rng),)
        if roll < 0.5:
            return made_up(rng)
        if role in PERSON_ROLES and roll < 0.9:
            return (rng.choice(_NOUNS[rng.choice(("names", "people"))]),)
        if role in PLACE_ROLES:
            return _numbered(rng, rng.choice(_NOUNS["places"]), _NOUNS["qualities"] + _NOUNS["things"])
        return _numbered(rng, rng.choice(_NOUNS["things"]), _NOUNS[rng.choice(("qualities", "things"))])

    def _robot(self, rng: random.Random) -> str:
        name = rng.choice(_NOUNS["robots"]) if rng.random() < 0.7 else syllables(rng)
        roll = rng.random()
        return (
            name if roll < 0.3 else f"{name}_{rng.randrange(1, 30)}" if roll < 0.75 else f"{name}{rng.randrange(1, 10)}"
        )


def _numbered(rng: random.Random, noun: str, before: Sequence[str]) -> tuple[str, ...]:
    """Return a noun, alone, with a number or a letter behind it, or with a word before it."""
    roll = rng.random()
    if roll < 0.3:
        return (noun, str(rng.randrange(1, 60)))
    if roll < 0.4:
        return (noun, rng.choice("abcdefgh"))
    return (noun,) if roll < 0.65 else (rng.choice(before), noun)


def made_up(rng: random.Random) -> tuple[str, ...]:
    """Return a name that means nothing: a word of syllables, or a code."""
    roll = rng.random()
    if roll < 0.5:
        return (syllables(rng),)
    if roll < 0.7:
        return (syllables(rng), rng.choice((*_NOUNS["things"], *_NOUNS["places"])))
    if roll < 0.85:
        return (f"{rng.choice('abcdefghkmnprstvxz')}{rng.choice(('', '-'))}{rng.randrange(1, 999)}",)
    return (
        rng.choice((*_NOUNS["things"], *_NOUNS["places"])),
        f"{rng.choice('abcdefghkmnprstvxz')}{rng.randrange(1, 99)}",
    )


def syllables(rng: random.Random) -> str:
    """Return a word that does not exist."""
    count = rng.choice((1, 2, 2, 3))
    return "".join(rng.choice(_ONSETS[index > 0]) + rng.choice(_VOWELS) for index in range(count)) + (
        rng.choice(_CODAS) if rng.random() < 0.65 else ""
    )
