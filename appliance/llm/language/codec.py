"""Plans as symbols of the plan language, and back.

    answer   = "none" kind | domain subtask { "|" subtask }
    subtask  = skill [ robot ] { parameter ":" value } [ "<" number { number } ]
    robot    = text | "any" | "any1" … "any9" | "all"      left out where the skill settles it (compute, joint)
    value    = text | "[" value { value } "]" | "operator"
    text     = [ "@" ] piece { "+" piece }                  joined with a blank; "@": a robot's id, in a place for names
    piece    = word word [ "~" ] | literal                  from a word to a word; "~" makes the last one singular
    literal  = JSON text or number                          what no run of words means: rare

Subtasks have the numbers 1, 2, … in the order they stand in, and come after those whose numbers follow "<". The name
of a parameter says what a text is: a name, a free text, a quantity or a robot (`values`). `read` of what `write` wrote
is the same plan, for every plan of the catalogue; `write` chooses the shortest, then the first run of the instruction's
words that means a value, and a word of the roster only if there is none: whoever is named is copied from where he is.
"""

import json
import re
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from typing import Any, NoReturn, cast

from msgspec import Struct

from appliance.errors import PlanError
from appliance.llm.language import values
from appliance.llm.language.plurals import singular
from appliance.llm.language.words import Words
from appliance.model import Subtask
from appliance.skills.catalogue import Catalogue

ANY = re.compile(r"any[1-9]?|all")
OPERATOR = "operator"
MAX_SUBTASKS = 64
_WORD = re.compile(r"w(\d{1,3})")
_LONGEST = 40
"""Words a free text may have to be pointed at."""


class Answer(Struct, frozen=True, kw_only=True):
    """What was understood: a plan (domain and subtasks), or why there is none (`refused`)."""

    domain: str = ""
    subtasks: tuple[Subtask, ...] = ()
    refused: str = ""


# --- writing ----------------------------------------------------------------------------------------------------


def write(answer: Answer, words: Words, catalogue: Catalogue) -> list[str]:
    """Return the symbols of an answer over the words of its instruction."""
    if answer.refused:
        return ["none", answer.refused]
    writer = _Writer(words)
    symbols = [answer.domain]
    numbers = {subtask.id: str(number) for number, subtask in enumerate(answer.subtasks, start=1)}
    for subtask in answer.subtasks:
        if subtask is not answer.subtasks[0]:
            symbols.append("|")
        manifest = catalogue.skills[subtask.skill]
        symbols.append(subtask.skill)
        if subtask.robot is not None and has_robot(manifest.runs, joint=manifest.joint):
            symbols += writer.robot(subtask.robot)
        for name, value in subtask.params.items():
            symbols += [f"{name}:", *writer.value(name, value)]
        if subtask.after:
            symbols += ["<", *(numbers[other] for other in subtask.after)]
    return symbols


def has_robot(runs: str, *, joint: bool) -> bool:
    """Whether a subtask of this skill says its robot: not where the skill settles it."""
    return runs != "compute" and not joint


class _Writer:
    """Finds the words that mean a value."""

    def __init__(self, words: Words) -> None:
        self._words = words
        self._used: set[int] = set()

    def robot(self, robot: str) -> list[str]:
        if ANY.fullmatch(robot):
            return [robot]
        found = self._whole(robot, values.robot)
        if not found and values.robot(robot.replace("_", " ")) == robot:
            found = self._pieces(robot.replace("_", " "))
        return found or [json.dumps(robot, ensure_ascii=False)]

    def value(self, name: str, value: Any) -> list[str]:
        if isinstance(value, list):
            items = cast("list[Any]", value)
            return ["[", *(symbol for item in items for symbol in self._item(name, item)), "]"]
        return self._item(name, value)

    def _item(self, name: str, value: Any) -> list[str]:
        if name == "robots":
            return self.robot(value)
        if not isinstance(value, str):
            return self._number(name, value)
        if value == OPERATOR:
            return [OPERATOR]
        if name in values.FREE:
            return self._whole(value, values.free) or [json.dumps(value, ensure_ascii=False)]
        found = self._whole(value, values.name)
        if not found and "_" in value:
            robot = self.robot(value)
            found = ["@", *robot] if robot[0].startswith("w") else []
        found = found or self._pieces(value)
        return found or [json.dumps(value, ensure_ascii=False)]

    def _number(self, name: str, value: float) -> list[str]:
        unit = values.unit_of(name)
        found: list[tuple[bool, int, int]] = []
        for first, last in self._runs(6):
            meant = values.quantity(self._words.run(first, last), unit)
            if meant is not None and abs(meant - value) < 1e-6 * max(1.0, abs(value)):
                # A figure of a name ("dock 2") is not the number meant, if there is another.
                found.append((any(word in self._used for word in range(first, last + 1)), first - last, first))
        if not found:
            return [json.dumps(value)]
        _, shorter, first = min(found, key=lambda each: (each[0], -each[1], each[2]))
        return _pointed(first, first - shorter)

    def _whole(self, value: str, meaning: Callable[[str], str]) -> list[str]:
        longest = min(_LONGEST, value.count(" ") + value.count("_") + 8 + 2 * len(re.findall(r"[^\w\s]", value)))
        for first, last in self._runs(longest):
            if meaning(self._words.run(first, last)) == value:
                self._used.update(range(first, last + 1))
                return _pointed(first, last)
        return []

    def _pieces(self, value: str) -> list[str]:
        """Point at a name piece by piece, each as long as can be."""
        parts, symbols = value.split(" "), list[str]()
        at = 0
        while at < len(parts):
            for end in range(len(parts), at, -1):
                if piece := self._piece(" ".join(parts[at:end])):
                    symbols += [*(["+"] if symbols else []), *piece]
                    at = end
                    break
            else:
                symbols += [*(["+"] if symbols else []), json.dumps(parts[at], ensure_ascii=False)]
                at += 1
        return symbols if any(_WORD.fullmatch(symbol) for symbol in symbols) else []

    def _piece(self, text: str) -> list[str]:
        if found := self._whole(text, values.name):
            return found
        found = self._whole(text, lambda run: singular(values.name(run)))
        return [*found, "~"] if found else []

    def _runs(self, longest: int) -> Iterator[tuple[int, int]]:
        """Yield the runs of the instruction's words, the shortest first, and after them the words of the roster."""
        own = self._words.own
        for length in range(longest):
            for first in range(own - length):
                yield first, first + length
        for word in range(own, len(self._words)):
            yield word, word


def _pointed(first: int, last: int) -> list[str]:
    return [f"w{first}", f"w{last}"]


# --- reading ----------------------------------------------------------------------------------------------------


def read(symbols: Sequence[str], words: Words, catalogue: Catalogue) -> Answer:
    """Return the answer that symbols mean over the words of an instruction.

    Raises:
        PlanError: they are no answer; the message says what is wrong and at which symbol.
    """
    return _Reader(symbols, words, catalogue).answer()


class _Reader:
    """Takes symbols one by one."""

    def __init__(self, symbols: Sequence[str], words: Words, catalogue: Catalogue) -> None:
        self._symbols = symbols
        self._words = words
        self._catalogue = catalogue
        self._at = 0

    def answer(self) -> Answer:
        first = self._take()
        if first == "none":
            return Answer(refused=self._take())
        subtasks = [self._subtask(1)]
        while self._peek():
            if self._take() != "|":
                self._fail("expected | or the end")
            if len(subtasks) == MAX_SUBTASKS:
                self._fail(f"more than {MAX_SUBTASKS} subtasks")
            subtasks.append(self._subtask(len(subtasks) + 1))
        return Answer(domain=first, subtasks=tuple(subtasks))

    def _subtask(self, number: int) -> Subtask:
        skill = self._take()
        manifest = self._catalogue.skills.get(skill)
        if manifest is None:
            self._fail(f"there is no skill {skill!r}")
        robot = self._robot() if has_robot(manifest.runs, joint=manifest.joint) else None
        params: dict[str, Any] = {}
        while self._peek().endswith(":") and not self._peek().startswith('"'):
            name = self._take()[:-1]
            if name not in manifest.params or name in params:
                self._fail(f"{skill} has no (second) parameter {name!r}")
            params[name] = self._value(name)
        after: list[str] = []
        if self._peek() == "<":
            self._take()
            while self._peek().isdigit():
                before = int(self._take())
                if not 0 < before < number:
                    self._fail(f"subtask {number} cannot come after {before}")
                after.append(f"s{before}")
            if not after or any(int(one[1:]) >= int(two[1:]) for one, two in pairwise(after)):
                self._fail("numbers of predecessors follow <, each once, in order")
        if manifest.joint and manifest.runs != "compute":  # its robot is the first of its robots
            robots: list[str] = params.get("robots") or []
            robot = robots[0] if robots else None
        return Subtask(id=f"s{number}", skill=skill, robot=robot, params=params, after=tuple(after))

    def _robot(self) -> str:
        if ANY.fullmatch(self._peek()):
            return self._take()
        return self._id()

    def _id(self) -> str:
        """Take a text as a robot's id; a lone literal is one as it stands."""
        literal = self._peek().startswith('"')
        before = self._at
        text = str(self._text("robot"))
        return text if literal and self._at == before + 1 else values.robot(text)

    def _value(self, name: str) -> Any:
        if self._peek() != "[":
            return self._item(name)
        self._take()
        items: list[Any] = []
        while self._peek() != "]":
            items.append(self._item(name))
        self._take()
        return items

    def _item(self, name: str) -> Any:
        if name == "robots":
            return self._robot()
        if self._peek() == OPERATOR:
            return self._take()
        symbol = self._peek()
        if re.fullmatch(r"-?\d+(\.\d+)?([eE][+-]?\d+)?", symbol):
            return json.loads(self._take())
        return self._text(name)

    def _text(self, name: str) -> Any:
        if self._peek() == "@":
            self._take()
            return self._id()
        unit_less = name in values.FREE or name == "robot"
        kind = None if unit_less else name
        pieces = [self._piece(kind, name)]
        while self._peek() == "+":
            self._take()
            pieces.append(self._piece(kind, name))
        if len(pieces) == 1:
            return pieces[0]
        return " ".join(str(piece) for piece in pieces)

    def _piece(self, kind: str | None, name: str) -> Any:
        symbol = self._take()
        if symbol.startswith('"'):
            try:
                return str(json.loads(symbol))
            except ValueError:
                self._fail("a literal is a JSON text")
        first, last = self._word(symbol), self._word(self._take())
        if last < first or (last >= self._words.own and first != last):
            self._fail(f"words {first} to {last} are no run")
        text = self._words.run(first, last)
        if name in values.FREE:
            return values.free(text)
        if kind is not None and is_number(kind):
            meant = values.quantity(text, values.unit_of(kind))
            if meant is None:
                self._fail(f"{text!r} is no {kind}")
            return meant
        said = values.name(text)
        if self._peek() == "~":
            self._take()
            return singular(said)
        return said

    def _word(self, symbol: str) -> int:
        match = _WORD.fullmatch(symbol)
        if match is None or int(match[1]) >= len(self._words):
            self._fail(f"{symbol!r} is no word of the instruction")
        return int(match[1])

    def _peek(self) -> str:
        return self._symbols[self._at] if self._at < len(self._symbols) else ""

    def _take(self) -> str:
        if self._at >= len(self._symbols):
            self._fail("it ends too early")
        self._at += 1
        return self._symbols[self._at - 1]

    def _fail(self, why: str) -> NoReturn:
        raise PlanError(f"symbol {self._at}: {why}", remedy="ask again, or another planner")


_NUMERIC = frozenset({"laps", "count", "epochs", "fps"})


def is_number(parameter: str) -> bool:
    """Whether a parameter takes a number."""
    return parameter in _NUMERIC or bool(values.unit_of(parameter))
