"""What cannot be written is reported with cause and remedy, and leaves nothing half written."""

from pathlib import Path

import pytest

from appliance.errors import PrerequisiteError
from workshop.train.ending import replace_text, writing

FULL = [
    pytest.param(OSError(28, "No space left on device"), id="the system's own"),
    pytest.param(RuntimeError("unexpected pos 64 vs 0"), id="of a library of its own words"),
    pytest.param(ValueError("I/O error"), id="of any other"),
]


@pytest.mark.parametrize("error", FULL)
def test_a_full_disk_is_told_and_leaves_nothing_half_written(tmp_path: Path, error: Exception) -> None:
    """A folder that was begun goes with all in it, a file too, so that the same command can be given again."""
    folder, file, before = tmp_path / "run", tmp_path / "checkpoint.new", tmp_path / "checkpoint.pt"
    before.write_text("the one before")

    def write() -> None:
        (folder / "model").mkdir(parents=True)
        (folder / "model" / "weights").write_text("half")
        file.write_text("half")
        raise error

    with (
        pytest.raises(PrerequisiteError, match=f"run cannot be written: .*{error.args[-1]}") as told,
        writing(f"{folder}", remedy="make room", unfinished=(folder, file)),
    ):
        write()
    assert told.value.remedy == "make room"
    assert told.value.__cause__ is error
    assert [each.name for each in tmp_path.iterdir()] == [before.name]


def test_what_cannot_even_be_begun_is_told(tmp_path: Path) -> None:
    """Where a file stands in the folder's place there is nothing to remove, and what stands there stays."""
    taken = tmp_path / "taken"
    taken.write_text("a file")
    with pytest.raises(PrerequisiteError, match="Not a directory"), writing("a run", remedy="name another folder"):
        (taken / "run").mkdir(parents=True)
    assert taken.read_text() == "a file"


def test_what_was_written_stays(tmp_path: Path) -> None:
    """Without a failure nothing is removed."""
    with writing("a run", remedy="", unfinished=(tmp_path / "new",)):
        (tmp_path / "new").write_text("whole")
    assert (tmp_path / "new").read_text() == "whole"


def test_an_interruption_is_no_failure_to_write(tmp_path: Path) -> None:
    """Ctrl+C ends the run as it does everywhere."""
    with pytest.raises(KeyboardInterrupt), writing("a run", remedy="", unfinished=(tmp_path,)):
        raise KeyboardInterrupt


def test_a_file_that_cannot_be_replaced_is_what_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A recipe that is written again on a full disk is not an empty one afterwards: the run would be lost."""
    path = tmp_path / "recipe.json"
    replace_text(path, "one")
    replace_text(path, "two")

    def full(self: Path, text: str, **_: str) -> int:
        with self.open("w"):
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(PrerequisiteError, match=r"recipe\.json cannot be written: .*No space left"):
        replace_text(path, "three")
    assert path.read_text() == "two"
    assert [each.name for each in tmp_path.iterdir()] == ["recipe.json"]
