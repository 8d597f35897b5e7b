"""The models of a planner, asked as one: a symbol is as likely as the mean of the logarithms of what each gives it.

They were trained alike, from different beginnings or reading the instruction differently, and err in different places:
what only one of them takes for likely is likely to neither. All have the same tokens.
"""

import math
from collections.abc import Sequence
from typing import Any

from appliance.llm.language.words import MAX_WORDS

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
