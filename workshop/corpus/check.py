"""Whether a pair may be trained on: its plan keeps the rules of plans (`appliance.llm.checks.consistency`).

What is left to the writer is the meaning.
"""

import math
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence

from msgspec import Struct, field

from appliance.llm.checks import consistency as sense
from appliance.llm.checks.consistency import stem
from appliance.model import Subtask
from appliance.skills.catalogue import Catalogue
from workshop.corpus.notation import Pair


class Tally(Struct, frozen=True, kw_only=True):
    """Counts over pairs; `skills` counts the pairs a skill occurs in, `lengths` pairs by number of subtasks."""

    pairs: int
    skills: Counter[str] = field(default_factory=Counter[str])
    domains: Counter[str] = field(default_factory=Counter[str])
    voices: Counter[str] = field(default_factory=Counter[str])
    sources: Counter[str] = field(default_factory=Counter[str])
    lengths: Counter[int] = field(default_factory=Counter[int])
    refused: Counter[str] = field(default_factory=Counter[str])


def tally(pairs: Iterable[Pair]) -> Tally:
    """Count what pairs cover."""
    listed = list(pairs)
    planned = [pair for pair in listed if not pair.refused]
    return Tally(
        pairs=len(listed),
        skills=Counter(skill for pair in planned for skill in {subtask.skill for subtask in pair.subtasks}),
        domains=Counter(pair.domain for pair in planned),
        voices=Counter(pair.voice for pair in listed),
        sources=Counter(pair.source for pair in listed),
        lengths=Counter(len(pair.subtasks) for pair in planned),
        refused=Counter(pair.refused for pair in listed if pair.refused),
    )


LITERAL = 4
"""Skeletons with fewer words than this of their own ("go to _ and inspect _") cannot but be alike."""
SHARED = 0.75
"""Share of words in common from which on two instructions are copies."""
_WORD = re.compile(r"[a-z0-9]+")
_STOP = frozenset(
    {"the", "a", "an", "of", "to", "in", "on", "at", "and", "then", "it", "is", "please", "you", "your", "for", "with"}
    | {"from", "by"}
)


def skeleton(instruction: str, subtasks: Sequence[Subtask]) -> tuple[str, ...]:
    """Return the words of an instruction with every run of words from its plan's parameters as one `_`."""
    nouns: set[str] = {"robot", "drone"}
    for subtask in subtasks:
        for value in (subtask.robot, *subtask.params.values()):
            for text in value if isinstance(value, list) else [value]:  # pyright: ignore[reportUnknownVariableType]
                nouns |= {stem(word) for word in _WORD.findall(str(text).lower())}  # pyright: ignore[reportUnknownArgumentType]
    nouns -= _STOP
    words: list[str] = []
    for word in _WORD.findall(instruction.lower()):
        blank = stem(word) in nouns or word[0].isdigit() or word[-1].isdigit()
        if not blank:
            words.append(word)
        elif words[-1:] != ["_"]:
            words.append("_")
    return tuple(words)


def words(instruction: str) -> frozenset[str]:
    """Return the words that count when copies are looked for."""
    return frozenset(_WORD.findall(instruction.lower())) - _STOP


def too_near(
    pairs: Mapping[str, tuple[str, Sequence[Subtask]]],
    others: Mapping[str, tuple[str, Sequence[Subtask]]] | None = None,
) -> Iterable[str]:
    """Yield a sentence for each pair that copies one of `others`, or, without these, an earlier pair of its own.

    Args:
        pairs: instruction and plan, by a name that says where they are.
        others: a test set, laid out alike.
    """
    frames: dict[tuple[str, ...], str] = {}
    bags = _Bags(words(instruction) for instruction, _ in (*pairs.values(), *(others or {}).values()))
    for name, (instruction, subtasks) in (others or {}).items():
        frames.setdefault(skeleton(instruction, subtasks), name)
        bags.add(name, words(instruction))
    for name, (instruction, subtasks) in pairs.items():
        frame, bag = skeleton(instruction, subtasks), words(instruction)
        if sum(word != "_" and word not in _STOP for word in frame) >= LITERAL and frame in frames:
            yield f"{name}: the same sentence as {frames[frame]} with other nouns"
        if other := bags.nearest(bag):
            yield f"{name}: has most words in common with {other}"
        if others is None:
            frames.setdefault(frame, name)
            bags.add(name, bag)


class _Bags:
    """Word sets, found again by what is near them.

    Two sets of which `SHARED` of all words are common share one of the rarest few of each: only those are looked up
    (prefix filtering; Chaudhuri et al., ICDE 2006), so that thousands of instructions are compared in a second.
    """

    def __init__(self, every: Iterable[frozenset[str]]) -> None:
        self._counts = Counter(word for bag in every for word in bag)
        self._by_word: defaultdict[str, list[tuple[str, frozenset[str]]]] = defaultdict(list)

    def add(self, name: str, bag: frozenset[str]) -> None:
        for word in self._rarest(bag):
            self._by_word[word].append((name, bag))

    def nearest(self, bag: frozenset[str]) -> str:
        """Return the name of one that is too near; empty when there is none."""
        for word in self._rarest(bag):
            for name, other in self._by_word.get(word, ()):
                shared = len(bag & other)
                if bag == other or (shared >= 3 and shared >= SHARED * len(bag | other)):
                    return name
        return ""

    def _rarest(self, bag: frozenset[str]) -> list[str]:
        ordered = sorted(bag, key=lambda word: (self._counts[word], word))
        return ordered[: len(bag) - math.ceil(SHARED * len(bag)) + 1]


def problems(pair: Pair, catalogue: Catalogue) -> tuple[str, ...]:
    """Return everything that is wrong with a pair, each as a sentence; nothing when it may be trained on."""
    if pair.refused:
        return ()
    meaning = sense.Meaning(
        instruction=pair.instruction, robots=pair.robots, domain=pair.domain, subtasks=pair.subtasks
    )
    return sense.problems(meaning, catalogue)
