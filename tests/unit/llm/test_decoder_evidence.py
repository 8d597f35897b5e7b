"""The second opinion on an answer: which skills the words speak for."""

import math
from pathlib import Path

import pytest

from appliance.llm.decoder import FILE, Evidence, cues, read_evidence, skills_of, support, write_evidence
from appliance.llm.settings import EMBEDDED_FOLDER
from appliance.skills.catalogue import load_catalogue


def speaking_for(word: str, skill: str) -> Evidence:
    """Return evidence in which one word speaks for one skill, and nothing for another."""
    skills = ("pick", "photograph")
    row = bytes(100 if each == skill else 0 for each in skills)
    return Evidence(skills=skills, bias=(-3.0, -3.0), scale=0.05, rows={cues([word])[0]: row})


def test_a_word_speaks_for_a_skill() -> None:
    """Its weight is added wherever the word stands, once each time; other words leave the odds as they are."""
    evidence = speaking_for("snap", "photograph")
    assert evidence.odds([]) == {"pick": -3.0, "photograph": -3.0}
    assert evidence.odds(["snap"])["photograph"] == pytest.approx(2.0)
    assert evidence.odds(["do", "snap", "snap"])["photograph"] > evidence.odds(["do", "snap"])["photograph"]
    assert evidence.odds(["snap"])["pick"] == -3.0


def test_an_answer_with_what_the_words_speak_for_has_more_support() -> None:
    """It is the probability of just these skills: what is lacking counts as what is too much does."""
    odds = {"pick": -3.0, "photograph": 2.0}
    both, right, wrong, none = (support(odds, each) for each in ({"pick", *odds}, {"photograph"}, {"pick"}, set[str]()))
    assert right > both > wrong
    assert right > none > wrong
    every = ({"pick", "photograph"}, {"pick"}, {"photograph"}, set[str]())
    assert sum(math.exp(support(odds, each)) for each in every) == pytest.approx(1.0)


def test_a_way_needs_no_word_and_an_unknown_skill_no_opinion() -> None:
    """A goto follows from places; a site's own skill, which nothing was learned of, changes nothing."""
    odds = {"pick": 2.0, "goto": -5.0}
    assert support(odds, {"pick"}) == support(odds, {"pick", "goto"}) == support(odds, {"pick", "weld"})
    assert support({}, {"weld"}) == 0
    assert math.isfinite(support({"pick": -1e6}, {"pick"}))


def test_the_skills_of_an_answer() -> None:
    """Those that stand where skills stand: a domain, a parameter and a refusal are none."""
    symbols = ["inspection", "goto", "any", "place:", "w1", "w2", "|", "inspect", "any", "asset:", "w4", "w4", "<", "1"]
    assert skills_of(symbols) == {"goto", "inspect"}
    assert skills_of(("navigation", "land", "w0", "w0")) == {"land"}
    assert skills_of(("none", "chatter")) == skills_of(["none", "question"]) == frozenset()


def test_what_was_written_is_read_again(tmp_path: Path) -> None:
    """A folder without it has none: a model does without."""
    assert read_evidence(tmp_path) is None
    evidence = speaking_for("snap", "photograph")
    write_evidence(tmp_path, evidence)
    assert read_evidence(tmp_path) == evidence


@pytest.mark.parametrize("damage", [b"", b"\xc1", b"half", b"short"])
def test_damaged_evidence_is_named(tmp_path: Path, damage: bytes) -> None:
    """Empty, no message, half of one, and one with a row that has not a weight for each skill."""
    write_evidence(tmp_path, speaking_for("snap", "photograph"))
    whole = (tmp_path / FILE).read_bytes()
    short = Evidence(skills=("pick", "land"), bias=(0.0, 0.0), scale=1.0, rows={1: b"\0\0", 2: b"\0"})
    if damage == b"half":
        damage = whole[: len(whole) // 2]
    (tmp_path / FILE).write_bytes(damage)
    if damage == b"short":
        write_evidence(tmp_path, short)
    with pytest.raises(ValueError, match=r"evidence\.bin is damaged"):
        read_evidence(tmp_path)


def test_the_embedded_evidence_knows_the_catalogue() -> None:
    """It has an opinion on every skill that the pairs have, and the right one on plain orders."""
    evidence = read_evidence(EMBEDDED_FOLDER)
    assert evidence is not None
    assert set(evidence.skills) <= set(load_catalogue().skills)
    assert len(evidence.skills) > 50
    odds = evidence.odds("photograph the shelf and then open the door".split())  # noqa: SIM905 - as it is said
    assert sorted(odds, key=lambda skill: -odds[skill])[:2] in (["photograph", "open"], ["open", "photograph"])
