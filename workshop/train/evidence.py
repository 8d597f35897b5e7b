# pyright: basic, reportMissingImports=false
# PyTorch is of the extra `train`, which neither gateways nor the development environment have.
"""Trains the second opinion on answers (`decoder.Evidence`) and writes it into a model folder; `export` does so too.

    python -m workshop.train.evidence FOLDER

A logistic regression for each skill over the cues of the trained pairs, a quarter of the cues left out at random each
time, so that no single one is relied on; a few minutes on one core. What is held out of training is held out here.
"""

import argparse
import json
import random
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import torch
from torch.nn import functional

from appliance.llm.decoder import Evidence, cues, skills_of, write_evidence
from appliance.skills.catalogue import Catalogue, load_catalogue
from workshop.train.card import outside_release, write_sums
from workshop.train.ending import ended, writing
from workshop.train.examples import Example
from workshop.train.splits import corpus_examples, split

ROUNDS = 8
RATE = 0.02
BATCH = 256
LEFT_OUT = 0.25
"""Share of the cues that are not seen at a time. What is seen then is to do alone, so the whole says more."""
DECAY = 1e-4
"""Of the weights of the cues that a batch has."""
COMMON = 3
"""Pairs that must have a cue: rarer ones would be learned by heart."""
UNLIKELY = -4.0
"""Log-odds of a skill before anything is learned."""


def learn(examples: Sequence[Example], catalogue: Catalogue, *, seed: int = 1) -> Evidence:
    """Return the evidence of examples."""
    torch.manual_seed(seed)
    rng = random.Random(seed)  # noqa: S311 - which cues are left out, not secrets
    pairs = [each for each in examples if each.symbols[0] != "none"]
    said = [skills_of(each.symbols) for each in pairs]
    skills = sorted(frozenset(catalogue.skills) & frozenset().union(*said))
    all_cues = [cues(each.words[: each.own]) for each in pairs]
    counts = Counter(cue for each in all_cues for cue in set(each))
    numbers = {cue: number for number, cue in enumerate(cue for cue, count in counts.items() if count >= COMMON)}
    found = [[numbers[cue] for cue in each if cue in numbers] for each in all_cues]
    right = torch.tensor([[float(skill in each) for skill in skills] for each in said])
    table = torch.nn.EmbeddingBag(len(numbers), len(skills), mode="sum")
    torch.nn.init.zeros_(table.weight)
    bias = torch.nn.Parameter(torch.full((len(skills),), UNLIKELY))
    optimiser = torch.optim.Adam([*table.parameters(), bias], lr=RATE)
    for turn in range(ROUNDS):
        for group in optimiser.param_groups:
            group["lr"] = RATE * (1 - turn / ROUNDS)
        order = list(range(len(pairs)))
        rng.shuffle(order)
        for begin in range(0, len(order), BATCH):
            batch = order[begin : begin + BATCH]
            kept = [[cue for cue in found[one] if rng.random() > LEFT_OUT] for one in batch]
            rows = torch.tensor([cue for each in kept for cue in each])
            begins = torch.tensor([0, *(len(each) for each in kept[:-1])]).cumsum(0)
            logits = table(rows, begins) + bias
            loss = functional.binary_cross_entropy_with_logits(logits, right[batch], reduction="sum") / len(batch)
            loss = loss + DECAY * table.weight[rows.unique()].pow(2).sum()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
    weights = table.weight.detach()
    scale = max(1e-6, float(weights.abs().max())) / 127
    rounded = (weights / scale).round().to(torch.int8).numpy()
    return Evidence(
        skills=tuple(skills),
        bias=tuple(round(each, 4) for each in bias.detach().tolist()),
        scale=scale,
        rows={cue: rounded[number].tobytes() for cue, number in numbers.items()},
    )


def quality(evidence: Evidence, examples: Sequence[Example]) -> float:
    """Return how well it names the skills of examples: F1 of skill by skill, in percent."""
    hits = said = right = 0
    for example in examples:
        if example.symbols[0] != "none":
            odds = evidence.odds(example.words[: example.own])
            named, meant = frozenset(skill for skill, value in odds.items() if value > 0), skills_of(example.symbols)
            hits, said, right = hits + len(named & meant), said + len(named), right + len(meant)
    return round(100 * 2 * hits / max(1, said + right), 1)


def write(folder: Path, catalogue: Catalogue) -> dict[str, object]:
    """Train on the hand-written pairs and write into a folder; return figures on what is held out."""
    parts = split(corpus_examples(catalogue))
    evidence = learn(parts.train, catalogue)
    with writing(f"{folder}", remedy="make room and run it again"):
        write_evidence(folder, evidence)
        write_sums(folder)
    held_out = (*parts.structure, *parts.vocabulary, *parts.chance)
    return {"pairs": len(parts.train), "skills": len(evidence.skills), "held_out_f1": quality(evidence, held_out)}


def main(arguments: Sequence[str]) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description="Write the second opinion on answers into a model folder.")
    parser.add_argument("folder", type=Path, help="of the model")
    parser.add_argument("--release", action="store_true", help="the folder may be the embedded planner's")
    given = parser.parse_args(arguments)
    if not given.release:
        outside_release(given.folder)
    print(json.dumps(write(given.folder, load_catalogue())))
    return 0


if __name__ == "__main__":
    sys.exit(ended(main))
