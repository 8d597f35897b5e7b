"""Correction of transcripts by which words follow which."""

import itertools
import random
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.learn.datasets.speech import sentences
from appliance.skills._lib.learning import language, models
from appliance.skills._lib.learning.language import Language

LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ "


@pytest.fixture(scope="module")
def known() -> Language:
    """Return the shipped language."""
    return language.read(models.FOLDER / "sentences" / "language.json")


def test_the_shipped_language_is_that_of_the_sentences(project_root: Path) -> None:
    """`scripts/write_language.py` makes the file; it is as it would be made now."""
    done = subprocess.run([sys.executable, str(project_root / "scripts" / "write_language.py"), "--check"], check=False)
    assert done.returncode == 0, "run scripts/write_language.py"


@pytest.mark.parametrize(
    ("heard", "meant"),
    [
        ("ROVR ONE GOTO DOC THREE", "ROVER ONE GO TO DOCK THREE"),
        ("THE A RM FETCH THE RED BOKS", "THE ARM FETCH THE RED BOX"),
        ("DRONETWO RETURN TO THE ROF", "DRONE TWO RETURN TO THE ROOF"),
        ("ROVER ONE GO TO DOCK TWO", "ROVER ONE GO TO DOCK TWO"),
        ("", ""),
    ],
)
def test_misheard_orders(known: Language, heard: str, meant: str) -> None:
    """Misspelled words, words torn apart and words run together are put right; what is right stays."""
    found = language.correct(heard, known)
    assert found.text == meant
    assert bool(found.changes) == (heard != meant)


def test_other_text_stays(known: Language) -> None:
    """Words of a recogniser that only writes words, on something that the language has never heard of, are left."""
    assert language.correct("THE WEATHER MAY CHANGE BEFORE EVENING", known, language.WORDS).text == (
        "THE WEATHER MAY CHANGE BEFORE EVENING"
    )


def test_it_helps(known: Language) -> None:
    """Of sentences with a letter in twelve wrong, it removes most word errors and makes hardly any."""
    rng = random.Random(1)  # noqa: S311 - misheard letters are no secret

    def misheard(text: str) -> str:
        kept = [letter if rng.random() > 0.08 else rng.choice(LETTERS) for letter in text]
        return " ".join("".join(kept).split())

    before = after = words = 0
    for text in itertools.islice(sentences(99), 80):
        heard = misheard(text)
        before += _errors(heard, text)
        after += _errors(language.correct(heard, known).text, text)
        words += len(text.split())
        assert language.correct(text, known).text == text, "a right sentence is left as it is"
    assert after < before / 3
    assert before > words / 10


def _errors(heard: str, meant: str) -> int:
    one, other = heard.split(), meant.split()
    row = list(range(len(other) + 1))
    for number, word in enumerate(one, start=1):
        diagonal, row[0] = row[0], number
        for place, each in enumerate(other, start=1):
            diagonal, row[place] = row[place], min(row[place] + 1, row[place - 1] + 1, diagonal + (word != each))
    return row[-1]


@given(st.text(st.sampled_from(LETTERS), max_size=40))
def test_whatever_was_heard_it_ends(text: str) -> None:
    """Any letters are read somehow, and each change is of what was heard."""
    small = language.count(["GO TO DOCK ONE", "GO HOME", "STOP"])
    found = language.correct(text, small)
    assert all(said in " ".join(text.split()) for said, _ in found.changes)
    assert bool(found.text) == bool(text.split())


@given(st.text("ab", max_size=6), st.text("ab", max_size=6), st.integers(0, 6))
def test_edits_are_bounded(one: str, other: str, most: int) -> None:
    """The distance is symmetric, and told only up to the bound."""
    whole = language.edits(one, other, 100)
    assert whole == language.edits(other, one, 100)
    assert language.edits(one, other, most) == (whole if whole <= most else most + 1)


def test_a_language_is_read_as_it_was_written(tmp_path: Path, known: Language) -> None:
    """Words and pairs survive being written down."""
    (tmp_path / "l.json").write_text(language.to_json(known))
    again = language.read(tmp_path / "l.json")
    assert again.pairs == known.pairs
    assert again.words == known.words
