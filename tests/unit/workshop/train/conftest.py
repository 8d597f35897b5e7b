"""The corpus as examples: read once, and never while tests are collected."""

import pytest

from appliance.skills.catalogue import load_catalogue
from workshop.corpus import load
from workshop.train.examples import Example, example_of

SAMPLE = 16
"""Where quick feedback is wanted, every so many pairs of the corpus: all of them take long to read."""


@pytest.fixture(scope="session")
def examples(quick: bool) -> list[Example]:
    """The examples of the corpus."""
    catalogue = load_catalogue()
    return [example_of(pair, catalogue) for pair in list(load().values())[:: SAMPLE if quick else 1]]
