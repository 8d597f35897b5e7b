"""Makes two examples one: in order, side by side, waiting for one robot of several, or with what comes first said last.

Which of the first's subtasks those of the second wait for follows from the words between them alone, so the plan of the
whole is exact (`phrases.toml`).
"""

import random
import re
import tomllib
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path

from msgspec import Struct

from appliance.llm import values
from appliance.llm.language import ANY
from workshop.train.examples import ROBOT, Example, pointed, spans

MAX_WORDS = 160
MAX_SUBTASKS = 14
_MARK = re.compile(r"[^\w\s]+")
_PHRASES: dict[str, list[str]] = tomllib.loads(Path(__file__).with_name("phrases.toml").read_text(encoding="utf-8"))
_LEADS = frozenset(
    {"then", "after", "afterwards", "next", "finally", "and", "once", "when", "meanwhile"}
    | {"while", "or", "but", "also", "later", "before", "first", "if"}
)


class _Link(Struct, frozen=True):
    """What stands between two examples and after the second, and what the second waits for."""

    between: str
    after: str = ""
    awaited: Collection[int] = ()
    """Subtasks of the first, by number."""
    late: bool = False
    """The first waits for all of the second instead."""


def joined(one: Example, two: Example, rng: random.Random) -> Example | None:
    """Return two instructions as one; None where it would not be clear who waits for what."""
    if "none" in (one.symbols[0], two.symbols[0]) or len(one.words) > one.own or len(two.words) > two.own:
        return None
    if two.words[0] in _LEADS or len(one.words) + len(two.words) > MAX_WORDS:
        return None
    firsts, seconds = robots_of(one), robots_of(two)
    if "all" in firsts | seconds or _count(one) + _count(two) > MAX_SUBTASKS:
        return None
    anys = {each for each in firsts | seconds if ANY.fullmatch(each)}
    second = list(two.symbols)
    if not anys and not firsts & seconds and firsts and seconds:
        return _linked(one, two, second, _between_others(one, two, rng))
    if anys == {"any"} and firsts in ({"any"}, set()) and seconds in ({"any"}, set()):
        return _linked(one, two, second, _in_order(one, rng))
    if len(firsts) == 1 and not anys & firsts and seconds == {"any"} and "robots:" not in one.symbols:
        # A robot named once: what follows without a name is its own.
        robot = next(span for span in spans(one) if span.role == ROBOT)
        if not robot.alone:
            return None
        second = _with_robot(second, (f"w{robot.first}", f"w{robot.last}"))
        return _linked(one, two, second, _in_order(one, rng))
    return None


def abreast(one: Example, two: Example, rng: random.Random) -> Example | None:
    """Return two clauses as one sentence, for different robots side by side: what waits for one waits for both."""
    if not is_a_clause(one) or not is_a_clause(two) or "none" in (one.symbols[0], two.symbols[0]):
        return None
    firsts, seconds = robots_of(one), robots_of(two)
    if any(ANY.fullmatch(each) for each in firsts | seconds) or firsts & seconds or not firsts or not seconds:
        return None
    if len(one.words) > one.own or len(two.words) > two.own or _count(one) + _count(two) > MAX_SUBTASKS:
        return None
    return _linked(one, two, two.symbols, _Link(between=rng.choice(_PHRASES["abreast"])))


def then_linked(one: Example, two: Example, between: str) -> Example:
    """Return two orders as one, the second of which waits for all of the first."""
    return _linked(one, two, two.symbols, _Link(between=between, awaited=_lasts(one.symbols)))


def _between_others(one: Example, two: Example, rng: random.Random) -> _Link:
    """Return a link between orders to different robots."""
    roll = rng.random()
    if roll < 0.35 and (link := _waiting(one, two, rng)):
        return link
    if roll < 0.6:
        return _in_order(one, rng)
    return _Link(between=rng.choice(_PHRASES["meanwhile"] if roll < 0.8 else _PHRASES["beside"]))


def _in_order(one: Example, rng: random.Random) -> _Link:
    """Return a link by which one of two is over before the other begins."""
    if rng.random() < 0.15:
        return _Link(between=rng.choice(_PHRASES["beforehand" if is_a_clause(one) else "before_all"]), late=True)
    lasts = _lasts(one.symbols)
    several = len(lasts) > 1 and len(robots_of(one)) > 1
    return _Link(between=rng.choice(_PHRASES["joining" if several else "then"]), awaited=lasts)


def _waiting(one: Example, two: Example, rng: random.Random) -> _Link | None:
    """Return a link by which the second waits for robots of the first by name: one of them, or two."""
    doers = list(_doers(one))
    if not doers or not all(each.name for each in doers):
        return None
    before = _ancestors(one.symbols)
    awaited = rng.sample(doers, 2) if len(doers) > 1 and rng.random() < 0.25 else [rng.choice(doers)]
    numbers = {number for each in awaited for number in each.subtasks}
    numbers -= {early for number in numbers for early in before[number]}
    stands_for = zip(["NAME", "OTHER"], (" ".join(each.name) for each in awaited), strict=False)
    names: dict[str, str] = dict(stands_for)

    def choose(of: str) -> str:
        words = rng.choice(_PHRASES[of if len(awaited) == 1 else f"{of}_two"]).split()
        return " ".join(names.get(each, each) for each in words)

    if is_a_clause(two) and rng.random() < 0.45:
        return _Link(between=rng.choice(_PHRASES["beside"]), after=choose("until"), awaited=sorted(numbers))
    return _Link(between=choose("awaiting"), awaited=sorted(numbers))


def is_a_clause(example: Example) -> bool:
    """Whether what is said of it, or after it, can only be meant of the whole."""
    own = list(example.words[: example.own])
    while own and _MARK.fullmatch(own[-1]):
        own.pop()
    return not any(each in _LEADS or _MARK.fullmatch(each) for each in own)


class _Doer(Struct, frozen=True):
    """A robot: the words that name it, with their article (none if it cannot be named again), and its subtasks."""

    name: tuple[str, ...]
    subtasks: tuple[int, ...]


def _doers(example: Example) -> Iterator[_Doer]:
    names: dict[str, tuple[str, ...]] = {}
    subtasks: dict[str, dict[int, None]] = {}
    for span in spans(example):
        if span.role != ROBOT:
            continue
        words = example.words[span.first : span.last + 1]
        robot = values.robot(" ".join(words))
        article = example.words[span.first - 1 : span.first] if span.first else ()
        said = ("the", *words) if article == ("the",) else words
        names.setdefault(robot, said if span.alone else ())
        subtasks.setdefault(robot, {})[1 + example.symbols[: span.at].count("|")] = None
    for robot, name in names.items():
        yield _Doer(name, tuple(subtasks[robot]))


def _linked(one: Example, two: Example, second: Sequence[str], link: _Link) -> Example:
    first_words, second_words = unended(one), list(two.words)
    if link.after:
        second_words = [*unended(two), *link.after.split()]
    words = (*first_words, *link.between.split(), *second_words)
    shift = len(first_words) + len(link.between.split())
    firsts = _subtasks(one.symbols[1:])
    seconds = [[_shifted(each, shift) for each in part] for part in _subtasks(second[1:])]
    if link.late:
        parts = [*seconds, *_behind(firsts, len(seconds), _lasts(two.symbols))]
    else:
        parts = [*firsts, *_behind(seconds, len(firsts), link.awaited)]
    domain = second[0] if len(seconds) >= len(firsts) else one.symbols[0]
    symbols = [each for part in parts for each in ("|", *part)]
    return Example(words, len(words), (domain, *symbols[1:]))


def unended(example: Example) -> list[str]:
    """Return the words of an example without a roster, without the marks at the end."""
    words, kept = list(example.words), pointed(example)
    while words and _MARK.fullmatch(words[-1]) and len(words) - 1 not in kept:
        words.pop()
    return words


def _behind(parts: Sequence[Sequence[str]], count: int, awaited: Collection[int]) -> Iterator[list[str]]:
    """Yield subtasks with numbers that go on from `count`; those that waited for nothing wait for `awaited`."""
    for part in parts:
        body, after = _cut(part)
        before = [str(each + count) for each in after] or [str(each) for each in awaited]
        yield [*body, *(["<", *before] if before else [])]


def _cut(part: Sequence[str]) -> tuple[list[str], list[int]]:
    at = part.index("<") if "<" in part else len(part)
    return list(part[:at]), [int(each) for each in part[at + 1 :]]


def _shifted(symbol: str, by: int) -> str:
    if symbol.startswith("="):
        return symbol[1:]
    return f"w{int(symbol[1:]) + by}" if re.fullmatch(r"w\d+", symbol) else symbol


def _with_robot(symbols: Sequence[str], pointer: Sequence[str]) -> list[str]:
    """Return symbols with `any` replaced by a pointer that is not to be moved (marked with =)."""
    made: list[str] = []
    for each in symbols:
        made += [f"={word}" for word in pointer] if each == "any" else [each]
    return made


def _subtasks(symbols: Sequence[str]) -> list[list[str]]:
    parts: list[list[str]] = [[]]
    for each in symbols:
        if each == "|":
            parts.append([])
        else:
            parts[-1].append(each)
    return parts


def _count(example: Example) -> int:
    return 1 + example.symbols.count("|")


def _lasts(symbols: Sequence[str]) -> list[int]:
    """Return the numbers of the subtasks after which none comes."""
    parts = _subtasks(symbols[1:])
    before = {each for part in parts for each in _cut(part)[1]}
    return [number for number in range(1, len(parts) + 1) if number not in before]


def _ancestors(symbols: Sequence[str]) -> dict[int, set[int]]:
    """Return which subtasks come before each, directly or not."""
    found: dict[int, set[int]] = {}
    for number, part in enumerate(_subtasks(symbols[1:]), 1):
        after = _cut(part)[1]
        found[number] = set(after).union(*(found[each] for each in after))
    return found


def subtasks_of(example: Example) -> list[tuple[list[str], list[int]]]:
    """Return the symbols of each subtask of a plan, with the numbers of those it comes after."""
    return [_cut(part) for part in _subtasks(example.symbols[1:])]


def robots_of(example: Example) -> set[str]:
    """Return the robots of a plan, as ids ("+" behind one of several runs of words); `any` and the like as they are."""
    found = {each for each in example.symbols if ANY.fullmatch(each)}
    for span in spans(example):
        if span.role == ROBOT:
            found.add(values.robot(" ".join(example.words[span.first : span.last + 1])) + ("" if span.alone else "+"))
    return found
