"""A training example: numbered words and the symbols of the plan over them.

Since a plan points at words, changing an example is changing its words: renaming, inserting and leaving out words keeps
the plan exact as long as the pointers move along. The functions here do that bookkeeping.
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence

from msgspec import Struct
from msgspec.structs import replace

from appliance.llm import values
from appliance.llm.language import Answer, read, write
from appliance.llm.words import words_of
from appliance.skills.catalogue import Catalogue
from workshop.corpus.notation import Pair

_POINTER = re.compile(r"w(\d+)")
DETERMINERS = frozenset(
    {"the", "a", "an", "this", "that", "these", "those", "my", "your", "our", "his", "her", "its", "their", "some"}
)
"""What may stand before a name without being of it."""
ROBOT = "robot"
"""Role of the words that name a robot."""


class Example(Struct, frozen=True):
    """Words (lower case; those of the roster last) and the symbols of the answer. `own` words are the instruction's."""

    words: tuple[str, ...]
    own: int
    symbols: tuple[str, ...]

    @property
    def text(self) -> str:
        """The instruction as it could be written: blanks between words, none before a mark."""
        return re.sub(r" (?=[,.;:!?)])", "", " ".join(self.words[: self.own]))


class Span(Struct, frozen=True):
    """A run of words that the plan points at. `role` is the parameter's name, or `robot`; `at` its first symbol."""

    first: int
    last: int
    role: str
    at: int
    alone: bool
    """Whether it is the whole value: not a piece of a joined name, nor made singular."""


def example_of(pair: Pair, catalogue: Catalogue) -> Example:
    """Return the example of a hand-written pair."""
    words = words_of(pair.instruction, pair.robots)
    answer = Answer(domain=pair.domain, subtasks=pair.subtasks, refused=pair.refused)
    symbols = write(answer, words, catalogue)
    return Example(tuple(words[number].lower() for number in range(len(words))), words.own, tuple(symbols))


def spans(example: Example) -> Iterator[Span]:
    """Yield the runs of words a plan points at, in the order of its symbols."""
    role, symbols = ROBOT, example.symbols
    at = 0
    while at < len(symbols):
        symbol = symbols[at]
        if symbol == "|":
            role = ROBOT
        elif symbol.endswith(":") and not symbol.startswith('"'):
            role = ROBOT if symbol == "robots:" else symbol[:-1]
        elif match := _POINTER.fullmatch(symbol):
            after = symbols[at + 2 : at + 3]
            alone = after not in (("+",), ("~",)) and symbols[at - 1] not in ("+", "@")
            yield Span(int(match[1]), int(symbols[at + 1][1:]), role, at, alone)
            at += 1
        at += 1


def moved(symbols: Iterable[str], new: Mapping[int, int]) -> tuple[str, ...]:
    """Return symbols with their pointers changed; words that `new` does not name must not be pointed at."""
    return tuple(f"w{new[int(match[1])]}" if (match := _POINTER.fullmatch(each)) else each for each in symbols)


def substitute(example: Example, runs: Sequence[tuple[int, int, Sequence[str]]]) -> Example:
    """Return an example with runs of words replaced by others.

    Args:
        example: the example.
        runs: first and last word, and the words in their place (none to leave them out); without overlap, in order. A
            pointer may lie outside a run, or be the run from its first to its last word, or cover it whole.
    """
    words: list[str] = []
    begins: dict[int, int] = {}
    ends: dict[int, int] = {}
    own, at = 0, 0
    for first, last, other in (*runs, (len(example.words), len(example.words), ())):
        for number in range(at, first):
            begins[number] = ends[number] = len(words)
            own += number < example.own
            words.append(example.words[number])
        if first == len(example.words):
            break
        begins[first], ends[last] = len(words), len(words) + len(other) - 1
        words += other
        own += len(other) if first < example.own else 0
        at = last + 1
    symbols = list(example.symbols)
    at = 0
    while at < len(symbols):
        if match := _POINTER.fullmatch(symbols[at]):
            symbols[at] = f"w{begins[int(match[1])]}"
            symbols[at + 1] = f"w{ends[int(symbols[at + 1][1:])]}"
            at += 1
        at += 1
    return Example(tuple(words), own, tuple(symbols))


def inserted(example: Example, at: int, words: Sequence[str]) -> Example:
    """Return an instruction with words put in before one of its own, or behind the last."""
    symbols = tuple(
        f"w{int(each[1:]) + (len(words) if int(each[1:]) >= at else 0)}" if re.fullmatch(r"w\d+", each) else each
        for each in example.symbols
    )
    return Example((*example.words[:at], *words, *example.words[at:]), example.own + len(words), symbols)


def pointed(example: Example) -> frozenset[int]:
    """Return the numbers of all words that a plan points at."""
    return frozenset(number for span in spans(example) for number in range(span.first, span.last + 1))


def said(example: Example, span: Span) -> str:
    """Return what a run of words means as a name."""
    return values.name(" ".join(example.words[span.first : span.last + 1]))


def is_exact(example: Example, catalogue: Catalogue) -> bool:
    """Whether the symbols are an answer over the words, and one that is pointed at the way `write` does."""
    words = words_of(" ".join(example.words[: example.own]), example.words[example.own :])
    if len(words) != len(example.words):
        return False
    answer = read(example.symbols, words, catalogue)
    return bool(answer.refused or answer.subtasks)


def with_symbols(example: Example, symbols: Sequence[str]) -> Example:
    """Return an example with other symbols."""
    return replace(example, symbols=tuple(symbols))
