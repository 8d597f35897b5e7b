"""The data-set card of the training corpus says what the files hold, and no pair is lost or doubled."""

import re
from collections import Counter

from workshop.corpus import FOLDER, load

PAIRS = 27_200
_ROW = re.compile(r"^\| `([a-z_]+)` \|[^|]*\| ([\d,]+) \| ([\d,]+) \| ([\d,]+) \| ([\d,]+) \|$", re.MULTILINE)
_SOURCES = ("hand-1", "hand-2", "hand-3")


def test_the_card_counts_every_file_and_source() -> None:
    """Each row of the card is the count of a file by source, and all pairs are in one."""
    corpus = load()
    counted = Counter((where.partition(".")[0], pair.source) for where, pair in corpus.items())
    rows = {
        name: [int(number.replace(",", "")) for number in numbers]
        for name, *numbers in _ROW.findall((FOLDER / "README.md").read_text())
    }
    by_source = {name: [counted[name, source] for source in _SOURCES] for name in {name for name, _ in counted}}
    assert rows == {name: [*counts, sum(counts)] for name, counts in by_source.items()}
    assert {pair.source for pair in corpus.values()} == set(_SOURCES)


def test_no_pair_is_lost_or_doubled() -> None:
    """As many instructions as pairs, and as many pairs as were written."""
    instructions = [pair.instruction for pair in load().values()]
    assert len(instructions) == len(set(instructions)) == PAIRS
