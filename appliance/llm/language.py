"""The plan language, which the embedded model writes in place of JSON: its codec and the guide of its decoding.

A plan over the words of its instruction. Names, texts and quantities are not spelt but pointed at, by the numbers of
the first and last word, so that a name that no training data has is copied whole; a subtask takes about ten tokens.

    w0 Rex w1 , w2 fetch w3 the w4 drill w5 from w6 bay w7 2 w8 .        the instruction, its words numbered
    manipulation | goto w0 w0 place w6 w7 | pick w0 w0 object w4 w4 < 1  the plan
    none question                                                       or why there is none

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
words that means a value, and a word of the roster only if there is none: a robot that is named is copied from where its
name stands.

`Guide` says which symbols may come next. An answer that is held to it is a plan over the catalogue and over these
words: no skill, parameter or robot that is not there, no edge to a later subtask, nothing required left out, no number
where words are none, and no name that was not said (literals are offered only as a part of a name, and only those
between the ends of a range). What a plan may be beyond that is for validation.
"""

import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any, NoReturn, cast

from msgspec import Struct

from appliance.errors import PlanError
from appliance.llm import values
from appliance.llm.words import Words, between, singular
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


END = ""
"""The symbol after the last."""
KINDS = ("chatter", "question", "impossible", "unclear", "language")
MAX_GUIDED_SUBTASKS = 32
MAX_ITEMS = 16
MAX_PIECES = 4
_NAME, _FREE, _QUANTITY, _ROBOT = 12, 40, 8, 4
"""Words that one run may have."""
_ANYS = ("any", *(f"any{number}" for number in range(1, 10)))
_PEOPLE = frozenset({"to", "person", "target"})
"""Parameters that may be `operator`, or a robot by its id."""


class ParamShape(Struct, frozen=True):
    """What a value may be."""

    type: str
    required: bool = False


class SkillShape(Struct, frozen=True):
    """What of a skill decides which symbols may come: it travels to the model's process with each question."""

    domain: str
    runs: str
    joint: bool
    params: dict[str, ParamShape]


def shapes(catalogue: Catalogue) -> dict[str, SkillShape]:
    """Return the shapes of a catalogue's skills."""
    return {
        name: SkillShape(
            manifest.domain,
            manifest.runs,
            manifest.joint,
            {each: ParamShape(param.type, param.required) for each, param in manifest.params.items()},
        )
        for name, manifest in catalogue.skills.items()
    }


class Guide:
    """Follows an answer symbol by symbol.

    Args:
        words: the instruction and the roster.
        skills: the skills there are (`shapes`).
        robots: ids of the roster; None where it is not known, then any run of words may be a robot.
        known: symbols that the planner has; skills and parameters of later catalogues are not offered to it.
    """

    def __init__(
        self,
        words: Words,
        skills: Mapping[str, SkillShape],
        *,
        robots: Sequence[str] | None,
        known: frozenset[str] | None = None,
    ) -> None:
        self._words = words
        self._skills = {
            name: manifest
            for name, manifest in skills.items()
            if known is None or (name in known and all(f"{each}:" in known for each in manifest.params))
        }
        self._domains = tuple(sorted({each.domain for each in self._skills.values()}))
        self._robots = None if robots is None else frozenset(robots)
        self._runs: dict[str, dict[int, list[int]]] = {}
        """Of a kind of value: first word -> last words, where the run means one."""
        self._between = tuple(json.dumps(each) for each in between(words))
        """Literals that may be a part of a name."""
        self._state = "start"
        self._number = 0
        self._skill = ""
        self._left: dict[str, bool] = {}
        """Parameters that may still come, and whether they must."""
        self._parameter = ""
        self._listed = -1
        """Items of the list that is open; -1 for none."""
        self._first = -1
        self._pieces = 0
        self._said = ""
        """What the pieces of a name mean so far."""
        self._by_id = False
        """Whether a robot's id is said in a place for names."""
        self._plural = False
        self._last_before = 0

    def allowed(self) -> list[str]:
        """Return the symbols that may come next; END where the answer may end. Never empty until it has ended."""
        return _ALLOWED.get(self._state, _nothing)(self)

    def take(self, symbol: str) -> None:
        """Go on by a symbol that is allowed."""
        match self._state:
            case "start":
                self._state = "none" if symbol == "none" else "skill"
            case "none":
                self._state = "refused"
            case "skill":
                self._begin_subtask(symbol)
            case "robot" | "item":
                self._take_value(symbol)
            case "piece" if symbol[0] == '"':
                self._take_literal(str(json.loads(symbol)))
            case "piece":
                self._first, self._state = int(symbol[1:]), "last"
            case "last":
                self._take_run(int(symbol[1:]))
            case "after" if symbol.isdigit():
                self._last_before = int(symbol)
            case _:
                self._take_next(symbol)

    @property
    def ended(self) -> bool:
        """Whether the answer is whole."""
        return self._state == "ended"

    # --- what may come, by state ------------------------------------------------------------------------------

    def may_start(self) -> list[str]:
        """Return how an answer may begin."""
        return ["none", *self._domains]

    def may_be_skill(self) -> list[str]:
        """Return the skills that may come."""
        return [name for name in self._skills if self._can_be_said(name)]

    def may_be_first(self) -> list[str]:
        """Return the words with which a piece may begin."""
        return [*(f"w{first}" for first in self._runs_here()), *self._literals_here()]

    def may_be_last(self) -> list[str]:
        """Return the words with which the piece may end."""
        return [f"w{last}" for last in self._runs_here()[self._first]]

    def may_be_before(self) -> list[str]:
        """Return the subtasks after which this one may come."""
        numbers = [str(number) for number in range(self._last_before + 1, self._number)]
        return [*numbers, *(self._end() if self._last_before else [])]

    # --- subtasks ---------------------------------------------------------------------------------------------

    def _begin_subtask(self, skill: str) -> None:
        manifest = self._skills[skill]
        self._skill, self._number = skill, self._number + 1
        self._left = {name: param.required for name, param in manifest.params.items()}
        self._last_before = 0
        self._parameter, self._listed = "", -1
        if has_robot(manifest.runs, joint=manifest.joint):
            self._state = "robot"
            self._begin_text()
        else:
            self._state = "said"
            self._pieces = 0

    def _can_be_said(self, skill: str) -> bool:
        """Whether the words have something for all that a skill must be told."""
        manifest = self._skills[skill]
        return bool(self._any_runs(_NAME)) or not any(param.required for param in manifest.params.values())

    def _end(self) -> list[str]:
        if any(self._left.values()):
            return []
        return [END, *(["|"] if self._number < MAX_GUIDED_SUBTASKS else [])]

    def _take_next(self, symbol: str) -> None:
        if symbol == END:
            self._state = "ended"
        elif symbol == "|":
            self._state = "skill"
        elif symbol == "<":
            self._state = "after"
        elif symbol == "+":
            self._state = "piece"
        elif symbol == "~":
            self._said = self._before + singular(self._piece_said)
            self._plural = False
        elif symbol == "]":
            self._listed = -1
            self._pieces = 0
        elif symbol.endswith(":"):
            self._parameter = symbol[:-1]
            del self._left[self._parameter]
            self._state = "item"
            self._begin_text()
        else:  # another item of a list
            self._begin_text()
            self._take_value(symbol)

    # --- values -----------------------------------------------------------------------------------------------

    def _begin_text(self) -> None:
        self._pieces, self._said, self._before, self._piece_said = 0, "", "", ""
        self._by_id, self._plural = False, False

    _before = ""
    _piece_said = ""

    def _is_robot(self) -> bool:
        return not self._parameter or self._parameter == "robots" or self._by_id

    def _is_list(self) -> bool:
        return bool(self._parameter) and self._skills[self._skill].params[self._parameter].type == "array"

    def begin_value(self) -> list[str]:
        """Return the symbols with which a value may begin."""
        if self._state == "item" and self._is_list() and self._listed < 0:
            return ["["]
        if self._is_robot():
            anys = [*_ANYS, *(["all"] if self._robots is None else [])]
            return [*anys, *(f"w{first}" for first in self._robot_runs())]
        found = [f"w{first}" for first in self._runs_here()]
        if self._parameter in _PEOPLE:
            found.append(OPERATOR)
        if self._parameter not in values.FREE and not is_number(self._parameter) and self._robot_runs():
            found.append("@")
        return found

    def _begin_item(self) -> list[str]:
        """Return the symbols with which another item of a list may begin, whatever the last one was."""
        by_id, pieces, said = self._by_id, self._pieces, self._said
        self._by_id, self._pieces, self._said = False, 0, ""
        found = self.begin_value()
        self._by_id, self._pieces, self._said = by_id, pieces, said
        return found

    def _take_value(self, symbol: str) -> None:
        if symbol == "[":
            self._listed = 0
        elif symbol == "@":
            self._by_id, self._state = True, "piece"
        elif symbol[0] == "w" and symbol[1:].isdigit():
            self._first, self._state = int(symbol[1:]), "last"
        else:
            self._listed += self._listed >= 0
            self._pieces, self._state = MAX_PIECES, "said"

    def _take_run(self, last: int) -> None:
        text = self._words.run(self._first, last)
        self._pieces += 1
        self._before = f"{self._said} " if self._said else ""
        self._piece_said = values.name(text)
        self._said = self._before + self._piece_said
        self._plural = singular(self._piece_said) != self._piece_said
        self._listed += self._listed >= 0 and self._pieces == 1
        self._state = "said"

    def _take_literal(self, text: str) -> None:
        self._pieces += 1
        self._said = f"{self._said} {text}"
        self._plural = False
        self._state = "said"

    def _literals_here(self) -> list[str]:
        """Return the literals that may come as the next piece of a name; none may be its first."""
        if not self._pieces or not self._between:
            return []
        if not self._is_robot() or self._robots is None:
            return list(self._between)
        return [each for each in self._between if _id(f"{self._said} {json.loads(each)}") in self._robots]

    def after_value(self) -> list[str]:
        """Return what may follow a value or a robot."""
        found: list[str] = []
        pointed = 0 < self._pieces < MAX_PIECES
        joinable = self._parameter not in values.FREE and not (self._parameter and is_number(self._parameter))
        complete = not pointed or not self._is_robot() or self._robots is None or _id(self._said) in self._robots
        if pointed and joinable:
            if self._plural and (
                complete or not self._is_robot() or self._may_go_on(self._before + singular(self._piece_said))
            ):
                found.append("~")
            if self._may_go_on(self._said):
                found.append("+")
        if not complete and found:
            return found
        if self._listed >= 0:
            return [*found, "]", *(self._begin_item() if self._listed < MAX_ITEMS else [])]
        found += [f"{name}:" for name in self._left if self._value_possible(name)]
        if not any(self._left.values()):
            found += ["<"] if self._number > 1 else []
            found += self._end()
        return found

    def _may_go_on(self, said: str) -> bool:
        """Whether a further piece can make a name of what is said so far."""
        if not self._is_robot() or self._robots is None:
            return True
        begun = _id(said) + "_"
        begins = any(robot.startswith(begun) for robot in self._robots)
        return begins and bool(self._completions(begun) or self._literals_here())

    def _completions(self, begun: str) -> dict[int, list[int]]:
        robots = self._robots or frozenset()
        found: dict[int, list[int]] = {}
        for first in range(self._words.own):
            for last in range(first, min(first + _ROBOT, self._words.own)):
                if begun + _id(values.name(self._words.run(first, last))) in robots:
                    found.setdefault(first, []).append(last)
        return found

    def _value_possible(self, name: str) -> bool:
        """Whether the words have a value for a parameter: an instruction may be a mere question mark."""
        if is_number(name):
            return bool(self._quantities(values.unit_of(name)))
        if name == "robots" or name in _PEOPLE:
            return True
        return bool(self._any_runs(_FREE if name in values.FREE else _NAME))

    # --- runs of words ----------------------------------------------------------------------------------------

    def _runs_here(self) -> dict[int, list[int]]:
        """Return the runs that may come as the next piece of the value that is being said."""
        if self._is_robot():
            if self._pieces and self._robots is not None:
                return self._completions(_id(self._said) + "_")
            return self._robot_runs()
        if self._parameter in values.FREE:
            return self._any_runs(_FREE)
        if is_number(self._parameter):
            return self._quantities(values.unit_of(self._parameter))
        return self._any_runs(_NAME)

    def _any_runs(self, longest: int) -> dict[int, list[int]]:
        key = f"any {longest}"
        if key not in self._runs:
            own, count = self._words.own, len(self._words)
            says = [any(letter.isalnum() for letter in self._words[number]) for number in range(own)]
            runs: dict[int, list[int]] = {}
            for first in range(own):
                # A run of marks alone means nothing, and what is required would be left out.
                begin = next((number for number in range(first, min(first + longest, own)) if says[number]), own)
                if lasts := list(range(begin, min(first + longest, own))):
                    runs[first] = lasts
            self._runs[key] = runs | {number: [number] for number in range(own, count)}
        return self._runs[key]

    def _quantities(self, unit: str) -> dict[int, list[int]]:
        key = f"quantity {unit}"
        if key not in self._runs:
            own, found = self._words.own, dict[int, list[int]]()
            for first in range(own):
                for last in range(first, min(first + _QUANTITY, own)):
                    meant = values.quantity(self._words.run(first, last), unit)
                    if meant is not None and meant > 0:
                        found.setdefault(first, []).append(last)
            self._runs[key] = found
        return self._runs[key]

    def _robot_runs(self) -> dict[int, list[int]]:
        if self._robots is None:
            return self._any_runs(_ROBOT)
        if "robot" not in self._runs:
            own, found = self._words.own, dict[int, list[int]]()
            for first in range(own):
                for last in range(first, min(first + _ROBOT, own)):
                    said = values.name(self._words.run(first, last))
                    begun = _id(singular(said)) + "_"
                    if _id(said) in self._robots or (
                        any(robot.startswith(begun) for robot in self._robots) and self._completions(begun)
                    ):
                        found.setdefault(first, []).append(last)
            self._runs["robot"] = found | {number: [number] for number in range(own, len(self._words))}
        return self._runs["robot"]


def _id(said: str) -> str:
    return values.robot(said)


def _nothing(guide: Guide) -> list[str]:
    del guide
    return []


_ALLOWED: dict[str, Callable[[Guide], list[str]]] = {
    "start": Guide.may_start,
    "none": lambda _: list(KINDS),
    "refused": lambda _: [END],
    "skill": Guide.may_be_skill,
    "robot": Guide.begin_value,
    "item": Guide.begin_value,
    "piece": Guide.may_be_first,
    "last": Guide.may_be_last,
    "said": Guide.after_value,
    "after": Guide.may_be_before,
}
