"""Which instructions are a run of federated learning and not a plan: "Train clips on all robots for 20 rounds". Pure.

A run has rounds, clients and a model of its own; no plan says that. So such an instruction is not planned: typed into
the terminal UI it becomes the operation that starts a run, shown and asked for before it starts; from robots, templates
and `swiftbot submit` it is refused with the command. Each of its words is accounted for: what is left over makes it an
ordinary instruction again, which the planner and its review judge.
"""

import re
from collections.abc import Sequence

from msgspec import Struct

RECIPES = ("clips", "words", "sentences")
"""Recipes that come with the product (`learn.recipe.built_in`)."""
MOST_ROUNDS = 100_000
ALL = "all"
"""In place of robots: all that are there."""

_WORDS = (
    "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve", "thirteen",
    "fourteen", "fifteen", "sixteen", "seventeen", "eighteen", "nineteen", "twenty",
)  # fmt: skip
_NUMBERS = {word: number for number, word in enumerate(_WORDS, start=1)}
_COUNT = rf"(?:\d{{1,6}}|{'|'.join(_NUMBERS)})"
_NAME = r"[a-z0-9][a-z0-9_.-]{0,62}"
_WHO = (
    r"(?P<all>(?:all|every|each)(?: of)?(?: the| our)?(?: robots?)?|the(?: whole| entire)? fleet|everyone|all of them)"
    rf"|(?P<names>{_NAME}(?:(?:, and |, | and ){_NAME})*)"
)
_ON = rf"(?:on|with|over|across|using) (?:{_WHO})"
_ROUNDS = rf"(?:for|in) (?P<rounds>{_COUNT})(?: federated)? rounds?"
_MODEL = rf"(?:the )?(?:model |recipe )?(?P<recipe>{'|'.join(RECIPES)})(?: model| recipe)?"
_ORDER = re.compile(
    rf"(?:please )?(?:train|start training|run federated training of) {_MODEL}"
    rf"(?: {_ON}(?: {_ROUNDS})?| {_ROUNDS.replace('<rounds>', '<rounds_first>')}"
    rf"(?: {_ON.replace('<all>', '<all_last>').replace('<names>', '<names_last>')})?)(?:,? please)?[.!]?"
)
_LONGEST = 2000


class TrainingRequest(Struct, frozen=True):
    """A run of federated learning asked for in words."""

    recipe: str
    rounds: int | None = None
    """None: as many as the recipe says."""
    robots: tuple[str, ...] = ()
    """Empty: all that are there."""
    unknown: tuple[str, ...] = ()
    """Names that no robot of the roster has."""

    @property
    def command(self) -> str:
        """The command that starts it."""
        rounds = "" if self.rounds is None else f" --rounds {self.rounds}"
        robots = ",".join(self.robots) or ("ROBOT,..." if self.unknown else ALL)
        return f"swiftbot learn start {self.recipe} --robots {robots}{rounds}"


def training_request(text: str, robots: Sequence[str] = ()) -> TrainingRequest | None:
    """Return the run that a text asks for; None for any other text. It never raises.

    Args:
        text: as it was typed.
        robots: the roster's names; a name that is written with other capitals is that robot.
    """
    plain = " ".join(text[: _LONGEST + 1].split())
    if len(plain) > _LONGEST or (found := _ORDER.fullmatch(plain.casefold())) is None:
        return None
    told = found["rounds"] or found["rounds_first"]
    rounds = None if told is None else _NUMBERS[told] if told in _NUMBERS else int(told)
    if rounds is not None and not 1 <= rounds <= MOST_ROUNDS:
        return None
    names = found["names"] or found["names_last"]
    by_fold = {name.casefold(): name for name in robots}
    chosen = tuple(dict.fromkeys(by_fold.get(each, each) for each in re.split(r", and |, | and ", names or "") if each))
    known = tuple(name for name in chosen if name in robots)
    return TrainingRequest(found["recipe"], rounds, known, tuple(name for name in chosen if name not in robots))
