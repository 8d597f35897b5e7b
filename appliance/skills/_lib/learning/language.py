"""Corrects a transcript with a bigram model: which words follow which in what is usually said (noisy channel).

A word may be meant as one that is spelled nearly so, two may be one that was torn apart, one may be two that were run
together. The likeliest reading is found over the whole text (Viterbi). Standard library alone.
"""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

START = "<s>"
_BACKOFF = math.log(0.4)
"""Stupid backoff (Brants et al. 2007)."""
_MOST_WORDS = 5000


class Channel(NamedTuple):
    """How a recogniser mishears, in nats.

    Attributes:
        edit: What a letter that differs costs.
        unknown: Log-probability of a word that the language does not know.
        keep: What it costs to take such a word for right.
    """

    edit: float
    unknown: float
    keep: float


LETTERS = Channel(edit=3.0, unknown=-12.0, keep=9.0)
"""Of a recogniser that writes letters: what is no word is wrong."""
WORDS = Channel(edit=6.0, unknown=-6.0, keep=1.0)
"""Of one that writes words of a dictionary: a word that the language does not know may well be right."""


class Language(NamedTuple):
    """How often words, and pairs of words, were said."""

    words: Mapping[str, int]
    pairs: Mapping[tuple[str, str], int]

    def chance(self, before: str, word: str, unknown: float) -> float:
        """Return the log-probability of a word behind another, with backoff; that of an unknown one is given."""
        both = self.pairs.get((before, word), 0)
        if both:
            return math.log(both / self.words.get(before, both))
        alone = self.words.get(word, 0)
        if alone:
            return _BACKOFF + math.log(alone / self.total)
        return _BACKOFF + unknown

    @property
    def total(self) -> int:
        """How many words were said."""
        return _total(tuple(self.words.values()))


@lru_cache(maxsize=4)
def _total(counts: tuple[int, ...]) -> int:
    return sum(counts)


def count(sentences: Iterator[str] | Sequence[str]) -> Language:
    """Return the language of some sentences."""
    words: dict[str, int] = {}
    pairs: dict[tuple[str, str], int] = {}
    for sentence in sentences:
        before = START
        words[START] = words.get(START, 0) + 1
        for word in sentence.split():
            words[word] = words.get(word, 0) + 1
            pairs[before, word] = pairs.get((before, word), 0) + 1
            before = word
    return Language(words, pairs)


def to_json(language: Language) -> str:
    """Return a language as text, words in order: the same for the same language."""
    pairs: dict[str, dict[str, int]] = {}
    for (before, word), times in sorted(language.pairs.items()):
        pairs.setdefault(before, {})[word] = times
    return json.dumps({"words": dict(sorted(language.words.items())), "pairs": pairs}, indent=0) + "\n"


def read(file: Path) -> Language:
    """Read a language; OSError or ValueError where it cannot be."""
    table = json.loads(file.read_text(encoding="utf-8"))
    pairs = {(before, word): times for before, after in table["pairs"].items() for word, times in after.items()}
    return Language(table["words"], pairs)


class Correction(NamedTuple):
    """A corrected text, and what was changed: heard, meant."""

    text: str
    changes: tuple[tuple[str, str], ...]


def correct(text: str, language: Language, channel: Channel = LETTERS) -> Correction:
    """Return the likeliest reading of a transcript.

    Args:
        text: upper case, words parted by spaces.
        language: what is usually said.
        channel: how it was misheard.
    """
    heard = text.split()[:_MOST_WORDS]
    # best[at]: by the last word of a reading of the first `at` words, its score and what it was made of.
    best: list[dict[str, tuple[float, int, str, str]]] = [{START: (0.0, 0, "", "")}]
    for at in range(1, len(heard) + 1):
        found: dict[str, tuple[float, int, str, str]] = {}
        for length in (1, 2):
            if length > at:
                continue
            said = " ".join(heard[at - length : at])
            for meant, cost in _readings(said, language, channel):
                _extend(found, best[at - length], at - length, (said, meant, cost), language, channel.unknown)
        best.append(found)
    return _trace(best, len(heard))


def _extend(
    found: dict[str, tuple[float, int, str, str]],
    before: Mapping[str, tuple[float, int, str, str]],
    at: int,
    reading: tuple[str, str, float],
    language: Language,
    unknown: float,
) -> None:
    """Add a reading (heard, meant, cost) of the last words to each reading of those before it."""
    said, meant, cost = reading
    words = meant.split()
    for last, (score, *_) in before.items():
        total, previous = score - cost, last
        for word in words:
            total += language.chance(previous, word, unknown)
            previous = word
        key = words[-1]
        if key not in found or total > found[key][0]:
            found[key] = (total, at, last, f"{said}\t{meant}")


def _trace(best: Sequence[Mapping[str, tuple[float, int, str, str]]], end: int) -> Correction:
    words: list[str] = []
    changes: list[tuple[str, str]] = []
    if end == 0:
        return Correction("", ())
    last = max(best[end], key=lambda word: (best[end][word][0], word))
    while end:
        _, before, previous, step = best[end][last]
        said, meant = step.split("\t")
        words.append(meant)
        if said != meant:
            changes.append((said, meant))
        end, last = before, previous
    return Correction(" ".join(reversed(words)), tuple(reversed(changes)))


def _readings(said: str, language: Language, channel: Channel) -> Iterator[tuple[str, float]]:
    """Yield what some heard words may be meant as, with the cost of hearing them so."""
    if " " not in said:
        yield said, 0.0 if said in language.words else channel.keep
        yield from ((f"{left} {right}", 2 * channel.edit) for left, right in _torn(said, language))
    joined = said.replace(" ", "")
    most = 1 if len(joined) < 4 else 2
    extra = 0.0 if joined == said else channel.edit
    for word in language.words:
        if word not in (START, said) and abs(len(word) - len(joined)) <= most:
            distance = edits(joined, word, most)
            if distance <= most:
                yield word, extra + channel.edit * distance


def _torn(said: str, language: Language) -> Iterator[tuple[str, str]]:
    for at in range(1, len(said)):
        if said[:at] in language.words and said[at:] in language.words:
            yield said[:at], said[at:]


@lru_cache(maxsize=100_000)
def edits(one: str, other: str, most: int) -> int:
    """Return the letters to insert, delete or replace to make one of the other; more than `most` is `most + 1`."""
    row = list(range(len(other) + 1))
    for number, letter in enumerate(one, start=1):
        before, row[0] = row[0], number
        for place, each in enumerate(other, start=1):
            before, row[place] = row[place], min(row[place] + 1, row[place - 1] + 1, before + (letter != each))
        if min(row) > most:
            return most + 1
    return min(row[-1], most + 1)
