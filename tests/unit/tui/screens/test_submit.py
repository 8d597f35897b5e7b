"""Help while an instruction is written: completion of names, and the history."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.tui.screens.submit import MOST, History, common, completions

NAMES = ("rover_1", "rover_2", "drone_1", "dock 1", "dock 3", "cold store", "charger")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("ro", ("rover_1", "rover_2")),
        ("send ROVER_2", ()),
        ("Rover_", ("rover_1", "rover_2")),
        ("rover_1 goes to do", ("rover_1 goes to dock 1", "rover_1 goes to dock 3")),
        ("rover_1 goes to dock 3", ()),
        ("rover_1 goes to dock ", ()),
        ("to cold st", ("to cold store",)),
        ("(dr", ("(drone_1",)),
        ("", ()),
        ("xyz", ()),
    ],
)
def test_names_are_completed(text: str, expected: tuple[str, ...]) -> None:
    """The word that is begun is completed by names, also in their middle; what is whole or not begun is left."""
    assert completions(text, NAMES) == expected


@given(text=st.text(max_size=40), names=st.lists(st.text(max_size=10), max_size=8))
def test_a_completion_goes_on_from_what_is_written(text: str, names: list[str]) -> None:
    """Whatever is written and whatever names there are, a completion is longer and keeps what stands before."""
    for made in completions(text, names):
        assert len(made) > len(text) - 1
        assert any(made.endswith(name) for name in names)


def test_common_beginning() -> None:
    """Tab goes on as far as all completions agree."""
    assert common(("a dock 1", "a dock 3")) == "a dock "
    assert common(()) == ""


def test_history_is_kept_and_gone_through(tmp_path: Path) -> None:
    """Instructions are there again in another process, each once, newest last; what was begun comes back at the end."""
    file = tmp_path / "deep" / "instructions.json"
    first = History(file)
    for text in ("one", "two", "one", "  "):
        first.add(text)
    again = History(file)
    assert again.entries == ["two", "one"]
    assert again.older("begun") == "one"
    assert again.older("one") == "two"
    assert again.older("two") == "two"
    assert again.newer("two") == "one"
    assert again.newer("one") == "begun"
    assert again.newer("begun") == "begun"
    assert file.stat().st_mode & 0o077 == 0


def test_history_is_bounded(tmp_path: Path) -> None:
    """Only so many are kept."""
    history = History(tmp_path / "h.json")
    for number in range(MOST + 20):
        history.entries.append(str(number))
    history.add("last")
    assert len(History(tmp_path / "h.json").entries) == MOST


@pytest.mark.parametrize("content", [b"{", b'{"a": 1}', b"[1, 2]", b"\xff\xfe", b"[" * 100_000])
def test_broken_history_costs_nothing_else(tmp_path: Path, content: bytes) -> None:
    """A file that is none is reported and begun again."""
    file = tmp_path / "h.json"
    file.write_bytes(content)
    history = History(file)
    assert history.entries == []
    assert "cannot be read" in history.problem
    history.add("new")
    assert History(file).entries == ["new"]


def test_history_that_cannot_be_written(tmp_path: Path) -> None:
    """Where nothing can be written the history is this process's own, and that is reported."""
    (tmp_path / "blocked").write_text("a file, not a folder")
    history = History(tmp_path / "blocked" / "h.json")
    history.add("one")
    assert history.entries == ["one"]
    assert "cannot be" in history.problem
