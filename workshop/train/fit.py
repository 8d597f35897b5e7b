# pyright: basic, reportMissingImports=false
# PyTorch is of the extra `train`, which neither gateways nor the development environment have.
"""Trains the embedded planner: a small Llama-architecture model on variations of the hand-written pairs.

Every batch follows from the seed and its number, so a run that is stopped goes on from its last checkpoint as if it had
not been, on a processor or on a GPU, and with any number of workers. The loss counts the answer only.

The rate is constant and goes down to nothing at the end (`cooldown`). Before it does, the state is kept as `trunk.pt`:
a run that is done goes on from there when it is given more steps, with more pairs if the corpus has grown.

    python -m workshop.train.fit FOLDER --steps 8000

A run may begin with the weights of another, or of a model folder (`--base`): what was learned is kept, and the corpus
as it is now is learned besides.
"""

import argparse
import json
import math
import random
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset
from transformers import LlamaForCausalLM

from appliance.errors import ConflictError
from appliance.llm.words import MAX_WORDS
from appliance.skills.catalogue import Catalogue, load_catalogue
from workshop.train.ending import Stopping, ended, replace_text, writing
from workshop.train.examples import Example
from workshop.train.forward import AnswerLoss
from workshop.train.judge import judge
from workshop.train.lexicon import Lexicon
from workshop.train.model import CHECKPOINT, RECIPE, Base, Recipe, new_model
from workshop.train.site import Pairs
from workshop.train.splits import corpus_examples, split
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


TRUNK = "trunk.pt"


def cools_at(recipe: Recipe) -> int:
    """Return the step from which the rate goes down."""
    return recipe.steps - round(recipe.cooldown * recipe.steps)


def rate_at(step: int, recipe: Recipe) -> float:
    """Return the learning rate of a step: up in a line, constant, and down in a line at the end."""
    up = min(1.0, (step + 1) / max(1, recipe.warmup))
    down = min(1.0, (recipe.steps - step) / max(1, recipe.steps - cools_at(recipe)))
    return recipe.rate * min(up, max(0.0, down))


def optimisers_of(model: LlamaForCausalLM, recipe: Recipe) -> list[torch.optim.Optimizer]:
    """Return Muon for the matrices of the layers, which it learns in fewer steps, and AdamW for the rest."""
    matrices = [each for each in model.model.layers.parameters() if each.dim() == 2]
    inside = {id(each) for each in matrices}
    others = [each for each in model.parameters() if id(each) not in inside]
    return [
        torch.optim.Muon(matrices, lr=recipe.rate, weight_decay=recipe.decay, adjust_lr_fn="match_rms_adamw"),
        torch.optim.AdamW(others, lr=recipe.rate, betas=(0.9, 0.98), weight_decay=0.0, fused=True),
    ]


class Trainer:
    """One run; `folder` holds its tokenizer, recipe, checkpoints and log."""

    def __init__(
        self,
        folder: Path,
        recipe: Recipe,
        *,
        workers: int = 1,
        progress: Callable[[str], None] = print,
        catalogue: Catalogue | None = None,
        site: Pairs | None = None,
        share: float = 0.5,
        compiled: bool = False,
    ) -> None:
        """Go on with the run in `folder`, or begin one there.

        Args:
            folder: of the run.
            recipe: how, where the folder has none yet.
            workers: processes that make batches.
            progress: told how far it is.
            catalogue: the skills there are; the built-in ones by default.
            site: pairs of a site to train on besides (`tune`).
            share: of a batch that they have.
            compiled: whether the layers are compiled first (a C++ compiler is needed).
        """
        self._folder = folder
        self._progress = progress
        self._workers = workers
        with writing(f"{folder}", remedy="name a folder that can be written"):
            folder.mkdir(parents=True, exist_ok=True)
        self._catalogue = catalogue or load_catalogue()
        self._splits = split(corpus_examples(self._catalogue))
        self._held_out = {name: getattr(self._splits, name) for name in ("structure", "vocabulary", "chance")}
        self._examples: Sequence[Example] = self._splits.train
        if site is not None:
            self._held_out["site"] = site.held_out
            times = max(1, round(share / (1 - share) * len(self._examples) / max(1, len(site.train))))
            self._examples = (*self._examples, *(each for each in site.train for _ in range(times)))
        kept = folder / RECIPE
        if kept.is_file():
            recipe = replace(Recipe(**json.loads(kept.read_text())), steps=recipe.steps)
            self._tokens = Tokens.load(folder)
        else:
            words = [word for example in self._splits.train for word in example.words]
            self._tokens = Tokens.learn(words, self._catalogue)
            with writing(f"{folder}", remedy="make room and run it again"):
                self._tokens.save(folder)
        replace_text(kept, json.dumps(asdict(recipe), indent=1))
        self.recipe = recipe
        self._device = "cuda" if torch.cuda.is_available() else "cpu"
        self._model: Any = new_model(recipe, self._tokens).to(self._device)
        self._loss = AnswerLoss(self._model, compiled=compiled)
        self._optimisers = optimisers_of(self._model, recipe)
        self._step = 0
        self._group, self._inside = 0, 0  # the next group of batches, and how many of it were taken
        self._resume()

    def _resume(self) -> None:
        for name in (CHECKPOINT, TRUNK):
            path = self._folder / name
            if not path.is_file():
                continue
            state = torch.load(path, map_location=self._device, weights_only=True)
            if name == CHECKPOINT and state["cooling"] and state["steps"] != self.recipe.steps:
                continue  # its rate had begun to go down for an end that is not this one
            self._model.load_state_dict(state["model"])
            for optimiser, kept in zip(self._optimisers, state["optimisers"], strict=False):
                optimiser.load_state_dict(kept)
            self._step, self._group, self._inside = int(state["step"]), int(state["group"]), int(state["inside"])
            self._progress(f"goes on from step {self._step:,} of {name}")
            return
        if (self._folder / CHECKPOINT).is_file():
            raise ConflictError(
                f"{self._folder} has gone down for another number of steps, and has no {TRUNK} to go on from",
                remedy="give the steps it was begun with, or begin another run with this one as --base",
            )

    def save(self) -> None:
        """Write the checkpoint and the model; a run that dies while it does keeps the one before."""
        state = {
            "model": self._model.state_dict(),
            "optimisers": [each.state_dict() for each in self._optimisers],
            "step": self._step,
            "group": self._group,
            "inside": self._inside,
            "steps": self.recipe.steps,
            "cooling": self._step > cools_at(self.recipe),
        }
        new = self._folder / "checkpoint.new"
        with writing(
            f"{self._folder} at step {self._step:,}",
            remedy="make room and run it again: it goes on from the checkpoint before",
            unfinished=(new,),
        ):
            torch.save(state, new)
            new.replace(self._folder / CHECKPOINT)
            self._model.save_pretrained(self._folder / "model")

    def run(self, *, minutes: float = math.inf, look_every: int = 500) -> dict[str, Any]:
        """Train until the recipe's steps are done or the time is over; return the last figures."""
        stopping = Stopping()
        with stopping:
            figures = self._run(minutes, look_every, stopping)
        if stopping.asked:
            self._progress(f"stopped after step {self._step:,}; run it again to go on")
            raise KeyboardInterrupt
        return figures

    def _run(self, minutes: float, look_every: int, stopping: Stopping) -> dict[str, Any]:
        until = time.monotonic() + 60 * minutes
        parameters = sum(each.numel() for each in self._model.parameters())
        self._progress(f"{parameters / 1e6:.1f} M parameters, {len(self._examples):,} pairs, on {self._device}")
        self._model.train()
        began, seen, shown = time.monotonic(), 0, 0.0
        losses: list[float] = []
        for inputs, labels in self._batches():
            if not losses:
                self._compare(inputs[:4], labels[:4])
            if self._step == cools_at(self.recipe):
                self.save()
                trunk = self._folder / TRUNK
                with writing(f"{trunk}", remedy="make room and run it again", unfinished=(trunk,)):
                    shutil.copyfile(self._folder / CHECKPOINT, trunk)
            losses.append(self._learn(inputs, labels))
            del losses[:-200]
            seen += inputs.numel()
            now = time.monotonic()
            if now - shown > 15:
                self._progress(
                    f"step {self._step:,} of {self.recipe.steps:,}: loss {sum(losses) / len(losses):.4f}, "
                    f"{seen / (now - began):,.0f} tokens/s"
                )
                shown = now
            if self._step % look_every == 0:
                self.save()
                self._look(200)
            if now > until or stopping.asked:
                break
        self.save()
        if stopping.asked:
            return {}
        figures = self._look(100_000)
        replace_text(self._folder / "figures.json", json.dumps(figures, indent=1))
        return figures

    def _compare(self, inputs: torch.Tensor, labels: torch.Tensor) -> None:
        """Make sure that what is trained is what will be run: the library's pass gives the same loss, rounded."""
        inputs, labels = inputs.to(self._device), labels.to(self._device)
        with torch.no_grad():
            ours = float(self._loss(inputs, labels))
            theirs = float(self._model(input_ids=inputs, labels=labels, use_cache=False).loss)
        if not abs(ours - theirs) <= 0.02 * theirs + 0.01:
            raise RuntimeError(f"the training pass gives a loss of {ours:.4f} where the library's gives {theirs:.4f}")

    def _learn(self, inputs: torch.Tensor, labels: torch.Tensor) -> float:
        rate = rate_at(self._step, self.recipe)
        # What is left out follows from the step, too: a run that goes on is the run that was not stopped.
        torch.manual_seed(self.recipe.seed * 1_000_003 + self._step)
        loss = self._loss(inputs.to(self._device), labels.to(self._device), dropout=self.recipe.dropout)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self._model.parameters(), 1.0)
        for optimiser in self._optimisers:
            for group in optimiser.param_groups:
                group["lr"] = rate
            optimiser.step()
            optimiser.zero_grad(set_to_none=True)
        self._step += 1
        self._inside += 1
        return float(loss.detach())

    def _batches(self) -> Iterator[Batch]:
        """Return the batches that are left, in order; where it is in them is kept."""
        recipe = self.recipe
        groups = Groups(
            self._examples,
            self._tokens,
            seed=recipe.seed,
            batch_tokens=recipe.batch_tokens,
            original=recipe.original,
            twice=recipe.twice,
        )
        # No group has fewer than one batch: there are always enough.
        order = range(self._group, self._group + recipe.steps + 1)
        ahead = 2 if self._workers else None
        loader: DataLoader[list[Batch]] = DataLoader(
            groups, batch_size=None, sampler=order, num_workers=self._workers, prefetch_factor=ahead
        )
        for batches in loader:
            for batch in batches[self._inside :]:
                if self._step >= recipe.steps:
                    return
                yield batch
            self._group, self._inside = self._group + 1, 0

    def look(self, most: int = 200) -> dict[str, Any]:
        """Return figures on what is held out, before anything is trained."""
        return self._look(most)

    def _look(self, most: int) -> dict[str, Any]:
        """Tell how the model does on what is held out."""
        self._model.eval()
        figures: dict[str, Any] = {"step": self._step}
        for name, examples in self._held_out.items():
            figures[name] = judge(self._model, self._tokens, examples[:most], self._catalogue, twice=self.recipe.twice)
            self._progress(f"  {name}: {figures[name]}")
        self._model.train()
        with (
            writing(f"{self._folder}/log.jsonl", remedy="make room and run it again"),
            (self._folder / "log.jsonl").open("a") as log,
        ):
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
    parser.add_argument(
        "--compile", action="store_true", help="compile the layers first: a minute, and a C++ compiler is needed"
    )
    for each in fields(Recipe):
        kind = type(each.default)
        flag, told = f"--{each.name.replace('_', '-')}", f"by default {each.default}"
        if kind is bool:
            parser.add_argument(flag, action=argparse.BooleanOptionalAction, default=None, help=told)
        else:
            parser.add_argument(flag, type=kind, help=told)
    parser.add_argument(
        "--base", help="a run, a model folder or `embedded`: begin with its weights, and as large (not to go on)"
    )
    given = parser.parse_args(arguments)
    if given.threads:
        torch.set_num_threads(given.threads)
    said = {each.name: value for each in fields(Recipe) if (value := getattr(given, each.name)) is not None}
    kept = given.folder / RECIPE
    base = Base(given.base) if given.base and not kept.is_file() else None
    recipe = Recipe(**json.loads(kept.read_text())) if kept.is_file() else base.recipe if base else Recipe()
    other = {name for name, value in said.items() if getattr(recipe, name) != value} - {"steps"}
    if kept.is_file() and other:
        parser.error(f"{given.folder} was begun with other {', '.join(sorted(other))}: begin another run")
    if base is not None:
        base.prepare(given.folder, load_catalogue(), replace(recipe, **said))
    trainer = Trainer(
        given.folder,
        replace(recipe, **said),
        workers=given.workers,
        progress=lambda text: print(text, flush=True),
        compiled=given.compile,
    )
    print(json.dumps(trainer.run(minutes=given.minutes, look_every=given.look_every), indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(ended(main))
