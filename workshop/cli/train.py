"""Training of the embedded planner: `swiftbot train …`."""

import importlib.util
import os
import random
import sys
from pathlib import Path
from typing import Annotated, NoReturn

from cyclopts import App, Parameter

from appliance.cli.common import TOOLS, Json, show
from appliance.errors import PrerequisiteError

train_app = App(name="train", help="Train the embedded planner, and make its model folder.", group=TOOLS)


def add_to(app: App) -> None:
    """Add these commands."""
    app.command(train_app)


@train_app.command(name="examples")
def train_examples(*, count: int = 10, seed: int = 1, as_json: Json = False) -> int:
    """Show what is trained on: variations of the hand-written pairs, with their plans.

    Args:
        count: How many.
        seed: Of the variations.
    """
    from appliance.skills.catalogue import load_catalogue
    from workshop.train.lexicon import Lexicon
    from workshop.train.splits import corpus_examples, split
    from workshop.train.vary import vary

    examples = split(corpus_examples(load_catalogue())).train
    lexicon, rng = Lexicon(examples), random.Random(seed)  # noqa: S311 - examples to look at, not secrets
    made = [vary(rng.choice(examples), examples, lexicon, rng) for _ in range(count)]
    rows = [
        {"instruction": each.text, "roster": list(each.words[each.own :]), "plan": " ".join(each.symbols)}
        for each in made
    ]
    lines = [f"{row['instruction']}\n    {row['plan']}\n" for row in rows]
    show(rows, as_json=as_json, table="\n".join(lines))
    return 0


@train_app.command(name="fit")
def train_fit(run: Path, /, *options: Annotated[str, Parameter(allow_leading_hyphen=True)]) -> int:
    """Train, or go on with a run that was stopped; needs `make train` once.

    Args:
        run: Folder of the run: its recipe, checkpoints, tokenizer and figures.
        options: As `swiftbot train fit RUN -- --help` tells: minutes, threads, seed, width, layers, steps, ...
    """
    _with_torch("workshop.train.fit", [str(run), *options])


@train_app.command(name="export")
def train_export(run: Path, folder: Path, /, *, precision: str = "int4", most: int = 0, release: bool = False) -> int:
    """Make the model folder for `llm.local_model` of a run, its confidence calibrated on the held-out pairs.

    Args:
        run: Folder of the run.
        folder: Where to; must not exist.
        precision: int4, int8 or fp32.
        most: Held-out pairs to calibrate on; 0 for all.
        release: The folder may be that of the embedded planner, `models/planner`.
    """
    arguments = [str(run), str(folder), "--precision", precision, "--most", str(most), *(["--release"] * release)]
    _with_torch("workshop.train.export", arguments)


@train_app.command(name="tune")
def train_tune(base: str, folder: Path, /, *options: Annotated[str, Parameter(allow_leading_hyphen=True)]) -> int:
    """Fine-tune a planner for a site, with its own skills and logged plans; then `export` it as any.

    Args:
        base: What to begin with: folder of a training run or of a model, or `embedded`.
        folder: Where the tuned run is kept.
        options: As `swiftbot train tune BASE FOLDER -- --help` tells: --plans JSONL (needed), --skills FOLDER,
            --minutes, --steps, --share, ...
    """
    _with_torch("workshop.train.tune", [base, str(folder), *options])


def _with_torch(module: str, arguments: list[str]) -> NoReturn:
    """Go on as a module in an environment that has PyTorch: this one, or the one `make train` made beside it."""
    python = sys.executable
    if importlib.util.find_spec("torch") is None:
        places = (Path(sys.prefix).parent / "train", Path(sys.prefix) / ".train")
        python = next((str(each / "bin" / "python") for each in places if (each / "bin" / "torchrun").exists()), "")
    if not python:
        raise PrerequisiteError("PyTorch is not installed", remedy="run `make train` in the project (5 GB)")
    sys.stdout.flush()
    here = str(Path(__file__).resolve().parents[2])
    paths = os.pathsep.join(each for each in (here, os.environ.get("PYTHONPATH", "")) if each)
    os.execve(python, [python, "-m", module, *arguments], {**os.environ, "PYTHONPATH": paths})  # noqa: S606 - ourselves
