"""Makes an order to whomever one to several robots: by their names or numbers, to those of a roster or all but some.

Each of them does all of it, at its own pace: the plan has the first step of every one, then the second of every one, as
people's plans for crews have.
"""

import random
import re
import tomllib
from collections.abc import Sequence
from pathlib import Path

from msgspec import Struct

from workshop.train.examples import ROBOT, Example
from workshop.train.lexicon import Lexicon
from workshop.train.linking import MAX_SUBTASKS, subtasks_of, unended

_PHRASES: dict[str, list[str]] = tomllib.loads(Path(__file__).with_name("phrases.toml").read_text(encoding="utf-8"))
_WORD = re.compile(r"[\w.-]+")
_COUNTS = {2: "two", 3: "three", 4: "four"}
_ANY_KIND = ("robot", "unit", "bot", "machine")
_KINDS = (
    *("drone", "rover", "arm", "cart", "scout", "truck", "crawler", "mower", "sweeper", "tractor", "boat", "crane"),
    *("loader", "shuttle", "trolley", "uav", "porter", "walker", "digger", "forklift"),
)
_WHOEVER = frozenset(
    {"somebody", "someone", "anyone", "anybody", "whoever", "whichever", "everyone", "everybody", "another", "other"}
    | {"either", "each", "nearest", "closest", "free", "idle", "one", "both", "all", "yourself"}
    | {each + end for each in (*_KINDS, *_ANY_KIND) for end in ("", "s")}
)


class _Crew(Struct, frozen=True):
    """A roster, who of it is meant, and what they are called."""

    roster: Sequence[str]
    meant: Sequence[str]
    called: str


def crewed(example: Example, lexicon: Lexicon, rng: random.Random) -> Example:
    """Return an order to whomever as one to several robots of a roster; any other as it is."""
    if not _is_for_whomever(example):
        return example
    crew = _of_kinds(rng) if rng.random() < 0.6 else _by_name(lexicon, rng)
    words, shift, _ = _called(example, crew.called.split(), rng)
    places = [len(words) + number for number, robot in enumerate(crew.roster) if robot in crew.meant]
    symbols = _of_each(example, [[f"w{place}", f"w{place}"] for place in places], shift)
    return Example((*words, *crew.roster), len(words), symbols) if symbols else example


def named(example: Example, lexicon: Lexicon, rng: random.Random) -> Example:
    """Return an order to whomever as one to two to four robots by their names or numbers; any other as it is."""
    if not _is_for_whomever(example):
        return example
    called, names = _in_a_row(rng) if rng.random() < 0.4 else _one_by_one(lexicon, rng)
    words, shift, at = _called(example, called, rng)
    pieces = [[f"w{at + each}" if isinstance(each, int) else each for each in name] for name in names]
    symbols = _of_each(example, pieces, shift)
    return Example(tuple(words), len(words), symbols) if symbols else example


def _is_for_whomever(example: Example) -> bool:
    if example.symbols[0] == "none" or len(example.words) > example.own or _WHOEVER & set(example.words):
        return False
    return all(body[1:2] == ["any"] and body[0] != "handover" for body, _ in subtasks_of(example))


def _called(example: Example, crew: Sequence[str], rng: random.Random) -> tuple[list[str], int, int]:
    """Return an order's words with those it is for, how far its own are moved, and where those of the crew begin."""
    behind = rng.random() < 0.2
    said = rng.choice(_PHRASES["crew_behind" if behind else "crew_calls"]).split()
    first = said.index("CREW")
    words = [*said[:first], *crew, *said[first + 1 :]]
    if behind:
        own = unended(example)
        return [*own, *words], 0, len(own) + first
    return [*words, *example.words], len(words), first


def _of_each(example: Example, robots: Sequence[Sequence[str]], shift: int) -> tuple[str, ...]:
    """Return the symbols of an order that each of some robots has; none if that were too many subtasks."""
    parts, count = subtasks_of(example), len(robots)
    if not count or len(parts) * count > MAX_SUBTASKS:
        return ()
    symbols: list[str] = []
    for body, after in parts:
        rest = [f"w{int(each[1:]) + shift}" if re.fullmatch(r"w\d+", each) else each for each in body[2:]]
        for number, robot in enumerate(robots, 1):
            earlier = [str((each - 1) * count + number) for each in after]
            symbols += ["|", body[0], *robot, *rest, *(["<", *earlier] if earlier else [])]
    return (example.symbols[0], *symbols[1:])


def _in_a_row(rng: random.Random) -> tuple[list[str], list[list[str | int]]]:
    """Return the words for robots of a kind by their numbers, and the pieces of each name: word numbers and symbols."""
    low, count = rng.randrange(1, 12), rng.randrange(2, 5)
    kinds = f"{rng.choice((*_KINDS, *_ANY_KIND))}s"
    if count > 2 and rng.random() < 0.5:
        words = [kinds, str(low), *rng.choice(_PHRASES["ranges"]).split(), str(low + count - 1)]
        between: list[list[str | int]] = [[0, 0, "~", "+", f'"{low + each}"'] for each in range(1, count - 1)]
        return words, [[0, 0, "~", "+", 1, 1], *between, [0, 0, "~", "+", len(words) - 1, len(words) - 1]]
    marks = sorted(rng.sample("abcdef", count) if rng.random() < 0.2 else rng.sample("123456789", count))
    words, places = [kinds], list[int]()
    for number, mark in enumerate(marks):
        words += ([","] if number < count - 1 else ["and"]) if number else []
        places.append(len(words))
        words.append(mark)
    return words, [[0, 0, "~", "+", place, place] for place in places]


def _one_by_one(lexicon: Lexicon, rng: random.Random) -> tuple[list[str], list[list[str | int]]]:
    """Return the words for robots by their names, and the pieces of each name."""
    names = list(dict.fromkeys(lexicon.noun(ROBOT, rng) for _ in range(rng.choice((2, 3, 3, 4)))))
    words: list[str] = []
    pieces: list[list[str | int]] = []
    last = rng.choice(("and", "and", "and", "&", ", and", "plus"))
    for number, name in enumerate(names):
        words += ([","] if number < len(names) - 1 else last.split()) if number else []
        pieces.append([len(words), len(words) + len(name) - 1])
        words += name
    return words, pieces


def _of_kinds(rng: random.Random) -> _Crew:
    """Return robots of one kind or two, numbered: one kind is meant, all of it or but some, or all but that kind."""
    plain = rng.random() < 0.2
    kind, other = (rng.choice(_ANY_KIND), "") if plain else rng.sample(_KINDS, 2)
    marks = [str(each) for each in range(1, 8)] if rng.random() < 0.7 else list("abcdefg")
    these = [f"{kind}_{mark}" for mark in sorted(rng.sample(marks, rng.randrange(2, 5)))]
    others = [] if plain else [f"{other}_{mark}" for mark in sorted(rng.sample(marks, rng.randrange(4)))]
    roster = [*these, *others] if rng.random() < 0.6 else [*others, *these]
    if rng.random() < 0.2:
        rng.shuffle(roster)
    roll = rng.random()
    if roll < 0.4 and len(these) > 2:
        out = sorted(rng.sample(these, 2 if len(these) > 3 and rng.random() < 0.4 else 1))
        numbers = [each.rpartition("_")[2] for each in out]
        said = rng.choice(([each.replace("_", " ") for each in out], [f"number {each}" for each in numbers], out))
        phrase = rng.choice(_PHRASES["kind_but"]).replace("OUT", " and ".join(said))
        meant = [each for each in these if each not in out]
    elif roll < 0.55 and others:
        phrase, meant = rng.choice(_PHRASES["but_kind"]), others
    else:
        phrase = rng.choice([*_PHRASES["kind"], *_PHRASES["kind_two" if len(these) == 2 else "kind_many"]])
        phrase, meant = phrase.replace("COUNT", _COUNTS[len(these)]), these
    return _Crew(roster, meant, phrase.replace("KIND", kind))


def _by_name(lexicon: Lexicon, rng: random.Random) -> _Crew:
    """Return robots with names: everybody is meant, or all but one or two."""
    drawn = [lexicon.noun(ROBOT, rng) for _ in range(rng.randrange(2, 6))]
    roster = list(dict.fromkeys(each[0] for each in drawn if len(each) == 1 and _WORD.fullmatch(each[0])))
    if len(roster) < 2:
        return _Crew(roster, (), "")
    if rng.random() < 0.35 or len(roster) == 2:
        return _Crew(
            roster, roster, rng.choice([*_PHRASES["crew"], *(_PHRASES["crew_two"] if len(roster) == 2 else ())])
        )
    out = rng.sample(roster, 2 if len(roster) > 3 and rng.random() < 0.4 else 1)
    said = " and ".join(each.replace("_", " ") if rng.random() < 0.5 else each for each in out)
    phrase = rng.choice(_PHRASES["crew_but"]).replace("OUT", said)
    return _Crew(roster, [each for each in roster if each not in out], phrase)
