"""A planner that speaks the plan language, in the model's process: numbered words in, symbols out, held to the guide.

Each step takes the likeliest of the symbols that may come (`language.guide`). What the model would have said otherwise
is not lost: the share of the chosen symbol among the allowed ones says how sure it was. A model folder has, beside what
the library needs, `planner.json`: which token is which symbol, and how shares become a confidence.
"""

import math
import time
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct

from appliance.llm.language.guide import END, Guide, SkillShape
from appliance.llm.language.words import MAX_WORDS, words_of

CARD = "planner.json"
MOST_SYMBOLS = 600
"""Of an answer; a longer one is none."""


class Card(Struct, frozen=True, kw_only=True):
    """`planner.json`."""

    language: int
    """Version of the plan language; this program speaks 1."""
    tokens: dict[str, int]
    """Symbol, or frame token in angle brackets, to its token."""
    calibration: tuple[float, float] = (1.0, 0.0)
    """Slope and offset: the confidence is the logistic of slope x log-odds of the whole answer + offset."""


class Question(Struct, frozen=True, kw_only=True):
    """What is to be planned. `robots` is None where the roster is not known."""

    text: str
    robots: tuple[str, ...] | None
    skills: dict[str, SkillShape]
    deadline_s: float


class Said(Struct, frozen=True, kw_only=True):
    """An answer."""

    symbols: tuple[str, ...]
    confidence: float
    tokens: int
    ms: float


class TooLongError(Exception):
    """The instruction has more words than the planner can number, or the answer does not end."""


class TooLateError(Exception):
    """The answer did not end before its deadline."""


class Speaker:
    """One loaded model.

    Args:
        og: the library.
        model: of the library.
        tokenizer: of the library.
        card: which token is which symbol.
        context: tokens that prompt and answer may have.
    """

    def __init__(self, og: Any, model: Any, tokenizer: Any, card: Card, *, context: int) -> None:
        self._tokenizer = tokenizer
        self._card = card
        self._context = context
        self._known = frozenset(card.tokens)
        self._pieces: dict[str, list[int]] = {}
        self._params = og.GeneratorParams(model)
        self._params.set_search_options(max_length=context, do_sample=False)
        self._new = lambda: og.Generator(model, self._params)

    def answer(self, question: Question) -> Said:
        """Answer a question.

        Raises:
            TooLongError: too many words, or tokens.
            TooLateError: past the deadline.
        """
        began = time.monotonic()
        words = words_of(question.text, question.robots or ())
        prompt = self._prompt([words[number].lower() for number in range(len(words))], words.own)
        generator = self._new()
        generator.append_tokens(prompt)
        guide = Guide(words, question.skills, robots=question.robots, known=self._known)
        symbols: list[str] = []
        against = 0.0
        while True:
            if time.monotonic() - began > question.deadline_s:
                raise TooLateError(f"no answer within {question.deadline_s:g} s")
            allowed = [(each, token) for each in guide.allowed() if (token := self._token(each)) is not None]
            if not allowed or len(symbols) > min(MOST_SYMBOLS, self._context - len(prompt) - 2):
                raise TooLongError(f"no end after {len(symbols)} symbols")
            best = 0
            if len(allowed) > 1:
                logits = generator.get_logits().reshape(-1)
                values = [float(logits[token]) for _, token in allowed]
                best = max(range(len(values)), key=values.__getitem__)
                against += math.log(sum(math.exp(value - values[best]) for value in values))
            symbol, token = allowed[best]
            guide.take(symbol)
            if guide.ended:
                break
            symbols.append(symbol)
            generator.append_tokens([token])
        return Said(
            symbols=tuple(symbols),
            confidence=self._confidence(against),
            tokens=len(prompt) + len(symbols),
            ms=round(1000 * (time.monotonic() - began), 3),
        )

    def _confidence(self, against: float) -> float:
        """Return how sure an answer is whose probability is exp(-against), calibrated on held-out instructions."""
        share = min(1 - 1e-9, max(1e-9, math.exp(-against)))
        slope, offset = self._card.calibration
        return 1 / (1 + math.exp(-max(-60.0, min(60.0, slope * math.log(share / (1 - share)) + offset))))

    def _token(self, symbol: str) -> int | None:
        return self._card.tokens.get("<end>" if symbol == END else symbol)

    def _prompt(self, words: list[str], own: int) -> list[int]:
        tokens = self._card.tokens
        if len(words) > MAX_WORDS:
            raise TooLongError(f"{len(words)} words and robots, more than {MAX_WORDS}")
        found = [tokens["<begin>"]]
        for number, word in enumerate(words):
            if number == own:
                found.append(tokens["<roster>"])
            found.append(tokens[f"w{number}"])
            found += self._cut(word)
        found.append(tokens["<plan>"])
        if len(found) + 64 > self._context:
            raise TooLongError(f"{len(found)} tokens, more than the planner's {self._context} leave room for")
        return found

    def _cut(self, word: str) -> list[int]:
        pieces = self._pieces.get(word)
        if pieces is None:
            if len(self._pieces) > 20_000:
                self._pieces.clear()
            pieces = self._pieces[word] = [int(token) for token in self._tokenizer.encode(word)]
        return pieces


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
    return card
