"""The snapshot store: what is copied, under which digest, and what a crash, a damaged file or a link does to it."""

import os
from pathlib import Path

import pytest

from appliance.errors import ConfigError
from appliance.pool.snapshots import Snapshot, Snapshots, unexpected


@pytest.fixture
def skills(tmp_path: Path) -> Path:
    """Return a folder with one skill."""
    folder = tmp_path / "skills"
    (folder / "probe").mkdir(parents=True)
    (folder / "probe" / "handler.py").write_text("def run(ctx):\n    return {'v': 1}\n")
    (folder / "probe" / "table.json").write_text("[1]")
    return folder


@pytest.fixture
def store(tmp_path: Path) -> Snapshots:
    """Return an empty store."""
    return Snapshots(tmp_path / "data" / "snapshots")


def _take(store: Snapshots, skills: Path) -> Snapshot:
    return store.take({"skills": skills})


def test_an_edit_after_the_snapshot_is_not_in_it(store: Snapshots, skills: Path) -> None:
    """The copy keeps the bytes that its digest is of, and cannot be written through."""
    before = _take(store, skills)
    handler = skills / "probe" / "handler.py"
    text = handler.read_text()
    handler.write_text(text.replace("1", "2"))
    copy = before.folder / "skills" / "probe" / "handler.py"
    assert copy.read_text() == text
    assert not copy.stat().st_mode & 0o222
    after = _take(store, skills)
    assert after.digest != before.digest
    handler.write_text(text)
    assert _take(store, skills) == before


def test_data_files_and_execute_bits_are_in_the_digest(store: Snapshots, skills: Path) -> None:
    """Not code alone: what a preload reads and what a handler starts make another snapshot too."""
    digests = {_take(store, skills).digest}
    (skills / "probe" / "table.json").write_text("[2]")
    digests.add(_take(store, skills).digest)
    (skills / "probe" / "table.json").chmod(0o755)
    digests.add(_take(store, skills).digest)
    (skills / "probe" / "table.json").rename(skills / "probe" / "other.json")
    digests.add(_take(store, skills).digest)
    assert len(digests) == 4


def test_what_no_container_loads_is_left_out(store: Snapshots, skills: Path) -> None:
    """Bytecode, version control and the folders of images are neither copied nor part of the digest."""
    before = _take(store, skills)
    for path in ("probe/__pycache__/handler.cpython-311.pyc", ".git/HEAD", "images/big/wheel.whl", "sites/yard.toml"):
        (skills / path).parent.mkdir(parents=True, exist_ok=True)
        (skills / path).write_text("x")
    assert _take(store, skills) == before
    assert sorted(before.files) == ["skills/probe/handler.py", "skills/probe/table.json"]


def test_links_are_followed_and_loops_end(store: Snapshots, skills: Path, tmp_path: Path) -> None:
    """A file kept elsewhere is copied, for it could not be reached from a container; a loop and a pipe are skipped."""
    (tmp_path / "model.bin").write_bytes(b"weights")
    (skills / "probe" / "model.bin").symlink_to(tmp_path / "model.bin")
    (skills / "probe" / "again").symlink_to(skills)
    os.mkfifo(skills / "probe" / "pipe")
    taken = _take(store, skills)
    assert (taken.folder / "skills" / "probe" / "model.bin").read_bytes() == b"weights"
    assert sorted(path.rpartition("/")[2] for path in taken.files) == ["handler.py", "model.bin", "table.json"]


def test_a_file_that_is_in_two_snapshots_is_stored_once(store: Snapshots, skills: Path) -> None:
    """An edit of one file costs that file, not a copy of the weights beside it."""
    first = _take(store, skills)
    (skills / "probe" / "handler.py").write_text("def run(ctx):\n    return {}\n")
    second = _take(store, skills)
    place = "skills/probe/table.json"
    assert (first.folder / place).samefile(second.folder / place)


def test_a_damaged_copy_is_made_again(store: Snapshots, skills: Path) -> None:
    """Bytes that are no longer those of their digest, as after a power cut, are not served at the next start."""
    before = _take(store, skills)
    copy = before.folder / "skills" / "probe" / "handler.py"
    copy.chmod(0o644)
    copy.write_text("")
    after = _take(store, skills)
    assert after == before
    assert copy.read_text() == (skills / "probe" / "handler.py").read_text()


def test_what_a_killed_gateway_was_building_goes(store: Snapshots, skills: Path) -> None:
    """Half a tree and half an object of the gateway before are removed and never taken for whole ones."""
    taken = _take(store, skills)
    trees = taken.folder.parent
    (trees / ".new-1" / "skills").mkdir(parents=True)
    (trees.parent / "objects" / ".new-2").write_text("half")
    _take(store, skills)
    assert [each.name for each in trees.iterdir()] == [taken.digest]
    assert not list((trees.parent / "objects").glob(".new-*"))


def test_snapshots_nobody_uses_are_removed_with_what_only_they_had(store: Snapshots, skills: Path) -> None:
    """Those that are kept lose nothing."""
    old = _take(store, skills)
    (skills / "probe" / "handler.py").write_text("def run(ctx):\n    return {}\n")
    new = _take(store, skills)
    assert store.forget({old.digest, new.digest}) == ()
    assert store.forget({new.digest}) == (old.digest,)
    assert {each.name for each in (new.folder.parent.parent / "objects").iterdir()} == set(new.files.values())
    assert _take(store, skills) == new


def test_a_folder_that_cannot_be_read_is_named_with_a_remedy(store: Snapshots, tmp_path: Path) -> None:
    """The error says which path and what to do."""
    with pytest.raises(ConfigError, match="absent") as caught:
        _take(store, tmp_path / "absent")
    assert "readable" in caught.value.remedy


def test_loaded_files_are_held_against_the_snapshot() -> None:
    """Other bytes and files that the snapshot does not have are named."""
    files = {"skills/a.py": "1", "skills/b.py": "2"}
    assert unexpected({"skills/a.py": "1"}, files) == ()
    assert unexpected({"skills/c.py": "3", "skills/b.py": "x", "skills/a.py": "1"}, files) == (
        "skills/b.py",
        "skills/c.py",
    )
