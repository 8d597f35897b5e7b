"""Constrained decoding of the plan language, in the model's process: numbered words in, symbols out.

Each step takes the likeliest of the symbols that may come (`language.Guide`). What the model would have said otherwise
is not lost: the share of the chosen symbol among the allowed ones says how sure it was, and where another one had a
fair share the answer is gone through again from there. Given is the likeliest whole answer, and the others behind it;
two second opinions count towards which that is:

- coverage: a model's likeliest answer tends to be one that passes over a clause, since each thing that is said costs
  probability. Machine translation counters that with a coverage term (Wu et al. 2016, "Google's Neural Machine
  Translation System", section 7); here, where an answer points at words, coverage is what it points at.
- evidence: a linear classifier over the same words, one yes or no for each skill (Joachims 1998, "Text categorization
  with support vector machines": many weak cues, hardly any irrelevant). It errs too, but elsewhere than a model that
  loses a clause, or takes one verb for another, and is sure of it. Skills that it was not trained on are left out; so
  is `goto`, which follows from places, not from verbs.

Several models may answer as one (`Voices`): a symbol is as likely as the mean of the logarithms of what each gives it.
They were trained alike, from different beginnings or reading the instruction differently, and err in different places.
All have the same tokens.

A model folder has, beside what the library needs, `planner.json`: which token is which symbol, and how shares become a
confidence; it may have `evidence.bin`.
"""

import heapq
import itertools
import json
import math
import re
import time
import zlib
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct

from appliance.llm.language import END, Guide, SkillShape
from appliance.llm.words import MAX_WORDS, Words, words_of

_SMALL = frozenset(
    "a an the this that of to in on at onto into from by up down out off with for as "  # noqa: SIM905 - a list of words
    "and or but if so then when while after before once just not no please "
    "i me my you your we us our he him his she her it its they them their "
    "is are be been do does".split()
)
"""Words that a right answer may or may not have in its runs."""


def covered(symbols: Sequence[str], words: Words) -> int:
    """Return how many words of an instruction an answer points at, small ones, marks and the roster left out."""
    pointed = [int(each[1:]) for each in symbols if each[0] == "w" and each[1:].isdigit()]
    inside: set[int] = set()
    for first, last in zip(pointed[::2], pointed[1::2], strict=False):
        inside.update(range(first, last + 1))
    return sum(number < words.own and _weighs(words[number]) for number in inside)


def _weighs(word: str) -> bool:
    return word[0].isalnum() and word.lower() not in _SMALL


FILE = "evidence.bin"
UNSAID = frozenset({"goto"})
"""Skills that a plan may have without a word for them."""
_STEM = 5
"""Letters of a word that count as its stem."""
_MOST = 30.0


class Evidence(Struct, frozen=True, kw_only=True):
    """The classifier: the log-odds of a skill are its bias and the weights of all cues, times the scale."""

    skills: tuple[str, ...]
    bias: tuple[float, ...]
    scale: float
    rows: dict[int, bytes]
    """Of each cue that is known, by its checksum: a signed byte for each skill."""

    def odds(self, words: Sequence[str]) -> dict[str, float]:
        """Return the log-odds that a plan for these words (lower case) has each skill."""
        sums = [0] * len(self.skills)
        for cue in cues(words):
            if (row := self.rows.get(cue)) is not None:
                sums = [one + two for one, two in zip(sums, memoryview(row).cast("b"), strict=True)]
        return {
            skill: bias + self.scale * total for skill, bias, total in zip(self.skills, self.bias, sums, strict=True)
        }


def cues(words: Sequence[str]) -> list[int]:
    """Return checksums of what words may be known by: each, its stem, each with the next, and with the one after."""
    found = [each for word in words for each in (word, f"{word[:_STEM]}*")]
    found += [f"{one} {two}" for one, two in pairwise(words)]
    found += [f"{one} _ {two}" for one, two in zip(words, words[2:], strict=False)]
    return [zlib.crc32(each.encode()) for each in found]


def skills_of(symbols: Sequence[str]) -> frozenset[str]:
    """Return the skills of an answer; none for a refusal."""
    if symbols[:1] == ["none"] or symbols[:1] == ("none",):
        return frozenset()
    return frozenset(symbol for before, symbol in pairwise(("|", *symbols[1:])) if before == "|")


def support(odds: Mapping[str, float], skills: Collection[str]) -> float:
    """Return the logarithm of the probability that of all skills with odds just these are in the plan; 0 at most."""
    return -sum(
        math.log1p(math.exp(min(_MOST, -value if skill in skills else value)))
        for skill, value in odds.items()
        if skill not in UNSAID
    )


def read_evidence(folder: Path) -> Evidence | None:
    """Return the evidence of a model folder; None where it has none.

    Raises:
        ValueError: it is damaged.
    """
    path = folder / FILE
    if not path.is_file():
        return None
    try:
        evidence = msgspec.msgpack.decode(path.read_bytes(), type=Evidence)
    except msgspec.DecodeError as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    count = len(evidence.skills)
    if len(evidence.bias) != count or any(len(row) != count for row in evidence.rows.values()):
        raise ValueError(f"{path} is damaged: not a weight for each of {count} skills")
    return evidence


def write_evidence(folder: Path, evidence: Evidence) -> None:
    """Write the evidence into a model folder."""
    (folder / FILE).write_bytes(msgspec.msgpack.encode(evidence))


ROOM = 320
"""Tokens that are left for an answer before an instruction is read twice."""
LEAST = 64
"""Tokens that an answer may need."""


class TooLongError(Exception):
    """The instruction has more words than the planner can number, or the answer does not end."""


class Voice:
    """One model and how far it is.

    Args:
        og: the library.
        model: of the library.
        tokenizer: of the library.
        tokens: symbol, or frame token in angle brackets, to its token.
        twice: whether the instruction stands in its prompt twice, first without numbers.
        context: tokens that prompt and answer may have.
    """

    def __init__(
        self, og: Any, model: Any, tokenizer: Any, tokens: dict[str, int], *, twice: bool, context: int
    ) -> None:
        self._tokenizer = tokenizer
        self._tokens = tokens
        self._twice = twice
        self._context = context
        self._pieces: dict[str, list[int]] = {}
        params = og.GeneratorParams(model)
        params.set_search_options(max_length=context, do_sample=False)
        self._new = lambda: og.Generator(model, params)
        self._generator: Any = None
        self._prompt = 0

    def begin(self, words: Sequence[str], own: int) -> int:
        """Read an instruction; return the tokens that are left for the answer.

        Args:
            words: of the instruction, and behind them of the roster; in lower case.
            own: how many are the instruction's.

        Raises:
            TooLongError: too many words, or tokens.
        """
        prompt = self.read(words, own)
        self._prompt = len(prompt)
        self._generator = None  # the one before goes first: two take twice the memory
        self._generator = self._new()
        self._generator.append_tokens(prompt)
        return self._context - len(prompt) - 2

    def read(self, words: Sequence[str], own: int) -> list[int]:
        """Return the tokens of the prompt. As `begin`."""
        tokens = self._tokens
        if len(words) > MAX_WORDS:
            raise TooLongError(f"{len(words)} words and robots, more than {MAX_WORDS}")
        found = [tokens["<begin>"]]
        for number, word in enumerate(words):
            if number == own:
                found.append(tokens["<roster>"])
            found.append(tokens[f"w{number}"])
            found += self._cut(word)
        found.append(tokens["<plan>"])
        if self._twice:
            first = [tokens["<begin>"], *(piece for word in words[:own] for piece in self._cut(word))]
            if len(first) + len(found) + ROOM <= self._context:
                found = [*first, *found]
        if len(found) + LEAST > self._context:
            raise TooLongError(f"{len(found)} tokens, more than the planner's {self._context} leave room for")
        return found

    def literal(self, text: str) -> list[int]:
        """Return the tokens of a text that is said and not pointed at."""
        mark = self._tokens["<literal>"]
        return [mark, *self._cut(f"'{text}"), mark]

    @property
    def prompt(self) -> int:
        """Tokens of the prompt."""
        return self._prompt

    def likely(self, tokens: Sequence[int]) -> list[float]:
        """Return the logarithms of the shares that tokens have, among themselves, of what comes next."""
        logits = self._generator.get_logits().reshape(-1)
        values = [float(logits[token]) for token in tokens]
        most = max(values)
        total = most + math.log(sum(math.exp(value - most) for value in values))
        return [value - total for value in values]

    def go_on(self, tokens: Sequence[int]) -> None:
        """Take tokens as said."""
        self._generator.append_tokens(list(tokens))

    def set_back(self, answer: int) -> None:
        """Take back what was said behind so many tokens of the answer."""
        self._generator.rewind_to(self._prompt + answer)

    def _cut(self, word: str) -> list[int]:
        pieces = self._pieces.get(word)
        if pieces is None:
            if len(self._pieces) > 20_000:
                self._pieces.clear()
            pieces = self._pieces[word] = [int(token) for token in self._tokenizer.encode(word)]
        return pieces


class Voices:
    """Several models as one; each goes through the same answer.

    They read what is said when they are next asked, all of it at once: of what the guide leaves no choice they are not
    asked, and a model reads three tokens together in little more time than one.
    """

    def __init__(self, voices: Sequence[Voice]) -> None:
        self._voices = tuple(voices)
        self._said: list[int] = []
        self._read: list[int] = []
        """What of it the models have read, and what was taken back since."""

    def begin(self, words: Sequence[str], own: int) -> int:
        """Read an instruction; return the tokens that are left for the answer. As `Voice.begin`."""
        self._said, self._read = [], []
        return min(voice.begin(words, own) for voice in self._voices)

    @property
    def prompt(self) -> int:
        """Tokens of all prompts."""
        return sum(voice.prompt for voice in self._voices)

    def likely(self, tokens: Sequence[int]) -> list[float]:
        """Return how likely tokens are to come next, as logarithms up to a number that is the same for all."""
        self._catch_up()
        each = [voice.likely(tokens) for voice in self._voices]
        return [sum(values) / len(values) for values in zip(*each, strict=True)]

    def literal(self, text: str) -> list[int]:
        """Return the tokens of a text that is said and not pointed at."""
        return self._voices[0].literal(text)

    def go_on(self, token: int) -> None:
        """Take a token as said."""
        self._said.append(token)

    def say(self, tokens: Sequence[int]) -> None:
        """Have said these tokens and no others, from the beginning of the answer; one more is said before `likely`."""
        self._said = list(tokens)

    def _catch_up(self) -> None:
        """Have the models read what is said and not read, and forget what was taken back."""
        said, read = self._said, self._read
        same = 0
        while same < min(len(said), len(read)) and said[same] == read[same]:
            same += 1
        for voice in self._voices:
            if same < len(read):
                voice.set_back(same)
            if same < len(said):
                voice.go_on(said[same:])
        self._read = list(said)


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
    """Folders in this one whose models are asked too (`Voices`); they have the same tokens."""


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
