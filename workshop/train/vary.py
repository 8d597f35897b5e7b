"""Makes an example another one whose plan is exact as well.

Each variation changes words only where the plan's meaning does not depend on them, or changes words and plan alike:
other names, other words for a verb, two instructions as one, other marks and fillers, misspelt words that name nothing,
figures as words, another roster. What cannot be varied safely (a group's "both drones", say) is left as it is.
"""

import random
import re
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path

from msgspec.structs import replace

from appliance.llm import values
from appliance.llm.language import ANY
from workshop.train.crews import crewed, named
from workshop.train.examples import ROBOT, Example, inserted, pointed, spans, substitute
from workshop.train.framing import done_by, framed, fronted, gapped, told
from workshop.train.lexicon import Lexicon
from workshop.train.linking import MAX_WORDS, abreast, joined, robots_of
from workshop.train.listing import listed
from workshop.train.renaming import renamed
from workshop.train.reword import reworded

_MARK = re.compile(r"[^\w\s]+")
_NUMBER_WORDS = (
    *("zero", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve"),
    *("thirteen", "fourteen", "fifteen", "sixteen", "seventeen", "eighteen", "nineteen", "twenty"),
)
_OF_NUMBERS = frozenset(
    {
        *_NUMBER_WORDS,
        "twenty",
        "thirty",
        "forty",
        "fifty",
        "sixty",
        "seventy",
        "eighty",
        "ninety",
        "hundred",
        "thousand",
    }
    | {"and", "-", "half", "quarter", "quarters", "oh", "niner", "dozen", "point"}
)
_PHRASES: dict[str, list[str]] = tomllib.loads(Path(__file__).with_name("phrases.toml").read_text(encoding="utf-8"))
_WHOEVER = frozenset(
    {"robot", "robots", "drone", "drones", "bot", "bots", "unit", "units", "machine", "machines", "arm", "arms"}
    | {"somebody", "someone", "anyone", "anybody", "whoever", "whichever", "everyone", "everybody", "another", "other"}
    | {"whoever's", "either", "each", "nearest", "closest", "free", "idle"}
)


def vary(example: Example, others: Sequence[Example], lexicon: Lexicon, rng: random.Random) -> Example:
    """Return a variation of an example.

    Args:
        example: the example.
        others: examples that may be joined to it.
        lexicon: nouns for other names.
        rng: of everything that is random.
    """
    made = listed(example, rng) if rng.random() < 0.2 else example
    made = gapped(made, lexicon, rng) if rng.random() < 0.1 else made
    made = _put_otherwise(made, lexicon, rng)
    made = named(made, lexicon, rng) if rng.random() < 0.1 else made
    made = addressed(made, lexicon, rng) if rng.random() < 0.4 else made
    for chance in (0.4, 0.15):
        if others and rng.random() < chance:
            other = _put_otherwise(rng.choice(others), lexicon, rng)
            other = addressed(other, lexicon, rng) if rng.random() < 0.6 else other
            if rng.random() < 0.4:
                other = abreast(other, addressed(rng.choice(others), lexicon, rng), rng) or other
            made = joined(made, other, rng) or made
    if rng.random() < 0.6:
        made = reworded(made, rng)
    if rng.random() < 0.8:
        made = renamed(made, lexicon, rng)
    if rng.random() < 0.15:
        made = crewed(made, lexicon, rng)
    for chance, change in _CHANGES:
        if rng.random() < chance:
            made = change(made, rng)
    return made if len(made.words) <= MAX_WORDS else example


def _put_otherwise(example: Example, lexicon: Lexicon, rng: random.Random) -> Example:
    """Return an example with its words in another frame, now and then."""
    roll = rng.random()
    return framed(example, lexicon, rng) if roll < 0.15 else fronted(example, rng) if roll < 0.3 else example


# --- called by name ------------------------------------------------------------------------------------------------


def addressed(example: Example, lexicon: Lexicon, rng: random.Random) -> Example:
    """Return an order to whomever as one to a robot that is called by its name first: all of it is that robot's."""
    if example.symbols[0] == "none" or len(example.words) > example.own or robots_of(example) != {"any"}:
        return example
    if _WHOEVER & set(example.words):
        return example  # it speaks of a robot that is none in particular
    name = lexicon.noun(ROBOT, rng)
    if rng.random() < 0.25:
        name = (rng.choice(_PHRASES["kinds"]), str(rng.randrange(1, 20)))
    if rng.random() < 0.4:
        return told(example, name, rng)
    return done_by(example, 0, rng.choice(_PHRASES["calls"]), name)


# --- marks, fillers, slips -----------------------------------------------------------------------------------------


def unmarked(example: Example, rng: random.Random) -> Example:
    """Return an example without marks between words, as a transcript has none; or without some of them."""
    kept = pointed(example)
    share = 1.0 if rng.random() < 0.5 else 0.5
    runs: list[tuple[int, int, Sequence[str]]] = [
        (number, number, ())
        for number, word in enumerate(example.words[: example.own])
        if number not in kept and _MARK.fullmatch(word) and rng.random() < share
    ]
    return substitute(example, runs) if len(runs) < example.own else example


def talkative(example: Example, rng: random.Random) -> Example:
    """Return an example with a word or two that say nothing, before, after or within."""
    if example.symbols[0] == "none":
        return example
    words = example.words
    made = example
    roll = rng.random()
    if roll < 0.45:
        opening = rng.choice(_PHRASES["openings"]).split()
        comma = [","] if rng.random() < 0.4 and opening[-1] not in ("to", "you") else []
        made = inserted(made, 0, [*opening, *comma])
    if roll > 0.35 and roll < 0.75:
        comma = [","] if rng.random() < 0.3 else []
        made = inserted(made, made.own, [*comma, *rng.choice(_PHRASES["endings"]).split()])
    if roll > 0.7:
        inside = {number for span in spans(made) for number in range(span.first + 1, span.last + 1)}
        free = [number for number in range(1, made.own) if number not in inside]
        if free and len(words) > 3:
            made = inserted(made, rng.choice(free), rng.choice(_PHRASES["between"]).split())
    return made


def misspelt(example: Example, rng: random.Random) -> Example:
    """Return an example with slips in words that name nothing."""
    kept = pointed(example)
    runs: list[tuple[int, int, Sequence[str]]] = []
    for number, word in enumerate(example.words[: example.own]):
        if number in kept or len(word) < 4 or not word.isalpha() or rng.random() > 0.12:
            continue
        at = rng.randrange(1, len(word) - 1)
        slips = (
            word[:at] + word[at + 1] + word[at] + word[at + 2 :],
            word[:at] + word[at + 1 :],
            word[:at] + word[at] + word[at:],
            word[:at] + rng.choice("abcdefghijklmnopqrstuvwxyz") + word[at + 1 :],
        )
        runs.append((number, number, rng.choices(slips, (7, 6, 4, 3))))
    return substitute(example, runs)


def numbered(example: Example, rng: random.Random) -> Example:
    """Return an example with figures of names and quantities as words, or words as figures."""
    free = {n for span in spans(example) if span.role in values.FREE for n in range(span.first, span.last + 1)}
    runs: list[tuple[int, int, Sequence[str]]] = []
    words = example.words
    for number in sorted(pointed(example) - free):
        if number >= example.own or rng.random() < 0.3:
            continue
        word = words[number]
        beside = {words[number - 1] if number else "", words[number + 1] if number + 1 < example.own else ""}
        if any(each in _OF_NUMBERS or each.isdigit() for each in beside):
            continue  # part of a longer number
        if word.isdigit() and int(word) <= 20 and not word.startswith("0"):
            runs.append((number, number, (_NUMBER_WORDS[int(word)],)))
        elif word in _NUMBER_WORDS and word != "one":
            runs.append((number, number, (str(_NUMBER_WORDS.index(word)),)))
    return substitute(example, runs)


def articles(example: Example, rng: random.Random) -> Example:
    """Return an example with some articles left out, as in telegrams and by people whose language has none."""
    kept = pointed(example)
    runs: list[tuple[int, int, Sequence[str]]] = [
        (number, number, () if rng.random() < 0.7 else (rng.choice(("the", "that", "this", "a")),))
        for number, word in enumerate(example.words[: example.own])
        if number not in kept and word in ("the", "a", "an") and rng.random() < 0.7
    ]
    return substitute(example, runs)


def rostered(example: Example, rng: random.Random) -> Example:
    """Return an example with a roster that has its robots and others, or without one."""
    robots = robots_of(example)
    if any(span.first >= example.own for span in spans(example)) or "all" in robots:
        return example
    if len(example.words) > example.own:
        return replace(example, words=example.words[: example.own])
    if any(each.endswith("+") for each in robots):
        return example
    named = [each for each in robots if not ANY.fullmatch(each)]
    others = [
        f"{rng.choice(('robot', 'unit', 'scout', 'bot', 'kit', 'arm'))}_{rng.randrange(1, 30)}"
        for _ in range(rng.randrange(4))
    ]
    roster = [*named, *(each for each in dict.fromkeys(others) if each not in named)]
    rng.shuffle(roster)
    return (
        replace(example, words=(*example.words, *roster))
        if all(re.fullmatch(r"[\w.-]+", each) for each in roster)
        else example
    )


_CHANGES: tuple[tuple[float, Callable[[Example, random.Random], Example]], ...] = (
    (0.35, numbered),
    (0.25, unmarked),
    (0.3, talkative),
    (0.25, misspelt),
    (0.15, articles),
    (0.2, rostered),
)
