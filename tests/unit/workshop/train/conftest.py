"""The corpus as examples: read once, and never while tests are collected."""

from pathlib import Path

import pytest

from appliance.skills.catalogue import load_catalogue
from workshop import corpus
from workshop.corpus.notation import parse
from workshop.train.examples import Example, example_of

SAMPLE = 16
"""Where quick feedback is wanted, every so many files of the corpus: all of them take long to read."""


@pytest.fixture(scope="session")
def examples(quick: bool) -> list[Example]:
    """The examples of the corpus."""
    catalogue = load_catalogue()
    files = sorted(Path(corpus.__file__).parent.glob("*.plan"))[:: SAMPLE if quick else 1]
    return [example_of(pair, catalogue) for file in files for pair in parse(file.read_text()).values()]
