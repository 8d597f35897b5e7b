"""A planner that speaks the plan language, in the model's process: numbered words in, symbols out, held to the guide.

Each step takes the likeliest of the symbols that may come (`language.guide`). What the model would have said otherwise
is not lost: the share of the chosen symbol among the allowed ones says how sure it was, and where another one had a
fair share the answer is gone through again from there. Given is the likeliest whole answer, what it leaves unsaid
counted against it (`language.coverage`) and what the words speak for besides (`language.evidence`), and the others
behind it.
A model folder has, beside what the library needs, `planner.json`: which token is which symbol, and how shares become
a confidence; it may have `evidence.bin`.
"""

import heapq
import itertools
import json
import math
import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
from msgspec import Struct

from appliance.llm.language.coverage import covered
from appliance.llm.language.evidence import Evidence, skills_of, support
from appliance.llm.language.guide import END, Guide, SkillShape
from appliance.llm.language.words import words_of
from appliance.llm.voices import TooLongError, Voices

CARD = "planner.json"
MOST_SYMBOLS = 600
"""Of an answer; a longer one is none."""
SAID = 1.0
"""What each word that an answer points at is worth, in nats; chosen on held-out pairs (docs/planner.md)."""
EVIDENCE = 0.6
"""What a nat of the second opinion on an answer's skills is worth; chosen on held-out pairs too."""
TURNS, THOROUGH = 4, 12
"""Answers that are tried besides the one that is likeliest step by step; each takes half an answer's time or so."""
MOST_OF = 0.5
"""Share of the time for an answer after which no other one is begun or gone on with."""
LONGER, THOROUGH_LONGER = 3, 8
"""Times the symbols of the first answer that the others may have together."""
FAIR, THOROUGH_FAIR = 0.06, 0.02
"""Share of a symbol from which on it is worth an answer of its own."""
_INSIDE = re.compile(r"[\w-]+")


class Card(Struct, frozen=True, kw_only=True):
    """`planner.json`."""

    language: int
    """Version of the plan language; this program speaks 1."""
    tokens: dict[str, int]
    """Symbol, or frame token in angle brackets, to its token."""
    calibration: tuple[float, float] = (1.0, 0.0)
    """Slope and offset: the confidence is the logistic of slope x log-odds of the whole answer + offset."""
    twice: bool = False
    """Whether an instruction stands in the prompt twice, first without numbers; one that has no room for it, once."""
    beside: tuple[str, ...] = ()
    """Folders in this one whose models are asked too (`voices`); they have the same tokens."""


class Question(Struct, frozen=True, kw_only=True):
    """What is to be planned. `robots` is None where the roster is not known."""

    text: str
    robots: tuple[str, ...] | None
    skills: dict[str, SkillShape]
    deadline_s: float
    thorough: bool = False
    """Whether more answers are tried: for a question whose usual ones all broke a rule of plans."""


class Other(Struct, frozen=True):
    """Another answer, and how sure the model is of that one."""

    symbols: tuple[str, ...]
    confidence: float


class Said(Struct, frozen=True, kw_only=True):
    """An answer."""

    symbols: tuple[str, ...]
    confidence: float
    others: tuple["Other", ...] = ()
    """The next best first."""
    tokens: int
    ms: float


@dataclass(frozen=True)
class Turn:
    """Where an answer might have gone on otherwise."""

    at: int
    """Symbols before it."""
    tokens: tuple[int, ...]
    """Those of the symbols before it."""
    symbols: tuple[str, ...]
    """What may begin with that token: one, or several literals."""
    cost: float
    """Negative logarithm of the probability of all up to and with it."""
    share: float


@dataclass
class Spoken:
    """An answer, as far as it is."""

    symbols: list[str] = field(default_factory=list[str])
    tokens: list[int] = field(default_factory=list[int])
    cost: float = 0.0
    turns: list[Turn] = field(default_factory=list[Turn])


class TooLateError(Exception):
    """The answer did not end before its deadline."""


class BrokenOffError(Exception):
    """Nobody waits for the answer any more."""


class Speaker:
    """A loaded planner.

    Args:
        voices: its models.
        card: which token is which symbol.
        evidence: a second opinion on which skills an answer has; None where the folder has none.
    """

    def __init__(self, voices: Voices, card: Card, *, evidence: Evidence | None = None) -> None:
        self._voices = voices
        self._evidence = evidence
        self._card = card
        self._known = frozenset(card.tokens)

    def answer(self, question: Question, stop: Callable[[], bool] = lambda: False) -> Said:
        """Answer a question.

        Args:
            question: what is to be planned.
            stop: whether nobody waits for the answer any more.

        Raises:
            TooLongError: too many words, or tokens.
            TooLateError: past the deadline.
            BrokenOffError: nobody waits.
        """
        began = time.monotonic()
        words = words_of(question.text, question.robots or ())
        said_words = [words[number].lower() for number in range(len(words))]
        odds = {} if self._evidence is None else self._evidence.odds(said_words[: words.own])
        odds = {skill: value for skill, value in odds.items() if skill in question.skills and skill in self._known}
        until = began + question.deadline_s
        room = self._voices.begin(said_words, words.own)

        def guide() -> Guide:
            return Guide(words, question.skills, robots=question.robots, known=self._known)

        def check() -> None:
            if time.monotonic() > until:
                raise TooLateError(f"no answer within {question.deadline_s:g} s")
            if stop():
                raise BrokenOffError("nobody waits for the answer any more")

        most = min(MOST_SYMBOLS, room)
        first = self._followed(guide(), Spoken(), most, check)
        paths = [first]
        # An answer is there: what the others may take is bounded, by symbols, so that the same words get the same plan.
        until = began + MOST_OF * question.deadline_s
        turns_most, longer, fair = (
            (THOROUGH, THOROUGH_LONGER, THOROUGH_FAIR) if question.thorough else (TURNS, LONGER, FAIR)
        )
        spoken = len(first.symbols)
        left = longer * spoken
        # The cheapest turns first, of whatever answer; the number keeps equal ones in the order they were found in.
        number = itertools.count()
        turns = [(turn.cost, next(number), turn, first) for turn in first.turns if turn.share >= fair]
        heapq.heapify(turns)
        while turns and len(paths) <= turns_most and left > 0:
            _, _, turn, trunk = heapq.heappop(turns)
            other = guide()
            for symbol in trunk.symbols[: turn.at]:
                other.take(symbol)
            begun = Spoken(symbols=trunk.symbols[: turn.at], tokens=list(turn.tokens), cost=turn.cost)
            self._voices.say(begun.tokens)
            try:
                if self._taken(other, begun, turn.symbols):
                    self._followed(other, begun, min(most, turn.at + left), check)
                paths.append(begun)
            except TooLongError:
                pass
            except TooLateError:
                break  # there is an answer
            spoken += len(begun.symbols) - turn.at
            left -= len(begun.symbols) - turn.at
            for each in begun.turns:
                if each.share >= fair:
                    heapq.heappush(turns, (each.cost, next(number), each, begun))
        paths.sort(
            key=lambda path: (
                path.cost - SAID * covered(path.symbols, words) - EVIDENCE * support(odds, skills_of(path.symbols))
            )
        )
        return Said(
            symbols=tuple(paths[0].symbols),
            others=tuple(Other(tuple(path.symbols), self._confidence(path.cost)) for path in paths[1:]),
            confidence=self._confidence(paths[0].cost),
            tokens=self._voices.prompt + spoken,
            ms=round(1000 * (time.monotonic() - began), 3),
        )

    def _followed(self, guide: Guide, path: "Spoken", most: int, check: Callable[[], None]) -> "Spoken":
        """Go on with an answer to its end, by the likeliest symbol each time."""
        while True:
            check()
            groups: dict[int, list[str]] = {}
            """What may come, by the token that it begins with: literals begin alike."""
            for each in guide.allowed():
                if (token := self._begin(each)) is not None:
                    groups.setdefault(token, []).append(each)
            if not groups or len(path.symbols) > most:
                raise TooLongError(f"no end after {len(path.symbols)} symbols")
            allowed = list(groups)
            best = 0
            if len(allowed) > 1:
                values = self._voices.likely(allowed)
                order = sorted(range(len(values)), key=values.__getitem__, reverse=True)
                best, second = order[:2]
                total = values[best] + math.log(sum(math.exp(value - values[best]) for value in values))
                against = total - values[second]
                path.turns.append(
                    Turn(
                        at=len(path.symbols),
                        tokens=tuple(path.tokens),
                        symbols=tuple(groups[allowed[second]]),
                        cost=path.cost + against,
                        share=math.exp(-against),
                    )
                )
                path.cost += total - values[best]
            if not self._taken(guide, path, groups[allowed[best]]):
                return path

    def _taken(self, guide: Guide, path: "Spoken", symbols: Sequence[str]) -> bool:
        """Take a symbol, or the likeliest of some literals; whether the answer goes on."""
        symbol = symbols[0]
        if symbol[:1] == '"':
            symbol = self._literal_said(path, symbols)
        guide.take(symbol)
        if guide.ended:
            return False
        path.symbols.append(symbol)
        if symbol[:1] != '"':
            token = self._card.tokens[symbol]
            path.tokens.append(token)
            self._voices.go_on(token)
        return True

    def _literal_said(self, path: "Spoken", symbols: Sequence[str]) -> str:
        """Say the likeliest of some literals token by token, and return it."""
        left = {each: self._voices.literal(json.loads(each)) for each in symbols}
        said = 0
        while any(len(tokens) > said for tokens in left.values()):
            tokens = list(dict.fromkeys(each[said] for each in left.values()))
            best = 0
            if len(tokens) > 1:
                values = self._voices.likely(tokens)
                best = max(range(len(values)), key=values.__getitem__)
                path.cost += math.log(sum(math.exp(value - values[best]) for value in values))
            left = {symbol: each for symbol, each in left.items() if each[said] == tokens[best]}
            path.tokens.append(tokens[best])
            self._voices.go_on(tokens[best])
            said += 1
        return next(iter(left))

    def _confidence(self, against: float) -> float:
        """Return how sure an answer is whose probability is exp(-against), calibrated on held-out instructions."""
        share = min(1 - 1e-9, max(1e-9, math.exp(-against)))
        slope, offset = self._card.calibration
        return 1 / (1 + math.exp(-max(-60.0, min(60.0, slope * math.log(share / (1 - share)) + offset))))

    def _begin(self, symbol: str) -> int | None:
        """Return the token that a symbol begins with; None for one that the planner does not know."""
        if symbol[:1] == '"':
            return self._card.tokens.get("<literal>")
        return self._card.tokens.get("<end>" if symbol == END else symbol)


def read_card(folder: Path) -> Card | None:
    """Return the card of a model folder; None for a model that does not speak the plan language.

    Raises:
        ValueError: the card is damaged, or of another version of the language.
    """
    path = folder / CARD
    if not path.is_file():
        return None
    try:
        card = msgspec.json.decode(path.read_bytes(), type=Card)
    except msgspec.DecodeError as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    if card.language != 1:
        raise ValueError(f"{path} is for version {card.language} of the plan language, not 1")
    if any(not _INSIDE.fullmatch(each) for each in card.beside):
        raise ValueError(f"{path} names a model that is not in its folder: {', '.join(card.beside)}")
    return card
