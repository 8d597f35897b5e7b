"""What a run may take of the disk that its volumes are on."""

import os
from pathlib import Path

import pytest

from appliance.pool.runner import disk
from appliance.pool.runner.disk import OWN_MB, WALK_S, Disk

ALL_MB = 2**40
"""More than any disk has: it is always short."""


def volumes(tmp_path: Path) -> Path:
    """Return a folder with two volumes, one of which has had 64 MB of state for long."""
    folder = tmp_path / "volumes"
    for name in ("maps", "notes"):
        (folder / name / "deep").mkdir(parents=True)
    (folder / "maps" / "old").write_bytes(bytes(64 * 2**20))
    return folder


def watch(folder: Path, *, reserve_mb: int = ALL_MB) -> Disk:
    """Return a watch of a run that begins, and the kernel's next tick, by which files are stamped, has come."""
    beside = folder.parent / "beside"
    beside.mkdir(exist_ok=True)
    it = Disk(folder, beside=beside, reserve_mb=reserve_mb)
    it.begin()
    clock = folder.parent / "clock"
    while True:
        clock.write_bytes(b"x")
        if clock.stat().st_ctime > it._since:
            return it


def test_who_writes_much_while_the_disk_is_short_has_to_end(tmp_path: Path) -> None:
    """Only what the run itself wrote counts, in all folders of all volumes together; a little may always be written."""
    folder = volumes(tmp_path)
    it = watch(folder)
    assert not it.overrun(0.0), "what was there before is not the run's"
    (folder / "notes" / "deep" / "a").write_bytes(bytes((OWN_MB - 2) * 2**20))
    assert not it.overrun(10.0)
    (folder / "maps" / "deep" / "b").write_bytes(bytes(4 * 2**20))
    assert it.overrun(20.0)


def test_the_cache_is_watched_as_volumes_are(tmp_path: Path) -> None:
    """What a run caches counts with what it writes into volumes."""
    cache, beside = tmp_path / "cache", tmp_path / "beside"
    cache.mkdir()
    beside.mkdir()
    it = Disk(tmp_path / "no volumes", cache, beside=beside, reserve_mb=ALL_MB)
    it.begin()
    it._since -= 1.0
    assert not it.overrun(0.0)
    (cache / "decoded").write_bytes(bytes((OWN_MB + 1) * 2**20))
    assert it.overrun(10.0)


def counted(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Count how often the volumes are gone through."""
    real, walks = Disk._written, []

    def written(self: Disk, folders: list[Path], most_mb: int, most_files: int) -> bool:
        walks.extend(each.name for each in folders if each.name == "maps")
        return real(self, folders, most_mb, most_files)

    monkeypatch.setattr(Disk, "_written", written)
    return walks


def test_where_there_is_room_nothing_is_looked_at(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Enough is left: the volumes are not even gone through, however much the run writes."""
    folder = volumes(tmp_path)
    walks = counted(monkeypatch)
    it = watch(folder, reserve_mb=1)
    (folder / "notes" / "a").write_bytes(bytes(2 * OWN_MB * 2**20))
    assert not it.overrun(0.0)
    assert not walks


def test_files_are_looked_at_once_a_second(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """While the disk is short the volumes are gone through now and then, not at each look."""
    it = watch(volumes(tmp_path))
    walks = counted(monkeypatch)
    for tenths in range(25):
        it.overrun(tenths / 10)
    assert len(walks) == 3
    assert WALK_S == 1.0


def test_beside_the_socket_nothing_is_to_be_written(tmp_path: Path) -> None:
    """There a megabyte is too much however much room there is, with volumes or without."""
    (tmp_path / "none").mkdir()
    for folder in (volumes(tmp_path), tmp_path / "none"):
        it = watch(folder, reserve_mb=0)
        assert not it.overrun(0.0)
        (tmp_path / "beside" / "a").write_bytes(bytes(2**19))
        assert not it.overrun(1.0)
        (tmp_path / "beside" / "b").write_bytes(bytes(2**20))
        assert it.overrun(2.0)


@pytest.mark.parametrize("bound", ["OWN_FILES", "MOST_WALKED"])
def test_files_without_number(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bound: str) -> None:
    """Empty files take inodes: many of the run's own end it, and so does a volume too large to be gone through."""
    folder = volumes(tmp_path)
    monkeypatch.setattr(disk, bound, 20)
    it = watch(folder)
    assert not it.overrun(0.0)
    for number in range(30):
        (folder / "notes" / str(number)).touch()
    assert it.overrun(10.0)


def test_what_is_hidden_counts_as_written(tmp_path: Path) -> None:
    """A folder that the run has closed to everybody, itself included, hides what is in it; a dead link is no error."""
    folder = volumes(tmp_path)
    it = watch(folder)
    hidden = folder / "notes" / "deep"
    hidden.chmod(0)
    try:
        if os.access(hidden, os.R_OK):
            pytest.skip("nothing is closed to root")
        assert it.overrun(0.0)
    finally:
        hidden.chmod(0o700)
    (folder / "maps" / "gone").symlink_to("nowhere")
    assert not watch(folder).overrun(0.0)


def test_volumes_without_a_reserve(tmp_path: Path) -> None:
    """With a reserve of 0 volumes are not watched, nor where there are none."""
    folder = volumes(tmp_path)
    it = watch(folder, reserve_mb=0)
    (folder / "notes" / "a").write_bytes(bytes(2 * OWN_MB * 2**20))
    assert not it.overrun(0.0)
    assert not Disk(tmp_path / "not there", beside=tmp_path / "not there either", reserve_mb=1).overrun(0.0)


def test_inodes_that_run_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A disk with bytes left and hardly an inode is short; one that has no bound on them is not."""
    folder = volumes(tmp_path)
    real = os.statvfs(folder)

    def few(_: object) -> os.statvfs_result:
        values = list(real)
        values[5:8] = counts
        return os.statvfs_result((*values, real.f_fsid))

    monkeypatch.setattr(os, "statvfs", few)
    it = watch(folder, reserve_mb=1)
    (folder / "notes" / "a").write_bytes(bytes(2 * OWN_MB * 2**20))
    counts = (0, 0, 0)
    assert not it.overrun(0.0)
    counts = (10**6, 100, 100)
    assert it.overrun(10.0)
