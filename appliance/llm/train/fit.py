# pyright: basic, reportMissingImports=false
# PyTorch is of the extra `train`, which neither gateways nor the development environment have.
"""Trains the embedded planner: a small Llama-architecture model on variations of the hand-written pairs.

Every batch follows from the seed and its number, so a run that is stopped goes on from its last checkpoint as if it had
not been, on a processor or on a GPU, and with any number of workers. The loss counts the answer only.

    python -m appliance.llm.train.fit FOLDER --minutes 60
"""

import argparse
import json
import math
import random
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch.utils.data import DataLoader, Dataset
from transformers import LlamaConfig, LlamaForCausalLM

from appliance.llm.language.words import MAX_WORDS
from appliance.llm.train.corpus import corpus_examples
from appliance.llm.train.examples import Example
from appliance.llm.train.judge import judge
from appliance.llm.train.lexicon import Lexicon
from appliance.llm.train.splits import split
from appliance.llm.train.tokens import BEGIN, END, PAD, Tokens
from appliance.llm.train.vary import vary
from appliance.skills.catalogue import load_catalogue

CONTEXT = 1024
"""Tokens of a prompt and its answer; longer examples are left out of a batch."""
IGNORED = -100


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """How a model is made; kept beside it."""

    seed: int = 1
    width: int = 256
    layers: int = 6
    heads: int = 4
    key_heads: int = 2
    inner: int = 704
    batch_tokens: int = 8192
    steps: int = 20_000
    rate: float = 1.5e-3
    warmup: int = 300
    decay: float = 0.05
    dropout: float = 0.0
    original: float = 0.1
    """Share of examples as they were written, without variation."""


class Batches(Dataset[dict[str, Any]]):
    """Batches by number: which examples, how varied and how laid out follows from seed and number alone."""

    def __init__(self, examples: Sequence[Example], tokens: Tokens, recipe: Recipe) -> None:
        self._examples = examples
        self._tokens = tokens
        self._recipe = recipe
        self._lexicon = Lexicon(examples)

    def __len__(self) -> int:
        return self._recipe.steps

    def __getitem__(self, number: int) -> dict[str, Any]:
        rng = random.Random(f"{self._recipe.seed} {number}")  # noqa: S311 - a batch to repeat, not a secret
        rows: list[tuple[list[int], list[int]]] = []
        longest = 0
        while True:
            example = rng.choice(self._examples)
            if rng.random() >= self._recipe.original:
                example = vary(example, self._examples, self._lexicon, rng)
            row = self._tokens.example(example, shift=rng.randrange(MAX_WORDS + 1 - len(example.words)))
            length = len(row[0]) + len(row[1])
            if length > CONTEXT:
                continue
            if max(longest, length) * (len(rows) + 1) > self._recipe.batch_tokens and rows:
                break
            rows.append(row)
            longest = max(longest, length)
        inputs = torch.full((len(rows), longest), self._tokens.of(PAD))
        labels = torch.full((len(rows), longest), IGNORED)
        for at, (prompt, answer) in enumerate(rows):
            whole = len(prompt) + len(answer)
            inputs[at, :whole] = torch.tensor(prompt + answer)
            labels[at, len(prompt) : whole] = torch.tensor(answer)
        return {"input_ids": inputs, "labels": labels}


def new_model(recipe: Recipe, tokens: Tokens) -> LlamaForCausalLM:
    """Return a model with random weights."""
    torch.manual_seed(recipe.seed)
    config = LlamaConfig(
        vocab_size=tokens.size,
        hidden_size=recipe.width,
        intermediate_size=recipe.inner,
        num_hidden_layers=recipe.layers,
        num_attention_heads=recipe.heads,
        num_key_value_heads=recipe.key_heads,
        max_position_embeddings=CONTEXT,
        tie_word_embeddings=True,
        rms_norm_eps=1e-5,
        attention_dropout=recipe.dropout,
        bos_token_id=tokens.of(BEGIN),
        eos_token_id=tokens.of(END),
        pad_token_id=tokens.of(PAD),
    )
    return LlamaForCausalLM(config)


def rate_at(step: int, recipe: Recipe) -> float:
    """Return the learning rate of a step: up in a line, down along a cosine to a fiftieth."""
    if step < recipe.warmup:
        return recipe.rate * (step + 1) / recipe.warmup
    part = min(1.0, (step - recipe.warmup) / max(1, recipe.steps - recipe.warmup))
    return recipe.rate * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * part)))


class Trainer:
    """One run; `folder` holds its tokenizer, recipe, checkpoints and log."""

    def __init__(
        self, folder: Path, recipe: Recipe, *, workers: int = 1, progress: Callable[[str], None] = print
    ) -> None:
        self._folder = folder
        self._progress = progress
        self._workers = workers
        folder.mkdir(parents=True, exist_ok=True)
        self._catalogue = load_catalogue()
        self._splits = split(corpus_examples(self._catalogue))
        kept = folder / "recipe.json"
        if kept.is_file():
            recipe = Recipe(**json.loads(kept.read_text()))
            self._tokens = Tokens.load(folder)
        else:
            words = [word for example in self._splits.train for word in example.words]
            self._tokens = Tokens.learn(words, self._catalogue)
            self._tokens.save(folder)
            kept.write_text(json.dumps(asdict(recipe), indent=1))
        self.recipe = recipe
        self._device = "cuda" if torch.cuda.is_available() else "cpu"
        self._model: Any = new_model(recipe, self._tokens).to(self._device)
        decayed = [each for each in self._model.parameters() if each.dim() > 1]
        plain = [each for each in self._model.parameters() if each.dim() <= 1]
        groups = [{"params": decayed, "weight_decay": recipe.decay}, {"params": plain, "weight_decay": 0.0}]
        self._optimiser = torch.optim.AdamW(groups, lr=recipe.rate, betas=(0.9, 0.98), fused=True)
        self._step = 0
        self._resume()

    def _resume(self) -> None:
        path = self._folder / "checkpoint.pt"
        if path.is_file():
            state = torch.load(path, map_location=self._device, weights_only=True)
            self._model.load_state_dict(state["model"])
            self._optimiser.load_state_dict(state["optimiser"])
            self._step = int(state["step"])
            self._progress(f"goes on from step {self._step:,}")

    def save(self) -> None:
        """Write the checkpoint and the model; a run that dies while it does keeps the one before."""
        state = {"model": self._model.state_dict(), "optimiser": self._optimiser.state_dict(), "step": self._step}
        torch.save(state, self._folder / "checkpoint.new")
        (self._folder / "checkpoint.new").replace(self._folder / "checkpoint.pt")
        self._model.save_pretrained(self._folder / "model")

    def run(self, *, minutes: float = math.inf, look_every: int = 500) -> dict[str, Any]:
        """Train until the recipe's steps are done or the time is over; return the last figures."""
        until = time.monotonic() + 60 * minutes
        parameters = sum(each.numel() for each in self._model.parameters())
        self._progress(f"{parameters / 1e6:.1f} M parameters, {len(self._splits.train):,} pairs, on {self._device}")
        batches = Batches(self._splits.train, self._tokens, self.recipe)
        order = range(self._step, self.recipe.steps)
        loader = DataLoader(
            batches,
            batch_size=None,
            sampler=order,
            num_workers=self._workers,
            prefetch_factor=8 if self._workers else None,
        )
        self._model.train()
        began, seen, shown = time.monotonic(), 0, 0.0
        losses: list[float] = []
        for batch in self._moved(loader):
            for group in self._optimiser.param_groups:
                group["lr"] = rate_at(self._step, self.recipe)
            with torch.autocast(self._device, dtype=torch.bfloat16):
                loss = self._model(**batch, use_cache=False).loss
            loss.backward()
            torch.nn.utils.clip_grad_norm_(self._model.parameters(), 1.0)
            self._optimiser.step()
            self._optimiser.zero_grad(set_to_none=True)
            self._step += 1
            losses.append(float(loss.detach()) if self._step % 10 == 0 else 0.0)
            seen += batch["input_ids"].numel()
            now = time.monotonic()
            if now - shown > 15:
                recent = [each for each in losses[-200:] if each]
                mean = sum(recent) / len(recent) if recent else float("nan")
                self._progress(
                    f"step {self._step:,} of {self.recipe.steps:,}: "
                    f"loss {mean:.4f}, {seen / (now - began):,.0f} tokens/s"
                )
                shown = now
            if self._step % look_every == 0:
                self.save()
                self._look(200)
            if now > until:
                break
        self.save()
        figures = self._look(100_000)
        (self._folder / "figures.json").write_text(json.dumps(figures, indent=1))
        return figures

    def _moved(self, loader: "DataLoader[dict[str, Any]]") -> Iterator[dict[str, Any]]:
        for batch in loader:
            yield {name: each.to(self._device, non_blocking=True) for name, each in batch.items()}

    def _look(self, most: int) -> dict[str, Any]:
        """Tell how the model does on what is held out."""
        self._model.eval()
        figures: dict[str, Any] = {"step": self._step}
        for name in ("structure", "vocabulary", "chance"):
            examples = getattr(self._splits, name)[:most]
            figures[name] = judge(self._model, self._tokens, examples, self._catalogue)
            self._progress(f"  {name}: {figures[name]}")
        self._model.train()
        with (self._folder / "log.jsonl").open("a") as log:
            log.write(json.dumps(figures) + "\n")
        return figures


def main(arguments: Sequence[str]) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description="Train the embedded planner; run it again to go on.")
    parser.add_argument("folder", type=Path, help="where the run is kept")
    parser.add_argument("--minutes", type=float, default=math.inf, help="stop after so many minutes")
    parser.add_argument("--threads", type=int, default=0, help="of the processor; 0 for all")
    parser.add_argument("--workers", type=int, default=1, help="processes that make batches")
    parser.add_argument(
        "--look-every", type=int, default=500, metavar="STEPS", help="how often held-out figures are taken"
    )
    for name, kind in Recipe.__annotations__.items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=kind, default=getattr(Recipe, name))
    given = parser.parse_args(arguments)
    if given.threads:
        torch.set_num_threads(given.threads)
    recipe = Recipe(**{name: getattr(given, name) for name in Recipe.__annotations__})
    trainer = Trainer(given.folder, recipe, workers=given.workers, progress=lambda text: print(text, flush=True))
    print(json.dumps(trainer.run(minutes=given.minutes, look_every=given.look_every), indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
