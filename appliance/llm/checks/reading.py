"""An instruction as checks read it: normalised tokens, mentions of robots, quotations, sentences. Pure.

It is independent of every planner, so that a planner's misreading is not repeated by the check of its plan. Text is
folded to NFKC, invisible characters are removed and counted, and words that mix scripts are kept as suspect: what a
person cannot see must not change what is planned.
"""

import re
import unicodedata
from collections.abc import Iterable, Sequence
from functools import lru_cache

from msgspec import Struct, field

from appliance.llm.words import singular
from appliance.model import RobotInfo

MAX_TOKENS = 4000
"""Longer texts are cut: `preprocessing` refuses them before."""
_ONES = [
    "zero",
    "one",
    "two",
    "three",
    "four",
    "five",
    "six",
    "seven",
    "eight",
    "nine",
    "ten",
    "eleven",
    "twelve",
    "thirteen",
    "fourteen",
    "fifteen",
    "sixteen",
    "seventeen",
    "eighteen",
    "nineteen",
]
_TENS = {
    word: 10 * tens
    for tens, word in enumerate(["twenty", "thirty", "forty", "fifty", "sixty", "seventy", "eighty", "ninety"], start=2)
}
NUMBERS = {word: number for number, word in enumerate(_ONES)} | _TENS
"""Number words, to ninety."""
KINDS = frozenset(
    [
        "robot",
        "drone",
        "rover",
        "uav",
        "ugv",
        "auv",
        "bot",
        "cart",
        "arm",
        "unit",
        "vehicle",
        "machine",
        "copter",
        "quadcopter",
        "quad",
        "amr",
        "agv",
        "tug",
        "loader",
        "truck",
        "forklift",
        "crawler",
    ]
)
"""Nouns for robots."""
_GENERAL = frozenset(("robot", "bot", "unit", "vehicle", "machine"))
_FLYING = frozenset(("drone", "uav", "copter", "quadcopter", "quad"))
_STARTS = frozenset((".", ";", "!", "?", "\n", ",", "and", "then", "please", "have", "let", "get", "while"))
"""What may stand before a robot that is called by its kind alone: "drone: land"."""
_GROUP = frozenset(("all", "both", "every", "each"))
_EVERYBODY = frozenset(("everyone", "everybody"))
_SOMEBODY = frozenset(("somebody", "someone", "anyone", "anybody"))
_ONE_OF = frozenset(("a", "an", "any", "one", "some", "another", "whichever", "either"))
_BETWEEN = frozenset(("of", "the", "our", "my", "your", "available", "free", "idle", "nearest", "closest", "other"))
_TOKEN = re.compile(
    r"(?P<quote>\"[^\"\n]{0,400}\"|“[^”\n]{0,400}”|«[^»\n]{0,400}»|„[^“”\n]{0,400}[“”]"
    r"|(?<!\w)['‘][^'’\n]{0,400}['’](?!\w))"
    r"|(?P<number>(?<![\w.)])[-−]\d+(?:[.,]\d+)*|\d+(?:[.,]\d+)*)"
    r"|(?P<word>[^\W\d_]+(?:['’][^\W\d_]+)*)"
    r"|(?P<mark>[^\w\s]|_|\n)"
)
_STRONG = frozenset(".;!?\n")
"""Marks that end a sentence."""


class Token(Struct, frozen=True):
    """A token of an instruction: `text` in lower case as it is compared, `start` and `end` in the normalised text."""

    text: str
    kind: str
    """word, number, quote, mark or robot."""
    start: int
    end: int
    value: float | None = None
    """Of a number or a number word."""
    robots: tuple[str, ...] = ()
    """Of a mention of robots: which of the roster it can mean."""
    group: str = ""
    """Of a mention: `one` (by name), `all` (all of `robots`), `any` (one of them)."""


class Reading(Struct, frozen=True, kw_only=True):
    """An instruction, read."""

    text: str
    """Normalised."""
    tokens: tuple[Token, ...]
    sentence: tuple[int, ...]
    """Of each token, the number of its sentence."""
    hidden: int = 0
    """Invisible characters that were removed."""
    mixed: tuple[str, ...] = ()
    """Words that mix letters of several scripts."""
    memo: dict[tuple[str, str, str], frozenset[int] | None] = field(default_factory=dict)
    """What was found in it before, by kind, value and unit: plans for one instruction say much the same."""

    @property
    def named(self) -> frozenset[str]:
        """Robots that the words name or imply."""
        return frozenset(robot for each in self.tokens if each.group in ("one", "all") for robot in each.robots)


@lru_cache(maxsize=64)
def normalise(text: str) -> tuple[str, int]:
    """Return a text in NFKC, with typographic apostrophes made plain and invisible characters removed, and how many."""
    folded = unicodedata.normalize("NFKC", text.replace("\r\n", "\n").replace("\r", "\n"))
    kept: list[str] = []
    hidden = 0
    for each in folded:
        category = unicodedata.category(each)
        if category == "Cf" or (category == "Cc" and each not in "\n\t"):
            hidden += 1
        elif category in ("Zl", "Zp"):
            kept.append("\n")
        else:
            kept.append(" " if category == "Zs" else each)
    return "".join(kept).replace("’", "'").replace("ʼ", "'").replace("`", "'"), hidden


def stem(word: str) -> str:
    """Return a word without an ending of the plural or a possessive, to compare it."""
    word = word.removesuffix("'s").removesuffix("'")
    return singular(word) if len(word) > 3 else word


def read(instruction: str, robots: Sequence[RobotInfo] | None, names: Iterable[str] = ()) -> Reading:
    """Read an instruction; the reading is kept for the next plan of the same words and robots.

    Args:
        instruction: as it was typed.
        robots: the roster; None when it is unknown.
        names: robots that a plan names, which count as names where the roster is unknown.
    """
    roster = None if robots is None else tuple((each.id, each.flies) for each in robots)
    return _read(instruction, roster, tuple(sorted(set(names))) if robots is None else ())


@lru_cache(maxsize=32)
def _read(instruction: str, robots: "tuple[_Robot, ...] | None", names: tuple[str, ...]) -> Reading:
    text, hidden = normalise(instruction)
    plain = [_token(match) for match in _TOKEN.finditer(text)][:MAX_TOKENS]
    known = [robot for robot, _ in robots] if robots is not None else names
    tokens = _groups(_named(plain, known), robots)
    sentence: list[int] = []
    number = 0
    for index, each in enumerate(tokens):
        sentence.append(number)
        if each.kind == "mark" and each.text in _STRONG and not _abbreviated(tokens, index):
            number += 1
    mixed = tuple(each.text for each in tokens if each.kind == "word" and _scripts(each.text) > 1)
    return Reading(text=text, tokens=tuple(tokens), sentence=tuple(sentence), hidden=hidden, mixed=mixed)


def _token(match: re.Match[str]) -> Token:
    kind = match.lastgroup or "mark"
    text = match.group().casefold()
    value: float | None = None
    if kind == "number":
        try:
            value = float(text.replace("−", "-").replace(",", ""))
        except ValueError:
            value = None
    elif kind == "word":
        value = NUMBERS.get(text)
    return Token(text, kind, match.start(), match.end(), value)


def _abbreviated(tokens: Sequence[Token], index: int) -> bool:
    """Whether a full stop stands behind a title or an abbreviation and ends no sentence."""
    before = tokens[index - 1] if index else None
    return (
        tokens[index].text == "."
        and before is not None
        and before.text in ("mr", "mrs", "ms", "dr", "st", "no", "approx", "min", "sec")
        and index + 1 < len(tokens)
    )


def _scripts(word: str) -> int:
    return len({unicodedata.name(each, "?").split()[0] for each in word if each.isalpha()})


def _parts(robot: str) -> tuple[str, ...]:
    """The parts of a robot's id as tokens are: letters and digits apart."""
    return tuple(re.findall(r"[^\W\d_]+|\d+", robot.casefold()))


def _named(tokens: list[Token], known: Sequence[str]) -> list[Token]:
    """Join the tokens that name a robot: `rover_1`, "rover 1", "Rover one", "rover-1's"."""
    parts = sorted(((_parts(each), each) for each in known), key=lambda pair: -len(pair[0]))
    by_first: dict[str, list[tuple[tuple[str, ...], str]]] = {}
    for each, robot in parts:
        if each:
            by_first.setdefault(each[0], []).append((each, robot))
    found: list[Token] = []
    at = 0
    while at < len(tokens):
        token = tokens[at]
        head = token.text.removesuffix("'s")
        end = 0
        named: list[str] = []
        if token.kind == "word":
            for each, robot in by_first.get(head, ()):
                stop = _matches(tokens, at, each)
                if stop and stop >= end:
                    named = [*named, robot] if stop == end else [robot]
                    end = stop
        if named:
            found.append(Token(named[0], "robot", token.start, tokens[end - 1].end, robots=tuple(named), group="one"))
            at = end
        else:
            found.append(token)
            at += 1
    return found


def _matches(tokens: Sequence[Token], at: int, parts: Sequence[str]) -> int:
    """The index behind the tokens that say these parts from `at` on; 0 when they do not."""
    index = at
    for number, part in enumerate(parts):
        while number and index < len(tokens) and tokens[index].text in ("_", "-", "."):
            index += 1
        if index >= len(tokens):
            return 0
        said = tokens[index]
        plain = said.text.removesuffix("'s")
        if plain != part and not (part.isdigit() and said.value == float(part)):
            return 0
        index += 1
    if index + 1 < len(tokens) and tokens[index].text in ("_", ".") and tokens[index + 1].kind == "number":
        return 0  # rover_1.5 is no rover_1
    return index


_Robot = tuple[str, bool]
"""Id, and whether it flies."""


def _kind_of(robot: str) -> str:
    """The noun in a robot's id: `drone` of drone_3; empty when there is none."""
    return next((part for part in _parts(robot) if part in KINDS), "")


def _of_kind(kind: str, robots: Sequence[_Robot]) -> tuple[str, ...]:
    if kind in _GENERAL:
        return tuple(name for name, _ in robots)
    if kind in _FLYING:
        return tuple(name for name, flies in robots if flies or _kind_of(name) == kind)
    return tuple(name for name, _ in robots if _kind_of(name) == kind)


def _groups(tokens: list[Token], robots: Sequence[_Robot] | None) -> list[Token]:
    """Join the tokens that mean robots without a name: "all drones", "both of them", "the rover", "a robot"."""
    found: list[Token] = []
    at = 0
    while at < len(tokens):
        stop, made = _group(tokens, at, robots, found)
        if made is not None:
            found.append(made)
            at = stop
        else:
            found.append(tokens[at])
            at += 1
    return found


def _group(
    tokens: Sequence[Token], at: int, robots: Sequence[_Robot] | None, before: Sequence[Token]
) -> tuple[int, Token | None]:
    token = tokens[at]
    if token.kind != "word":
        return at, None
    roster = tuple(robots or ())
    everyone = tuple(name for name, _ in roster)

    def made(stop: int, which: tuple[str, ...], group: str) -> tuple[int, Token]:
        text = " ".join(each.text for each in tokens[at:stop])
        return stop, Token(text, "robot", token.start, tokens[stop - 1].end, robots=which, group=group)

    if token.text in _EVERYBODY | _SOMEBODY:
        return made(at + 1, everyone, "all" if token.text in _EVERYBODY else "any")
    index = at
    lead = ""
    count: float | None = None
    other = False
    while index < len(tokens) and tokens[index].kind in ("word", "number") and index - at < 6:
        word = tokens[index].text
        if other and word == "one":
            break
        if word in _GROUP or (word in _ONE_OF and not lead):
            lead = lead or word
        elif tokens[index].value is not None and index > at - 1 and word not in KINDS:
            count = tokens[index].value if count is None else min(count, tokens[index].value or count)
        elif word in _BETWEEN:
            other = other or word == "other"
            lead = lead or ("the" if word == "the" else "")
        else:
            break
        index += 1
    noun = tokens[index].text if index < len(tokens) and tokens[index].kind == "word" else ""
    kind = "robot" if other and noun == "one" else noun if noun in KINDS else stem(noun)
    if noun in ("them", "us", "you") and lead in _GROUP and index > at:
        earlier = tuple(dict.fromkeys(r for each in before if each.group == "one" for r in each.robots))
        return made(index + 1, earlier or everyone, "all")
    if kind in KINDS and noun != kind and (found := _listed(tokens, index + 1, kind, roster)):
        stop, which = found
        return made(stop, which, "all")
    numbered = index + 1 < len(tokens) and (tokens[index + 1].value is not None or tokens[index + 1].text in ("_", "-"))
    if kind in KINDS and not numbered:
        which = _of_kind(kind, roster)
        if other:
            named = {robot for each in before if each.group == "one" for robot in each.robots}
            which = tuple(each for each in which if each not in named)
        group = _meant(lead, count, plural=noun != kind, number=len(which))
        if not group and not lead and len(which) == 1 and (not before or before[-1].text in _STARTS):
            group = "one"
        if group:
            return made(index + 1, which, group)
    if lead == "both" and index == at + 1 and len(everyone) == 2 and noun not in KINDS:
        return made(at + 1, everyone, "all")
    return at, None


def _listed(
    tokens: Sequence[Token], at: int, kind: str, roster: Sequence[_Robot]
) -> tuple[int, tuple[str, ...]] | None:
    """The robots of "rovers 1, 2 and 3", and the index behind them; None when there are fewer than two numbers."""
    numbers: list[float] = []
    index = stop = at
    while index < len(tokens):
        value = tokens[index].value
        if value is not None and (not numbers or index > stop):
            numbers.append(value)
            stop = index + 1
        elif not numbers or tokens[index].text not in (",", "and", "&", "plus"):
            break
        index += 1
    names = {f"{kind}_{number:g}" for number in numbers} | {f"{kind}{number:g}" for number in numbers}
    which = tuple(name for name, _ in roster if name in names)
    return (stop, which) if len(numbers) > 1 and len(which) == len(numbers) else None


def _meant(lead: str, count: float | None, *, plural: bool, number: int) -> str:
    """Whether a noun for robots means `all` of its kind, `one` that is clear, or `any`; empty when it means none."""
    if lead in _GROUP:
        return "all"
    if plural:
        return "all" if count == number or (count is None and lead in ("the", "")) else "any"
    if lead == "the":
        return "one" if number == 1 else "any"
    return "any" if lead in _ONE_OF or count == 1 else ""
