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
from appliance.model import RobotInfo, Site

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
_ONLY_ONE = frozenset(("a", "an", "one", "another", "either"))
_BETWEEN = frozenset(("of", "the", "our", "my", "your", "available", "free", "idle", "nearest", "closest", "other"))
_QUOTE = r"\"[^\"\n]{0,400}\"|“[^”\n]{0,400}”|«[^»\n]{0,400}»|„[^“”\n]{0,400}[“”]|(?<!\w)['‘][^'’\n]{0,400}['’](?!\w)"
_TOKEN = re.compile(
    rf"(?P<quote>{_QUOTE})"
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
    count: int = 0
    """Of a mention without names: how many robots the words say, "both" being two; 0 where they do not."""
    listed: bool = False
    """Of a mention: whether the words list its robots by number ("rovers 1 and 2")."""


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


_SHORT = tuple(
    (re.compile(short, re.IGNORECASE), long)
    for short, long in (
        (r"(?<=\s)[&+](?=\s)|(?<=\s)n(?=\s+[^\W\d_])", "and"),
        (r"(?<=\s)@(?=\s+[^\W\d_])", "at"),
        (r"(?<=[^\W\d_]\s)x ?(\d{1,2})(?=\s*(?:[,.;!?]|$|(?:and|then)\b))(?!\s*,?\s*(?:and )?y\b)", r"\1 times"),
        (r"(?<!\w)u(?!\w)", "you"),
        (r"(?<!\w)thats(?!\w)", "that's"),
        (r"\s*(?::-?\)|[🙂😀😃😄😊👍🙏👋])(?=\s|$)", ""),
    )
)
"""Signs and letters of chat, and what they are short for."""
_QUOTED = re.compile(_QUOTE)
_SHORT_PART = re.compile(r"(?<![^\W\d_])(?:[nux]|thats)(?![^\W\d_])|[^\w\s.\-]", re.IGNORECASE)
"""What a name must have for shorthand to be found in it."""


def spelled(text: str, known: Iterable[str] = ()) -> str:
    """Return a text without the shorthand of chat: "rover_1 & rover_2", "photo x3", "all of u".

    Args:
        text: as it was typed.
        known: names of robots, places and objects; they stay as they are ("bay x3", "unit n"), and so do quotations.
    """
    if not any(short.search(text) for short, _ in _SHORT):
        return text
    names = _kept(tuple(sorted({each for each in known if _SHORT_PART.search(each)})))
    for short, long in _SHORT:
        kept = [each.span() for pattern in (_QUOTED, names) if pattern for each in pattern.finditer(text)]

        def written_out(found: re.Match[str], long: str = long, kept: list[tuple[int, int]] = kept) -> str:
            inside = any(found.start() < end and start < found.end() for start, end in kept)
            return found.group() if inside else found.expand(long)

        text = short.sub(written_out, text)
    return text


@lru_cache(maxsize=256)
def _kept(names: tuple[str, ...]) -> re.Pattern[str] | None:
    """The pattern of names in a text: as they are written, or with other signs between their parts ("unit n 1")."""
    spellings: set[str] = set()
    for name in names:
        spellings.add(r"\s+".join(map(re.escape, name.split())))
        parts = _parts(name)
        if re.sub(r"[\s_.\-]", "", name).casefold() == "".join(parts):
            spellings.add(r"[\s_.\-]*".join(map(re.escape, parts)))
    longest_first = sorted(filter(None, spellings), key=lambda each: (-len(each), each))
    return re.compile(rf"(?<!\w)(?:{'|'.join(longest_first)})(?!\w)", re.IGNORECASE) if longest_first else None


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


def read(
    instruction: str, robots: Sequence[RobotInfo] | None, names: Iterable[str] = (), site: Site | None = None
) -> Reading:
    """Read an instruction; the reading is kept for the next plan of the same words and robots.

    Args:
        instruction: as it was typed.
        robots: the roster; None when it is unknown.
        names: robots that a plan names, which count as names where the roster is unknown.
        site: names of its places and objects are no shorthand.
    """
    roster = None if robots is None else tuple((each.id, each.flies) for each in robots)
    known = tuple(sorted(set(names))) if robots is None else ()
    return _read(spelled(instruction, (*known, *names_of(robots, site))), roster, known)


def names_of(robots: Iterable[RobotInfo] | None, site: Site | None) -> tuple[str, ...]:
    """Names of robots, and of what a site has."""
    return (*(each.id for each in robots or ()), *(site.names if site is not None else ()))


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


@lru_cache(maxsize=32_768)
def _parts(robot: str) -> tuple[str, ...]:
    """The parts of a robot's id as tokens are: letters and numbers apart."""
    return tuple(re.findall(r"[^\W\d_]+|\d+(?:[.,]\d+)*", robot.casefold()))


@lru_cache(maxsize=32_768)
def is_readable(robot: str) -> bool:
    """Whether a reading finds this id where it stands in a text by itself."""
    found = _named([_token(match) for match in _TOKEN.finditer(normalise(robot)[0])], (robot,))
    return len(found) == 1 and found[0].group == "one"


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


@lru_cache(maxsize=32_768)
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

    def made(
        stop: int, which: tuple[str, ...], group: str, *, count: float | None = None, listed: bool = False
    ) -> tuple[int, Token]:
        text = " ".join(each.text for each in tokens[at:stop])
        said = int(count) if count is not None and count == int(count) else 0
        return stop, Token(
            text, "robot", token.start, tokens[stop - 1].end, robots=which, group=group, count=said, listed=listed
        )

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
        return made(stop, which, "all", listed=True)
    numbered = index + 1 < len(tokens) and (tokens[index + 1].value is not None or tokens[index + 1].text in ("_", "-"))
    if kind in KINDS and not numbered:
        which = _of_kind(kind, roster)
        which = (_others(which, tokens) or _others(which, before)) if other else which
        count = 2.0 if lead == "both" and count is None else count
        which = _of_those(which, before, lead, count)
        plural = noun not in (kind, "one")  # "the other one" is one
        group = _meant(lead, count, plural=plural, number=len(which))
        if not group and not lead and len(which) == 1 and (not before or before[-1].text in _STARTS):
            group = "one"
        count = 1.0 if count is None and group == "any" and (not plural or lead in _ONLY_ONE) else count
        if group:
            return made(index + 1, which, group, count=count)
    if lead == "both" and index == at + 1 and len(everyone) == 2 and noun not in KINDS:
        return made(at + 1, everyone, "all")
    return at, None


def _others(which: tuple[str, ...], tokens: Sequence[Token]) -> tuple[str, ...]:
    """The robots that are not among those that tokens name."""
    named = {robot for each in tokens if each.group == "one" for robot in each.robots}
    return tuple(each for each in which if each not in named)


def _of_those(which: tuple[str, ...], before: Sequence[Token], lead: str, count: float | None) -> tuple[str, ...]:
    """The robots that "both drones" and "all three robots" mean: of more than so many, those that were named before."""
    if lead not in _GROUP or count is None or len(which) == count:
        return which
    named = {robot for each in before if each.group == "one" or each.listed for robot in each.robots}
    those = tuple(each for each in which if each in named)
    return those if len(those) == count else which


def _listed(
    tokens: Sequence[Token], at: int, kind: str, roster: Sequence[_Robot]
) -> tuple[int, tuple[str, ...]] | None:
    """The robots of "rovers 1, 2 and 4 to 6", and the index behind them; None when there are fewer than two numbers."""
    numbers: list[float] = []
    index = stop = at
    ranged = False
    while index < len(tokens):
        value = tokens[index].value
        if value is not None and (not numbers or index > stop):
            low = numbers[-1] if numbers else value
            if ranged and not _range(tokens, index, low, value):
                break
            numbers += [float(each) for each in range(int(low) + 1, int(value))] if ranged else []
            numbers.append(value)
            stop, ranged = index + 1, False
        elif not numbers or tokens[index].text not in (",", "and", "&", "plus", *_TO):
            break
        elif tokens[index].text in _TO:
            # "drones 1 and 2 to 10 m": only what begins the list is a range in words.
            if ranged or index != stop or (tokens[index].kind == "word" and len(numbers) > 1):
                break
            ranged = True
        index += 1
    wanted = dict.fromkeys(numbers)
    names = {f"{kind}_{number:g}" for number in wanted} | {f"{kind}{number:g}" for number in wanted}
    which = tuple(name for name, _ in roster if name in names)
    return (stop, which) if len(wanted) > 1 and len(which) == len(wanted) else None


def _range(tokens: Sequence[Token], end: int, low: float, high: float) -> bool:
    """Whether a second figure is the last of some numbers, and no quantity: "drones 4 to 6", not "drone 4 to 6 m"."""
    after = tokens[end + 1].text if end + 1 < len(tokens) else ""
    whole = low == int(low) and high == int(high)
    return whole and 0 < high - low <= _LONGEST_RANGE and after not in _UNITS


_UNITS = frozenset((
    "m", "km", "cm", "ft", "metre", "metres", "meter", "meters", "foot", "feet", "s", "sec", "second", "seconds", "min",
    "minute", "minutes", "h", "hour", "hours", "lap", "laps", "time", "times", "degree", "degrees", "percent", "%", "°",
))  # fmt: skip
_TO = frozenset(("to", "through", "thru", "-", "–"))
_LONGEST_RANGE = 256


def _meant(lead: str, count: float | None, *, plural: bool, number: int) -> str:
    """Whether a noun for robots means `all` of its kind, `one` that is clear, or `any`; empty when it means none."""
    if lead in _GROUP:
        return "all"  # "all five drones" of two: `robots.group_size` holds the plan
    if plural:
        return "all" if count == number or (count is None and lead in ("the", "")) else "any"
    if lead == "the":
        return "one" if number == 1 else "any"
    return "any" if lead in _ONE_OF or count == 1 else ""
