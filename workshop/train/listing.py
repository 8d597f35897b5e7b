"""Makes an order about one thing one about several of a kind: by numbers, by letters, or by what each looks like.

One robot does them one after the other, so each waits for the one before it (`../corpus/README.md`).
"""

import random
import tomllib
from collections.abc import Sequence
from pathlib import Path

from msgspec import Struct

from appliance.llm.words import singular
from workshop.train.examples import DETERMINERS, Example, spans
from workshop.train.linking import subtasks_of

_PHRASES: dict[str, list[str]] = tomllib.loads(Path(__file__).with_name("phrases.toml").read_text(encoding="utf-8"))
_QUALITIES = tuple(
    tomllib.loads(Path(__file__).with_name("nouns.toml").read_text(encoding="utf-8"))["qualities"].split()
)
_ROLES = frozenset({"object", "asset", "place", "area"})
_TARGETS = frozenset({"photograph", "inspect", "scan_thermal", "record_video", "measure", "read"})
_OF_ONE = DETERMINERS - {"these", "those", "some"} | {"any", "every", "each"}
_WITHIN = frozenset({"of", "on", "in", "at", "by", "to", "with", "from", "and", "under", "behind", "near", "for", "'s"})
"""A name with one of these has no noun at its end that could be several."""
_ALONE = frozenset({"guide", "follow", "handover", "give"})
"""Skills that one does not do with several, or not in turn."""
_LETTERS = "abcdefgh"


class _List(Struct, frozen=True):
    """What stands in place of the one thing, and the pieces each of the several is named with, by their first word."""

    words: Sequence[str]
    names: Sequence[Sequence[str]]


def listed(example: Example, rng: random.Random) -> Example:
    """Return an order about one thing as one about two to four of its kind; any other as it is."""
    if example.symbols[0] == "none" or len(example.words) > example.own or "|" in example.symbols:
        return example
    ((body, _),) = subtasks_of(example)
    found = [
        span
        for span in spans(example)
        if span.alone and (span.role in _ROLES or (span.role == "target" and body[0] in _TARGETS))
    ]
    if len(found) != 1 or {"robots:", "all"} & set(body) or body[0] in _ALONE:
        return example
    span = found[0]
    words = example.words[span.first : span.last + 1]
    if words[-1].isdigit() or len(words[-1]) == 1:
        words = words[:-1]
    noun = words[-1] if words else ""
    plural = _plural(noun)
    if len(noun) < 3 or not noun.isalpha() or noun.endswith("s") or singular(plural) != noun:
        return example
    if _WITHIN & set(words) or example.words.count(noun) > 1 or {"it", "its"} & set(example.words):
        return example
    first = span.first - (span.first > 0 and example.words[span.first - 1] in _OF_ONE)
    kinds = [*words[:-1], plural]
    made = _by_marks(kinds, rng) if rng.random() < 0.6 else _by_looks(words, kinds, rng)
    grown = len(made.words) - (span.last + 1 - first)

    def moved(symbol: str) -> str:
        if symbol[0] != "w" or not symbol[1:].isdigit():
            return symbol
        number = int(symbol[1:])
        return f"w{number + grown if number > span.last else number}"

    at = span.at - 1  # in the body, which begins behind the domain
    symbols: list[str] = []
    for number, name in enumerate(made.names):
        named = [f"w{first + int(each[1:])}" if each[0] == "w" and each[1:].isdigit() else each for each in name]
        before = ["<", str(number)] if number else []
        symbols += ["|", *map(moved, body[:at]), *named, *map(moved, body[at + 2 :]), *before]
    text = (*example.words[:first], *made.words, *example.words[span.last + 1 :])
    return Example(text, len(text), (example.symbols[0], *symbols[1:]))


def _plural(noun: str) -> str:
    if noun.endswith(("ch", "sh", "x", "z")):
        return f"{noun}es"
    return f"{noun[:-1]}ies" if noun.endswith("y") and noun[-2:-1] not in "aeiou" else f"{noun}s"


def _by_marks(kinds: Sequence[str], rng: random.Random) -> _List:
    """Return things with numbers or letters: some of them, or from one to another."""
    count = rng.randrange(2, 5)
    low = rng.randrange(1, 30)
    lettered = rng.random() < 0.2
    if count > 2 and not lettered and rng.random() < 0.6:
        link = rng.choice(_PHRASES["ranges"]).split()
        words = [*kinds, str(low), *link, str(low + count - 1)]
        marks = [f"w{len(kinds)}", *(f'"{low + each}"' for each in range(1, count - 1)), f"w{len(words) - 1}"]
    else:
        chosen = rng.sample(_LETTERS, count) if lettered else [str(low + each) for each in rng.sample(range(9), count)]
        words = list(kinds)
        marks: list[str] = []
        for number, mark in enumerate(sorted(chosen, key=lambda each: (len(each), each))):
            words += _separator(number, count, rng) if number else []
            marks.append(f"w{len(words)}")
            words.append(mark)
    kind = ["w0", f"w{len(kinds) - 1}", "~"]
    return _List(words, [[*kind, "+", *([mark] if mark[0] == '"' else [mark, mark])] for mark in marks])


def _by_looks(words: Sequence[str], kinds: Sequence[str], rng: random.Random) -> _List:
    """Return things that differ by a word: behind the plural, or before the one noun."""
    count = rng.randrange(2, 4)
    looks = rng.sample(_QUALITIES, count)
    behind = rng.random() < 0.6
    text = [*rng.choice(_PHRASES["several"]).split(), *kinds, *rng.choice(_PHRASES["namely"]).split()] if behind else []
    one = behind and rng.random() < 0.6
    kind_at = len(text)
    places: list[int] = []
    for number, look in enumerate(looks):
        text += _separator(number, count, rng) if number else []
        text += ["the"] if one or rng.random() < 0.7 else []
        places.append(len(text))
        text += [look, *(["one"] if one else [])]
    if behind:
        start = next(at for at in range(kind_at) if text[at : at + len(kinds)] == list(kinds))
        kind = [f"w{start}", f"w{start + len(kinds) - 1}", "~"]
        return _List(text, [[f"w{at}", f"w{at}", "+", *kind] for at in places])
    first, last = len(text), len(text) + len(words) - 1
    names = [[f"w{at}", f"w{at}", "+", f"w{first}", f"w{last}"] for at in places[:-1]]
    return _List([*text, *words], [*names, [f"w{places[-1]}", f"w{last}"]])


def _separator(number: int, count: int, rng: random.Random) -> list[str]:
    """Return what stands before an item that is not the first."""
    last = number == count - 1
    return rng.choice((["and"], [",", "and"], ["and"], ["and", "also"])) if last else [","]
