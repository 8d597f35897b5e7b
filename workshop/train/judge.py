# pyright: basic, reportMissingImports=false
# PyTorch is of the extra `train`, which neither gateways nor the development environment have.
"""How well a model answers examples, as the scorer counts it.

It answers greedily and held by nothing: what the guide adds (`language.Guide`) is seen by the benchmark of plans.
"""

from collections.abc import Sequence
from typing import Any

import torch

from appliance.errors import PlanError
from appliance.llm.language import Answer, read
from appliance.llm.words import Words, words_of
from appliance.skills.catalogue import Catalogue
from workshop.scoring import Score, mean_figures, score
from workshop.train.examples import Example
from workshop.train.tokens import END, PAD, Tokens

MAX_ANSWER = 320


def answers(model: Any, tokens: Tokens, prompts: Sequence[list[int]], *, batch: int = 64) -> list[list[int]]:
    """Return the tokens a model answers to prompts, the likeliest each time."""
    order = sorted(range(len(prompts)), key=lambda number: len(prompts[number]))
    found: list[list[int]] = [[] for _ in prompts]
    pad, device = tokens.of(PAD), next(model.parameters()).device
    for begin in range(0, len(order), batch):
        chosen = order[begin : begin + batch]
        longest = max(len(prompts[number]) for number in chosen)
        inputs = torch.full((len(chosen), longest), pad)
        mask = torch.zeros((len(chosen), longest), dtype=torch.long)
        for row, number in enumerate(chosen):
            inputs[row, longest - len(prompts[number]) :] = torch.tensor(prompts[number])
            mask[row, longest - len(prompts[number]) :] = 1
        with torch.inference_mode(), torch.autocast(device.type, dtype=torch.bfloat16):
            out = model.generate(
                input_ids=inputs.to(device),
                attention_mask=mask.to(device),
                max_new_tokens=MAX_ANSWER,
                do_sample=False,
                eos_token_id=tokens.of(END),
                pad_token_id=pad,
            )
        for row, number in enumerate(chosen):
            found[number] = out[row, longest:].tolist()
    return found


def judge(
    model: Any, tokens: Tokens, examples: Sequence[Example], catalogue: Catalogue, *, twice: bool = False
) -> dict[str, Any]:
    """Return percent by figure over examples, refusals counted apart (`refused`: answered alike)."""
    rows: list[Score] = []
    refused: list[bool] = []
    said = answers(model, tokens, [tokens.prompt(each.words, each.own, twice=twice) for each in examples])
    for example, answer in zip(examples, said, strict=True):
        words = words_of(" ".join(example.words[: example.own]), example.words[example.own :])
        symbols = tokens.symbols(answer)
        if example.symbols[0] == "none":
            refused.append(symbols[:1] == ["none"])
            continue
        gold = read(example.symbols, words, catalogue)
        rows.append(score(_prediction(symbols, words, catalogue), _plain(gold)))
    figures = mean_figures(rows)
    figures["refused"] = round(100 * sum(refused) / len(refused), 1) if refused else None
    return figures


def _prediction(symbols: Sequence[str], words: Words, catalogue: Catalogue) -> dict[str, Any]:
    try:
        return _plain(read(symbols, words, catalogue))
    except PlanError:
        return {}


def _plain(answer: Answer) -> dict[str, Any]:
    subtasks = [
        {"id": each.id, "skill": each.skill, "robot": each.robot, "params": each.params, "after": list(each.after)}
        for each in answer.subtasks
    ]
    return {"domain": answer.domain, "subtasks": subtasks}


def is_exact(said: Answer, gold: Answer) -> bool:
    """Whether an answer is the right one, by the scorer; a refusal is right whatever its kind."""
    if said.refused or gold.refused:
        return bool(said.refused) == bool(gold.refused)
    return score(_plain(said), _plain(gold)).exact == 1
