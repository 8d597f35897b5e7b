# pyright: basic, reportMissingImports=false
# PyTorch is of the extra `train`, which neither gateways nor the development environment have.
"""Fine-tunes a planner for a site, the embedded one or another: its own skills and way of speaking, from logged plans.

Half of each batch (`--share`) is the site's pairs, varied as all are, the other half the hand-written ones, so that
what was learned is not forgotten. A tenth of the site's pairs is held out; its figures are printed before and after.
The result is a run like any other: `export` makes its model folder.

    python -m workshop.train.tune embedded NEW --plans PLANS.jsonl --skills FOLDER --minutes 20
"""

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from appliance.skills.catalogue import Catalogue, load_catalogue
from workshop.train.ending import ended
from workshop.train.fit import Trainer
from workshop.train.model import RECIPE, Base
from workshop.train.site import Pairs, read_pairs

SITE = "site.json"
"""In a run that was tuned: the folders of the site's skills."""


def tune(
    base: str,
    folder: Path,
    *,
    plans: Path,
    skills: Sequence[Path] = (),
    steps: int = 2000,
    rate: float = 4e-4,
    share: float = 0.5,
    minutes: float = 20.0,
    workers: int = 1,
) -> dict[str, Any]:
    """Tune; return the figures on what is held out, before and after.

    Args:
        base: folder of a training run or of a model, or `embedded`.
        folder: of the new run; must not exist, or be one that was stopped.
        plans: JSONL, as `site.read_pairs` takes it.
        skills: folders of the site's own skills.
        steps: batches.
        rate: highest learning rate: a fifth of that of training.
        share: of a batch that are the site's pairs.
        minutes: stop after so many.
        workers: processes that make batches.
    """
    catalogue = load_catalogue(tuple(skills))
    pairs: Pairs = read_pairs(plans, catalogue)
    for each in pairs.left_out:
        print(f"left out: {each}", flush=True)
    if not pairs.train:
        raise SystemExit(f"{plans} has no pair to learn from")
    begin = Base(base)
    recipe = replace(begin.recipe, steps=steps, rate=rate, warmup=min(100, steps // 10))
    if not (folder / RECIPE).is_file():  # else it was stopped, and goes on
        begin.prepare(folder, catalogue, recipe)
        (folder / SITE).write_text(json.dumps({"skills": [str(each) for each in skills]}))
    trainer = Trainer(
        folder,
        recipe,
        workers=workers,
        progress=lambda text: print(text, flush=True),
        catalogue=catalogue,
        site=pairs,
        share=share,
    )
    before = trainer.look()
    after = trainer.run(minutes=minutes)
    return {"pairs": len(pairs.train), "held_out": len(pairs.held_out), "before": before, "after": after}


def catalogue_of(run: Path) -> Catalogue:
    """Return the catalogue that a run was trained for: with the site's skills, where it was tuned."""
    kept = run / SITE
    skills = json.loads(kept.read_text())["skills"] if kept.is_file() else []
    return load_catalogue(tuple(Path(each) for each in skills))


def main(arguments: Sequence[str]) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description="Fine-tune a planner for a site; run it again to go on.")
    parser.add_argument("base", help="folder of the training run or model to begin with, or `embedded`")
    parser.add_argument("folder", type=Path, help="where the tuned run is kept")
    parser.add_argument("--plans", type=Path, required=True, help="JSONL: instruction and gold, or task records")
    parser.add_argument("--skills", type=Path, action="append", default=[], help="a folder of the site's skills")
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--rate", type=float, default=4e-4)
    parser.add_argument("--share", type=float, default=0.5, help="of a batch that are the site's pairs")
    parser.add_argument("--minutes", type=float, default=20.0)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--threads", type=int, default=0, help="of the processor; 0 for all")
    given = parser.parse_args(arguments)
    if not 0 < given.share < 1:
        parser.error("--share is between 0 and 1")
    if given.threads:
        torch.set_num_threads(given.threads)
    told = tune(
        given.base,
        given.folder,
        plans=given.plans,
        skills=given.skills,
        steps=given.steps,
        rate=given.rate,
        share=given.share,
        minutes=given.minutes,
        workers=given.workers,
    )
    print(json.dumps(told, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(ended(main))
