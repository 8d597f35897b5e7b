"""What is held out of training, so that figures tell how the planner does with what it has not seen.

Three sets, disjoint from what is trained on and from one another: by *structure*, plans whose sequence of skills and
edges occurs in no trained plan; by *vocabulary*, instructions with a name (thing, place, person) that no trained
instruction has; and by *chance*. Which pair is where follows from its text alone, so a corpus that grows keeps its
splits. The order within each part follows from the texts too, so that a sample or a half of what is held out is the
same whatever files the pairs are in.
"""

import hashlib
from collections.abc import Iterable

from msgspec import Struct

from appliance.llm.language import ANY
from appliance.skills.catalogue import Catalogue
from workshop.corpus import load
from workshop.train.examples import ROBOT, Example, example_of, said, spans


def corpus_examples(catalogue: Catalogue) -> list[Example]:
    """Return the examples of all hand-written pairs."""
    return [example_of(pair, catalogue) for pair in load().values()]


STRUCTURES = 24
"""One in so many structures is held out, of those with at least three subtasks."""
NAMES = 80
"""One in so many names is held out."""
CHANCE = 100
"""One in so many of the other pairs is held out."""


class Splits(Struct, frozen=True):
    """A corpus in parts."""

    train: tuple[Example, ...]
    structure: tuple[Example, ...]
    vocabulary: tuple[Example, ...]
    chance: tuple[Example, ...]


def split(examples: Iterable[Example]) -> Splits:
    """Return a corpus in parts, each in the order of its texts' digests."""
    train: list[Example] = []
    structure: list[Example] = []
    vocabulary: list[Example] = []
    chance: list[Example] = []
    for example in sorted(examples, key=lambda example: _digest(" ".join(example.words))):
        if example.symbols.count("|") >= 2 and _chosen("structure " + shape(example), STRUCTURES):
            structure.append(example)
        elif any(_chosen("name " + name, NAMES) for name in names(example)):
            vocabulary.append(example)
        elif _chosen("pair " + " ".join(example.words), CHANCE):
            chance.append(example)
        else:
            train.append(example)
    return Splits(tuple(train), tuple(structure), tuple(vocabulary), tuple(chance))


def shape(example: Example) -> str:
    """Return a plan without its words: skills and edges."""
    parts: list[str] = []
    skill, after = True, False
    for symbol in example.symbols[1:]:
        if symbol == "|":
            skill, after = True, False
            parts.append("|")
        elif skill or after or symbol == "<":
            parts.append(symbol)
            skill, after = False, after or symbol == "<"
    return " ".join(parts)


def names(example: Example) -> frozenset[str]:
    """Return what an example names, robots left out."""
    return frozenset(
        said(example, span)
        for span in spans(example)
        if span.role != ROBOT and not ANY.fullmatch(span.role) and not said(example, span)[:1].isdigit()
    )


def _chosen(text: str, one_in: int) -> bool:
    return int.from_bytes(_digest(text)[:4], "big") % one_in == 0


def _digest(text: str) -> bytes:
    return hashlib.sha256(text.encode()).digest()
