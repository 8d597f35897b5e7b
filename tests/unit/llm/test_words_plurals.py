"""Names in the plural, brought to the singular."""

import pytest

from appliance.llm.words import singular


@pytest.mark.parametrize(
    ("several", "one"),
    [
        *(("valves", "valve"), ("work gloves", "work glove"), ("hives", "hive"), ("drives", "drive")),
        *(("top shelves", "top shelf"), ("bookshelves", "bookshelf"), ("knives", "knife"), ("leaves", "leaf")),
        *(("batteries", "battery"), ("cookies", "cookie"), ("boxes", "box"), ("glasses", "glass")),
        *(("potatoes", "potato"), ("shoes", "shoe"), ("lenses", "lens"), ("houses", "house"), ("press", "press")),
        *(("the farmer's", "the farmer"), ("bay 2", "bay 2"), ("", "")),
    ],
)
def test_one_of_several(several: str, one: str) -> None:
    """The last word becomes one thing, the others stay; a valve is no "valf"."""
    assert singular(several) == one
