"""Writes what a model folder has beside the library's own files: `planner.json`, the model card, and the hashes.

`outside_release` keeps training out of the folder of the planner that comes with the program.
"""

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from appliance.errors import ConflictError
from appliance.llm.decoder import CARD, Card
from appliance.llm.settings import EMBEDDED_FOLDER
from appliance.llm.words import MAX_WORDS
from appliance.skills.catalogue import Catalogue
from workshop.train.tokens import BEGIN, END, LITERAL, PLAN, ROSTER, Tokens, symbols_of


def card_of(
    tokens: Tokens, catalogue: Catalogue, *, calibration: tuple[float, float] = (1.0, 0.0), twice: bool = False
) -> Card:
    """Return the card of a tokenizer, and of a model that reads instructions twice or once."""
    found = {each: tokens.of(each) for each in (BEGIN, END, ROSTER, PLAN, LITERAL)}
    found |= {f"w{number}": tokens.of(f"<w{number}>") for number in range(MAX_WORDS)}
    found |= {symbol: tokens.of(f"<{symbol}>") for symbol in symbols_of(catalogue)}
    return Card(language=1, tokens=found, calibration=calibration, twice=twice)


def write_card(folder: Path, card: Card) -> None:
    """Write the card into a model folder."""
    (folder / CARD).write_bytes(msgspec.json.format(msgspec.json.encode(card), indent=1))


SUMS = "SHA256SUMS"


def write_sums(folder: Path) -> None:
    """Write the hash of every file of a model folder but the card for people, as `sha256sum --check` reads them."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.name not in {SUMS, "README.md"})
    lines = [f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.relative_to(folder)}\n" for path in files]
    (folder / SUMS).write_text("".join(lines))


def outside_release(folder: Path) -> None:
    """Refuse a folder that is the embedded planner's or within it.

    Raises:
        ConflictError: it is.
    """
    if folder.resolve().is_relative_to(EMBEDDED_FOLDER.resolve()):
        raise ConflictError(
            f"{folder} is the planner that comes with the program", remedy="give another folder, or --release"
        )


FIGURES = ("decomposition", "parallel_recall", "subtask_f1", "param_f1", "exact", "domain", "refused")


def model_card(
    precision: str, recipe: Mapping[str, Any], figures: Mapping[str, Any], made: Mapping[str, Any], *, cases: int
) -> str:
    """Return the model card of a folder, as Markdown.

    Args:
        precision: of the weights.
        recipe: how it was trained.
        figures: on what was held out, by split, as training told them at its end; before the weights were rounded.
        made: `megabytes`, `calibration`, `reliability`, `beside`.
        cases: held-out pairs that the confidence was calibrated on.
    """
    splits: dict[str, Mapping[str, Any]] = {name: each for name, each in figures.items() if isinstance(each, Mapping)}
    rows = [
        f"| {name} | {' | '.join(_cell(each.get(key)) for key in ('cases', *FIGURES))} |"
        for name, each in splits.items()
    ]
    curve: Sequence[Mapping[str, float]] = made["reliability"]
    bins = [f"| {each['confidence']:.2f} | {each['exact']:.2f} | {each['cases']} |" for each in curve]
    off = sum(abs(each["confidence"] - each["exact"]) * each["cases"] for each in curve) / max(
        1, sum(each["cases"] for each in curve)
    )
    settings = ", ".join(f"{name} {value}" for name, value in recipe.items())
    return "\n".join(
        [
            "# Planner",
            "",
            "Turns an English instruction for a robot fleet into a plan, in the plan language of this project. Trained",
            f"from scratch; {precision} weights, {made['megabytes']} MB.",
            "",
            "- **Licence**: Apache-2.0, like the program.",
            "- **Data**: the hand-written pairs of `workshop/corpus`, varied while training, and in a tuned one",
            "  a site's own. Neither the development cases nor any other test data.",
            f"- **Training**: {figures.get('step', '?')} steps; {settings}.",
            "- **Second opinion** (`evidence.bin`): a linear classifier of the skills that words speak for, trained on",
            "  the same pairs; it has a say in which of several answers is given.",
            *(
                [
                    f"- **Asked together**: this model and those in {', '.join(made['beside'])}, trained like it;",
                    "  an answer is as likely as all together find it.",
                ]
                if made.get("beside")
                else []
            ),
            "- **Limits**: English only; 256 words with the robots that they name; names only as they are said; no",
            "  task that has begun is continued. What it plans is checked by the validator and the safety policy.",
            "",
            "## Held-out pairs",
            "",
            "Percent, greedy and without the guide, before the weights were rounded. `structure`: plans of a shape",
            "that was trained nowhere; `vocabulary`: names that were trained nowhere; `chance`: any.",
            "",
            f"| split | cases | {' | '.join(FIGURES)} |",
            f"|{' --- |' * (2 + len(FIGURES))}",
            *rows,
            "",
            "## Reliability",
            "",
            f"The confidence is calibrated on half of {cases} held-out pairs, as the exported model answers them, and",
            f"shown on the other half: of those it is so sure of, so many are exact. Mean distance: {off:.3f}.",
            "",
            "| confidence | exact | cases |",
            "| --- | --- | --- |",
            *bins,
            "",
        ]
    )


def _cell(value: Any) -> str:
    return "–" if value is None else str(value)
