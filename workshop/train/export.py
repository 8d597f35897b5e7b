# pyright: basic, reportMissingImports=false
# PyTorch is of the extra `train`, which neither gateways nor the development environment have.
"""Makes the folder for the local slot from a training run: the library's own builder, our tokenizer and card.

    python -m workshop.train.export RUN FOLDER --precision int4

The confidence is calibrated on the held-out pairs: a logistic of the log-odds of the whole answer, fitted so that of
the answers with confidence 0.9 nine in ten are exact. The reliability curve is printed, for the model card.
"""

import argparse
import json
import math
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from msgspec.structs import replace

from appliance.errors import ConflictError, NotFoundError
from appliance.llm.decoder import Card, Question, read_card, write_evidence
from appliance.llm.language import read, shapes
from appliance.llm.settings import folder_of
from appliance.llm.words import words_of
from appliance.llm.worker import Worker
from appliance.skills.catalogue import Catalogue
from workshop.train.card import card_of, model_card, outside_release, write_card, write_sums
from workshop.train.ending import ended
from workshop.train.evidence import learn
from workshop.train.examples import Example
from workshop.train.judge import is_exact
from workshop.train.splits import corpus_examples, split
from workshop.train.tokens import BEGIN, END, PAD, Tokens
from workshop.train.tune import catalogue_of

BINS = 10


BESIDE = ("second", "third", "fourth")
"""Folders, in that of a planner, of the models that are asked besides."""
_FILES = ("genai_config.json", "model.onnx", "model.onnx.data")
"""What a model besides has of its own: the tokenizer is the planner's."""
_TOKENIZER = "tokenizer.json"


def export(
    run: Path, folder: Path, *, precision: str = "int4", most: int = 0, beside: Sequence[Path] = ()
) -> dict[str, object]:
    """Write the model folder; return the reliability curve and how large it is.

    Args:
        run: folder of a training run.
        folder: where to; must not exist.
        precision: int4, int8 or fp32, as the builder knows them.
        most: held-out pairs to calibrate on, drawn evenly from all; 0: all of them.
        beside: folders of planners whose models are asked besides; they must have the same tokens.

    Raises:
        NotFoundError: there is no planner in one of `beside`.
        ConflictError: its tokens are others, or they are too many.
    """
    if len(beside) > len(BESIDE):
        raise ConflictError(f"{len(beside)} models besides", remedy=f"give at most {len(BESIDE)}")
    catalogue = catalogue_of(run)
    tokens = Tokens.load(run)
    with tempfile.TemporaryDirectory() as scratch:
        source = Path(scratch) / "source"
        shutil.copytree(run / "model", source)
        tokens.save(source)
        (source / "tokenizer_config.json").write_text(
            json.dumps(
                {
                    "tokenizer_class": "PreTrainedTokenizerFast",
                    "bos_token": BEGIN,
                    "eos_token": END,
                    "pad_token": PAD,
                    "add_bos_token": False,
                    "clean_up_tokenization_spaces": False,
                }
            )
        )
        options = ["int4_accuracy_level=4", "int4_block_size=32"] if precision == "int4" else []
        command = [sys.executable, "-m", "onnxruntime_genai.models.builder", "-i", str(source), "-o", str(folder)]
        command += ["-p", precision, "-e", "cpu", "-c", f"{scratch}/cache"]
        subprocess.run([*command, *(["--extra_options", *options] if options else [])], check=True)
    recipe = json.loads((run / "recipe.json").read_text())
    twice = bool(recipe.get("twice"))
    card = card_of(tokens, catalogue, twice=twice)
    for name, other in zip(BESIDE, beside, strict=False):
        _put_beside(folder, name, other, card)
        card = replace(card, beside=(*card.beside, name))
    write_card(folder, card)
    parts = split(corpus_examples(catalogue))
    write_evidence(folder, learn(parts.train, catalogue))
    held_out = [*parts.structure, *parts.vocabulary, *parts.chance]
    held_out = held_out[:: max(1, len(held_out) // most)] if most else held_out
    slope, offset, curve = calibrate(folder, held_out, catalogue)
    write_card(folder, replace(card, calibration=(slope, offset)))
    size = sum(each.stat().st_size for each in folder.rglob("*") if each.is_file())
    kept = run / "figures.json"
    figures = json.loads(kept.read_text()) if kept.is_file() else {}
    made = {
        "megabytes": round(size / 1e6, 1),
        "calibration": [slope, offset],
        "reliability": curve,
        "beside": list(card.beside),
    }
    (folder / "README.md").write_text(model_card(precision, recipe, figures, made, cases=len(held_out)))
    write_sums(folder)
    return made


def _put_beside(folder: Path, inside: str, beside: Path, card: Card) -> None:
    """Copy the model of another planner into a planner's folder."""
    other = read_card(beside)
    if other is None:
        raise NotFoundError(f"{beside} is no planner", remedy="give a folder that `swiftbot train export` made")
    if other.tokens != card.tokens or (beside / _TOKENIZER).read_bytes() != (folder / _TOKENIZER).read_bytes():
        raise ConflictError(
            f"{beside} has other tokens than {folder}", remedy="give a planner of a run that began with the same one"
        )
    (folder / inside).mkdir()
    for name in _FILES:
        shutil.copyfile(beside / name, folder / inside / name)
    write_card(folder / inside, replace(other, beside=()))


def calibrate(
    folder: Path, examples: Sequence[Example], catalogue: Catalogue
) -> tuple[float, float, list[dict[str, float]]]:
    """Return slope and offset of the confidence, fitted on half of the examples, and the reliability of the others."""
    slot = Worker(folder)
    odds: list[float] = []
    right: list[bool] = []
    for example in examples:
        words = words_of(" ".join(example.words[: example.own]), example.words[example.own :])
        robots = tuple(example.words[example.own :]) or None
        question = Question(
            text=words.text[: words.spans[words.own - 1][1]], robots=robots, skills=shapes(catalogue), deadline_s=60.0
        )
        if slot.speaker is None:
            raise ValueError(f"{folder} has no card")
        said = slot.speaker.answer(question)
        share = min(1 - 1e-9, max(1e-9, said.confidence))
        odds.append(math.log(share / (1 - share)))
        right.append(is_exact(read(said.symbols, words, catalogue), read(example.symbols, words, catalogue)))
    # Fitted on one half and shown on the other: a curve over what it was fitted on would flatter it.
    slope, offset = logistic(odds[::2], right[::2])
    odds, right = odds[1::2], right[1::2]
    sure = [1 / (1 + math.exp(-(slope * each + offset))) for each in odds]
    curve: list[dict[str, float]] = []
    for number in range(BINS):
        low, high = number / BINS, (number + 1) / BINS
        inside = [index for index, each in enumerate(sure) if low <= each < high or (high == 1.0 and each == 1.0)]
        if inside:
            curve.append(
                {
                    "confidence": round(sum(sure[index] for index in inside) / len(inside), 3),
                    "exact": round(sum(right[index] for index in inside) / len(inside), 3),
                    "cases": len(inside),
                }
            )
    return slope, offset, curve


def logistic(
    odds: Sequence[float], right: Sequence[bool], *, steps: int = 3000, rate: float = 0.05
) -> tuple[float, float]:
    """Return slope and offset of the logistic regression of right or wrong on log-odds."""
    slope, offset, count = 1.0, 0.0, max(1, len(odds))
    for _ in range(steps):
        wrong = [
            1 / (1 + math.exp(-max(-60.0, min(60.0, slope * x + offset)))) - y for x, y in zip(odds, right, strict=True)
        ]
        slope -= rate * sum(error * x for error, x in zip(wrong, odds, strict=True)) / count
        offset -= rate * sum(wrong) / count
    return round(slope, 5), round(offset, 5)


def main(arguments: Sequence[str]) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description="Make the folder for the local slot from a training run.")
    parser.add_argument("run", type=Path, help="folder of the run")
    parser.add_argument("folder", type=Path, help="where to")
    parser.add_argument("--precision", default="int4", choices=("int4", "int8", "fp32"))
    parser.add_argument("--most", type=int, default=0, help="held-out pairs to calibrate on; 0 for all")
    parser.add_argument(
        "--beside",
        action="append",
        default=[],
        help=f"a planner's folder, or `embedded`: its model is asked besides; at most {len(BESIDE)}",
    )
    parser.add_argument("--release", action="store_true", help="replace the folder, also that of the embedded planner")
    given = parser.parse_args(arguments)
    beside = [Path(folder_of(folder)) for folder in given.beside]
    if not given.release:
        outside_release(given.folder)
    folder: Path = given.folder
    # A release replaces the folder whole, once its successor is done: `beside` may read from it until then.
    target = folder.with_name(f"{folder.name}.new") if given.release else folder
    made = export(given.run, target, precision=given.precision, most=given.most, beside=beside)
    if given.release:
        shutil.rmtree(folder, ignore_errors=True)
        target.rename(folder)
    print(json.dumps(made, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(ended(main))
