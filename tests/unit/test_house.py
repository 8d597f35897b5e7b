"""The shape of the code base stays: short chains of imports, no callback set on another object from outside."""

import ast

import pytest

from scripts import house

PRODUCT = house.modules_of(house.ROOT, house.PRODUCT)


@pytest.mark.parametrize(("room", "longest"), [("", 20), ("plane", 8), ("tasks", 8), ("tui", 7)])
def test_chains_of_imports_stay_short(room: str, longest: int) -> None:
    """A reader of one module has to read so many below it at most, one below the other."""
    chain = house.longest_chain(PRODUCT, f"{house.PRODUCT}.{room}".rstrip("."))
    assert len(chain) <= longest, " imports ".join(chain)


def test_no_callback_is_set_on_another_object() -> None:
    """What an object calls is given to its constructor, where a reader finds it."""
    assert {name for name, path in PRODUCT.items() if house.set_from_outside(ast.parse(path.read_text()))} == set()


@pytest.mark.parametrize(
    ("statement", "counted"),
    [
        ("other.on_lost = self.lost", 1),
        ("self.other.hook = lambda: None", 1),
        ("other.hook = place", 1),
        ("self.hook = self.lost", 0),
        ("other.lost = found.lost", 0),
        ("other.here = there", 0),
    ],
)
def test_a_callback_is_told_from_data(statement: str, counted: int) -> None:
    """A parameter that is called like a function is data, and so is a field that is copied."""
    source = f"def place(): ...\ndef there(): ...\ndef lost(): ...\ndef method(self, other, found, there): {statement}"
    assert house.set_from_outside(ast.parse(source)) == counted


def test_words_of_our_own_stay_few() -> None:
    """Texts say who (not whoever), again (not anew), and reported, published or shown (not told)."""
    assert house.dialect(house.ROOT)["code and docs"] <= 60
