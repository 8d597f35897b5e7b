"""The corpus as examples: read once, and never while tests are collected."""

import pytest

from appliance.skills.catalogue import load_catalogue
from workshop.corpus import load
from workshop.train.examples import Example, example_of

STEP = 16
"""Every so many pairs of the corpus: all of them take long to read, and a test draws some hundreds."""


@pytest.fixture(scope="session")
def examples() -> list[Example]:
    """Examples of the corpus."""
    catalogue = load_catalogue()
    return [example_of(pair, catalogue) for pair in list(load().values())[::STEP]]
