"""Which skills the words of an instruction speak for, without understanding it: a second opinion on an answer.

A planner that writes symbol by symbol loses a clause, or takes one verb for another, and is sure of it. A linear
classifier over the same words, one yes or no for each skill (Joachims 1998, "Text categorization with support vector
machines": many weak cues, hardly any irrelevant), errs too, but elsewhere. So its opinion of the skills that an answer
has, and of those that it lacks, is added to the answer's own probability when the best of several is chosen
(`speaking`). Skills that it was not trained on are left out; so is `goto`, which follows from places, not from verbs.
"""

import math
import zlib
from collections.abc import Collection, Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import msgspec
from msgspec import Struct

FILE = "evidence.bin"
UNSAID = frozenset({"goto"})
"""Skills that a plan may have without a word for them."""
_STEM = 5
"""Letters of a word that count as its stem."""
_MOST = 30.0


class Evidence(Struct, frozen=True, kw_only=True):
    """The classifier: the log-odds of a skill are its bias and the weights of all cues, times the scale."""

    skills: tuple[str, ...]
    bias: tuple[float, ...]
    scale: float
    rows: dict[int, bytes]
    """Of each cue that is known, by its checksum: a signed byte for each skill."""

    def odds(self, words: Sequence[str]) -> dict[str, float]:
        """Return the log-odds that a plan for these words (lower case) has each skill."""
        sums = [0] * len(self.skills)
        for cue in cues(words):
            if (row := self.rows.get(cue)) is not None:
                sums = [one + two for one, two in zip(sums, memoryview(row).cast("b"), strict=True)]
        return {
            skill: bias + self.scale * total for skill, bias, total in zip(self.skills, self.bias, sums, strict=True)
        }


def cues(words: Sequence[str]) -> list[int]:
    """Return checksums of what words may be known by: each, its stem, each with the next, and with the one after."""
    found = [each for word in words for each in (word, f"{word[:_STEM]}*")]
    found += [f"{one} {two}" for one, two in pairwise(words)]
    found += [f"{one} _ {two}" for one, two in zip(words, words[2:], strict=False)]
    return [zlib.crc32(each.encode()) for each in found]


def skills_of(symbols: Sequence[str]) -> frozenset[str]:
    """Return the skills of an answer; none for a refusal."""
    if symbols[:1] == ["none"] or symbols[:1] == ("none",):
        return frozenset()
    return frozenset(symbol for before, symbol in pairwise(("|", *symbols[1:])) if before == "|")


def support(odds: Mapping[str, float], skills: Collection[str]) -> float:
    """Return the logarithm of the probability that of all skills with odds just these are in the plan; 0 at most."""
    return -sum(
        math.log1p(math.exp(min(_MOST, -value if skill in skills else value)))
        for skill, value in odds.items()
        if skill not in UNSAID
    )


def read_evidence(folder: Path) -> Evidence | None:
    """Return the evidence of a model folder; None where it has none.

    Raises:
        ValueError: it is damaged.
    """
    path = folder / FILE
    if not path.is_file():
        return None
    try:
        evidence = msgspec.msgpack.decode(path.read_bytes(), type=Evidence)
    except msgspec.DecodeError as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    count = len(evidence.skills)
    if len(evidence.bias) != count or any(len(row) != count for row in evidence.rows.values()):
        raise ValueError(f"{path} is damaged: not a weight for each of {count} skills")
    return evidence


def write_evidence(folder: Path, evidence: Evidence) -> None:
    """Write the evidence into a model folder."""
    (folder / FILE).write_bytes(msgspec.msgpack.encode(evidence))
