"""Tokens of the embedded planner: a prompt is numbered words, an answer symbols of the plan language.

    <w3> rex <w4> , <w5> fetch … <roster> <w20> max … <plan> manipulation goto <w3> <w3> place: … <end>

Where the instruction is read twice, it stands before that once more, without numbers: <begin> rex , fetch … <begin>. A
Llama model sees only what is before a word; so it sees all of the instruction at each numbered one.

Every symbol of the language is one token. Words are cut into pieces learnt from the corpus, down to single bytes, so no
name is unknown. Numbers of words may begin anywhere (`shift`): in training at random, so that all are learnt alike.
"""

import json
from collections.abc import Iterable, Sequence
from pathlib import Path

from tokenizers import Tokenizer, decoders, models, pre_tokenizers, trainers

from appliance.llm.words import MAX_WORDS
from appliance.skills.catalogue import Catalogue
from workshop.corpus.notation import KINDS
from workshop.train.examples import Example

SIZE = 4096
PAD, BEGIN, END, ROSTER, PLAN, LITERAL = "<pad>", "<begin>", "<end>", "<roster>", "<plan>", "<literal>"
_FRAME = (PAD, BEGIN, END, ROSTER, PLAN, LITERAL)
_MARKS = (
    "|",
    "<",
    "[",
    "]",
    "+",
    "~",
    "@",
    "none",
    "operator",
    "all",
    "any",
    *(f"any{number}" for number in range(1, 10)),
)
MAX_AFTER = 32


def symbols_of(catalogue: Catalogue) -> tuple[str, ...]:
    """Return all symbols of the language that are one token each, but for numbered words."""
    skills = sorted(catalogue.skills)
    parameters = sorted({name for each in catalogue.skills.values() for name in each.params})
    domains = sorted({each.domain for each in catalogue.skills.values()})
    numbers = [str(number) for number in range(1, MAX_AFTER + 1)]
    return (*_MARKS, *KINDS, *domains, *skills, *(f"{name}:" for name in parameters), *numbers)


class Tokens:
    """Turns examples into numbers, and numbers into symbols."""

    def __init__(self, tokenizer: Tokenizer) -> None:
        self.tokenizer = tokenizer
        self.size = tokenizer.get_vocab_size()
        self._id = tokenizer.get_vocab()
        self._symbol = {
            number: token[1:-1] for token, number in self._id.items() if token.startswith("<") and token.endswith(">")
        }
        self._pieces: dict[str, list[int]] = {}

    @classmethod
    def learn(cls, words: Iterable[str], catalogue: Catalogue, *, size: int = SIZE) -> "Tokens":
        """Learn the pieces of words from the words of a corpus."""
        tokenizer = Tokenizer(models.BPE())
        tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
        tokenizer.decoder = decoders.ByteLevel()
        special = [*_FRAME, *(f"<w{n}>" for n in range(MAX_WORDS)), *(f"<{each}>" for each in symbols_of(catalogue))]
        trainer = trainers.BpeTrainer(
            vocab_size=size,
            special_tokens=special,
            initial_alphabet=sorted(pre_tokenizers.ByteLevel.alphabet()),
            show_progress=False,
        )
        tokenizer.train_from_iterator(words, trainer)
        return cls(tokenizer)

    def extended(self, catalogue: Catalogue) -> "Tokens":
        """Return the tokens with those of skills and parameters that a catalogue has besides, behind all others."""
        tokenizer = Tokenizer.from_str(self.tokenizer.to_str())
        tokenizer.add_special_tokens(  # pyright: ignore[reportUnknownMemberType]
            [each for each in (f"<{s}>" for s in symbols_of(catalogue)) if each not in self._id]
        )
        return Tokens(tokenizer)

    @classmethod
    def load(cls, folder: Path) -> "Tokens":
        """Read `tokenizer.json` of a model folder."""
        return cls(Tokenizer.from_file(str(folder / "tokenizer.json")))

    def of(self, token: str) -> int:
        """Return the number of a frame token, or of a symbol written in angle brackets."""
        return self._id[token]

    def prompt(self, words: Sequence[str], own: int, *, shift: int = 0, twice: bool = False) -> list[int]:
        """Return the tokens up to and with <plan>; `twice`: with the instruction once more in front."""
        found = [self._id[BEGIN]]
        if twice:
            found += [piece for word in words[:own] for piece in self._cut(word.lower())] + [self._id[BEGIN]]
        for number, word in enumerate(words):
            if number == own:
                found.append(self._id[ROSTER])
            found.append(self._id[f"<w{number + shift}>"])
            found += self._cut(word.lower())
        found.append(self._id[PLAN])
        return found

    def answer(self, symbols: Sequence[str], *, shift: int = 0) -> list[int]:
        """Return the tokens of an answer, with <end>."""
        found: list[int] = []
        for symbol in symbols:
            if symbol[0] == "w" and symbol[1:].isdigit():
                found.append(self._id[f"<w{int(symbol[1:]) + shift}>"])
            elif (number := self._id.get(f"<{symbol}>")) is not None and not _is_number_literal(symbol, found, self):
                found.append(number)
            else:
                text = str(json.loads(symbol)) if symbol.startswith('"') else symbol
                quoted = "'" if symbol.startswith('"') else ""
                found += [self._id[LITERAL], *self._cut(quoted + text), self._id[LITERAL]]
        return [*found, self._id[END]]

    def example(self, example: Example, *, shift: int = 0, twice: bool = False) -> tuple[list[int], list[int]]:
        """Return the tokens of the prompt and of the answer of an example."""
        prompt = self.prompt(example.words, example.own, shift=shift, twice=twice)
        return prompt, self.answer(example.symbols, shift=shift)

    def symbols(self, tokens: Iterable[int], *, shift: int = 0) -> list[str]:
        """Return the symbols of an answer's tokens; what is no symbol stands as it is, to be refused by the reader."""
        found: list[str] = []
        literal: list[int] | None = None
        for token in tokens:
            symbol = self._symbol.get(token)
            if symbol == "literal":
                if literal is None:
                    literal = []
                else:
                    text = str(self.tokenizer.decode(literal))
                    found.append(json.dumps(text[1:], ensure_ascii=False) if text.startswith("'") else text or '""')
                    literal = None
            elif literal is not None:
                literal.append(token)
            elif symbol == "end":
                break
            elif symbol is None:
                found.append(f"?{token}")
            elif symbol[0] == "w" and symbol[1:].isdigit():
                found.append(f"w{int(symbol[1:]) - shift}")
            else:
                found.append(symbol)
        return found

    def save(self, folder: Path) -> None:
        """Write `tokenizer.json`."""
        self.tokenizer.save(str(folder / "tokenizer.json"))

    def _cut(self, word: str) -> list[int]:
        pieces = self._pieces.get(word)
        if pieces is None:
            pieces = self._pieces[word] = list(self.tokenizer.encode(word, add_special_tokens=False).ids)
            if len(self._pieces) > 200_000:
                self._pieces.clear()
        return pieces


def _is_number_literal(symbol: str, found: Sequence[int], tokens: "Tokens") -> bool:
    """Whether a number is a parameter's value, not the number of a subtask after "<"."""
    if not symbol.isdigit():
        return False
    last = (tokens.tokenizer.id_to_token(found[-1]) if found else "") or ""
    return last.endswith(":>") or last == "<[>"
