"""Which symbols may come next: an answer that follows the guide is a plan over the catalogue, and over these words.

A planner that is held to it cannot be anything else: no skill, parameter or robot that is not there, no edge to a later
subtask, nothing required left out, no number where words are none, and no name that was not said (literals are offered
only as a part of a name, and only those between the ends of a range). What a plan may be beyond that is for validation.
"""

import json
from collections.abc import Callable, Mapping, Sequence

from msgspec import Struct

from appliance.llm.language import values
from appliance.llm.language.codec import OPERATOR, has_robot, is_number
from appliance.llm.language.plurals import singular
from appliance.llm.language.ranges import between
from appliance.llm.language.words import Words
from appliance.skills.catalogue import Catalogue

END = ""
"""The symbol after the last."""
KINDS = ("chatter", "question", "impossible", "unclear", "language")
MAX_SUBTASKS = 32
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
        return [END, *(["|"] if self._number < MAX_SUBTASKS else [])]

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
