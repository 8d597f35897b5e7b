# pyright: basic, reportMissingImports=false
# PyTorch is of the extra `train`, which neither gateways nor the development environment have.
"""Batches of the planner's training: which examples, how varied and how laid out follows from seed and number alone.

They are made in groups whose examples are sorted by length before they are cut into batches, so that next to nothing of
a batch is padding; the batches of a group come in random order.
"""

import random
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.utils.data import Dataset

from appliance.llm.words import MAX_WORDS
from workshop.train.examples import Example
from workshop.train.lexicon import Lexicon
from workshop.train.tokens import PAD, Tokens
from workshop.train.vary import vary

CONTEXT = 1024
"""Tokens of a prompt and its answer; longer examples are left out of a batch."""
IGNORED = -100
GROUP = 16
"""Batches of a group, about."""
SHIFTED = 0.25
"""Share of examples whose words are not numbered from 0."""
ONCE = 0.05
"""Share of examples that are read once where the others are read twice: as one is that has no room for more."""

Batch = tuple[Tensor, Tensor]
"""Tokens and, in the same place, labels: those of the answers, IGNORED everywhere else."""


class Groups(Dataset[list[Batch]]):
    """Groups of batches by number.

    Args:
        examples: what is varied.
        tokens: of the run.
        seed: of all that is random.
        batch_tokens: of a batch at most, padding counted.
        original: share of examples as they were written, without variation.
        twice: whether instructions are read twice.
    """

    def __init__(
        self,
        examples: Sequence[Example],
        tokens: Tokens,
        *,
        seed: int,
        batch_tokens: int,
        original: float,
        twice: bool = False,
    ) -> None:
        self._examples = examples
        self._tokens = tokens
        self._seed = seed
        self._batch_tokens = batch_tokens
        self._original = original
        self._twice = twice
        self._lexicon = Lexicon(examples)

    def __getitem__(self, number: int) -> list[Batch]:
        rng = random.Random(f"{self._seed} {number}")  # noqa: S311 - a batch to repeat, not a secret
        rows: list[tuple[list[int], list[int]]] = []
        total = 0
        while total < GROUP * self._batch_tokens:
            example = rng.choice(self._examples)
            if rng.random() >= self._original:
                example = vary(example, self._examples, self._lexicon, rng)
            # Words are numbered from 0 when it answers; from anywhere now and then, so that high numbers are learnt.
            shift = rng.randrange(MAX_WORDS + 1 - len(example.words)) if rng.random() < SHIFTED else 0
            twice = self._twice and rng.random() >= ONCE
            row = self._tokens.example(example, shift=shift, twice=twice)
            if (length := len(row[0]) + len(row[1])) <= min(CONTEXT, self._batch_tokens):
                rows.append(row)
                total += length
        rows.sort(key=lambda row: len(row[0]) + len(row[1]))
        batches: list[Batch] = []
        chosen: list[tuple[list[int], list[int]]] = []
        for row in rows:
            if (len(row[0]) + len(row[1])) * (len(chosen) + 1) > self._batch_tokens:
                batches.append(self._laid_out(chosen))
                chosen = []
            chosen.append(row)
        batches.append(self._laid_out(chosen))
        rng.shuffle(batches)
        return batches

    def _laid_out(self, rows: Sequence[tuple[list[int], list[int]]]) -> Batch:
        longest = max(len(prompt) + len(answer) for prompt, answer in rows)
        inputs = torch.full((len(rows), longest), self._tokens.of(PAD))
        labels = torch.full((len(rows), longest), IGNORED)
        for at, (prompt, answer) in enumerate(rows):
            whole = len(prompt) + len(answer)
            inputs[at, :whole] = torch.tensor(prompt + answer)
            labels[at, len(prompt) : whole] = torch.tensor(answer)
        return inputs, labels
