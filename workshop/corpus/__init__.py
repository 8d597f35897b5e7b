"""Instruction-plan pairs written by hand: what the embedded planner is trained on.

The `.plan` files beside this module are the corpus, one file for each domain, in a notation made to be written and read
by people. README.md says how to write a pair and how the rules' hard cases were settled.

Doors: `load` (every pair, by file and line), `notation.parse` and `notation.write`, `check.problems` (one pair against
catalogue and rules), `near.too_near` (copies within the corpus or of a test set), `tally.tally` (what it covers);
`python -m workshop.corpus` runs them all.
"""

from pathlib import Path

from workshop.corpus.notation import Pair, parse

FOLDER = Path(__file__).resolve().parent
"""Where the built-in pairs are."""


def load(folder: Path = FOLDER) -> dict[str, Pair]:
    """Return all pairs of a folder's `.plan` files by where they stand, such as "aerial.plan:12".

    Raises:
        PayloadError: with file and line, at the first thing that is not in the notation.
    """
    return {
        f"{path.name}:{line}": pair
        for path in sorted(folder.glob("*.plan"))
        for line, pair in parse(path.read_text("utf-8"), name=path.name).items()
    }
