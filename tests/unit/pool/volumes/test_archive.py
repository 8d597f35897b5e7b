"""Archives of volumes: the same state gives the same bytes, all comes back, and nothing hostile is made."""

import contextlib
import io
import os
import stat
import tarfile
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from appliance.errors import PayloadError, RefusedError, SwiftbotError
from appliance.model.transfer_api import Manifest
from appliance.pool.volumes.archive import check_link, fingerprint, pack, unpack

CHUNK = 16 * 1024


def packed(root: Path, target: Path, *, most_files: int = 1000, most_bytes: int = 2**24) -> Manifest:
    """Pack with small limits."""
    return pack(root, target, name="v", chunk_bytes=CHUNK, most_files=most_files, most_bytes=most_bytes)


def unpacked(archive: Path, target: Path, *, most_files: int = 1000, most_bytes: int = 2**24) -> int:
    """Unpack with small limits."""
    target.mkdir()
    return unpack(archive, target, most_files=most_files, most_bytes=most_bytes)


def test_all_comes_back_and_gives_the_same_bytes_again(tmp_path: Path) -> None:
    """Files, folders, modes, times and links come back; the archive of the copy is the same, byte for byte."""
    root = tmp_path / "root"
    (root / "a" / "b").mkdir(parents=True)
    (root / "a" / "b" / "big").write_bytes(os.urandom(3 * CHUNK + 5))
    (root / "empty").touch()
    (root / "ä\udcff").write_text("a name that is no UTF-8")
    (root / "run").write_text("x")
    (root / "run").chmod(0o4755)
    (root / "a" / "latest").symlink_to("b/big")
    (root / "closed").write_text("secret")
    (root / "closed").chmod(0)
    os.utime(root / "run", ns=(10**9, 1_500_000_000_700_000_000))
    os.mkfifo(root / "pipe")
    one = packed(root, tmp_path / "one")
    assert unpacked(tmp_path / "one", tmp_path / "copy") == 3 * CHUNK + 5 + len("a name that is no UTF-8x" + "secret")
    assert packed(tmp_path / "copy", tmp_path / "two") == one
    assert (tmp_path / "one").read_bytes() == (tmp_path / "two").read_bytes()
    copy = tmp_path / "copy"
    assert (copy / "a" / "latest").readlink() == Path("b/big")
    assert stat.S_IMODE((copy / "run").stat().st_mode) == 0o755
    assert stat.S_IMODE((copy / "closed").stat().st_mode) == stat.S_IMODE((root / "closed").stat().st_mode) == 0
    assert (copy / "run").stat().st_mtime == 1_500_000_000
    assert not (copy / "pipe").exists()


def test_what_did_not_change_keeps_its_chunks(tmp_path: Path) -> None:
    """Files written again, new folders and links come behind: all chunks of the older files stay, also of a copy."""
    root, copy = tmp_path / "root", tmp_path / "copy"
    (root / "d").mkdir(parents=True)
    for number in range(4):
        (root / "d" / f"f{number}").write_bytes(bytes([number]) * 2 * CHUNK)
        os.utime(root / "d" / f"f{number}", (number, number))
    (root / "a-link").symlink_to("d")
    before = packed(root, tmp_path / "one")
    unpacked(tmp_path / "one", copy)
    (copy / "d" / "f3").write_bytes(b"y" * CHUNK)
    (copy / "b" / "c").mkdir(parents=True)
    (copy / "b" / "c" / "new").write_bytes(b"new")
    (copy / "another-link").symlink_to("d")
    (copy / "empty").mkdir()
    after = packed(copy, tmp_path / "two")
    whole = 3 * 2 * CHUNK // CHUNK
    assert [after.chunk(index) for index in range(whole)] == [before.chunk(index) for index in range(whole)]


def test_a_small_file_of_the_same_second_moves_no_large_one(tmp_path: Path) -> None:
    """An archive knows seconds, and a run may write its note in the one in which the weights were written."""
    root = tmp_path / "root"
    root.mkdir()
    (root / "weights").write_bytes(b"w" * 4 * CHUNK)
    os.utime(root / "weights", (7, 7))
    before = packed(root, tmp_path / "one")
    (root / "note").write_bytes(b"seen")
    os.utime(root / "note", (7, 7))
    after = packed(root, tmp_path / "two")
    assert [after.chunk(index) for index in range(4)] == [before.chunk(index) for index in range(4)]


def test_fingerprint_sees_every_kind_of_change(tmp_path: Path) -> None:
    """Content in place with its old time, mode, name, link and emptiness change the fingerprint; looking does not."""
    root = tmp_path / "root"
    (root / "d").mkdir(parents=True)
    file = root / "d" / "f"
    file.write_text("one")
    os.utime(file, (5, 5))
    seen = [fingerprint(root, most_files=100)]
    assert fingerprint(root, most_files=100) == seen[0]
    assert seen[0][1] == 3

    def changed() -> None:
        now = fingerprint(root, most_files=100)
        assert now not in seen
        seen.append(now)

    file.write_text("two")
    os.utime(file, (5, 5))
    changed()
    file.chmod(0o600)
    changed()
    file.rename(root / "d" / "g")
    changed()
    (root / "l").symlink_to("d")
    changed()
    (root / "e").mkdir()
    changed()


def test_limits_of_packing(tmp_path: Path) -> None:
    """Too many files, too many bytes and links that lead outside are refused, and no archive is left."""
    root, target = tmp_path / "root", tmp_path / "one"
    root.mkdir()
    (root / "a").write_bytes(bytes(100))
    (root / "b").write_bytes(bytes(100))
    for limits in ({"most_files": 1}, {"most_bytes": 150}):
        with pytest.raises(RefusedError):
            packed(root, target, **limits)
    (root / "l").symlink_to("/etc/passwd")
    with pytest.raises(RefusedError, match="outside"):
        packed(root, target)
    assert not target.exists()


@given(path=st.lists(st.sampled_from("ab"), min_size=1, max_size=4), target=st.lists(st.sampled_from(["..", ".", "a"])))
def test_links_are_judged_as_the_system_would(path: list[str], target: list[str]) -> None:
    """A link is taken exactly when no step of it leaves the volume."""
    place, inside = len(path) - 1, bool(target)
    for part in target:
        place += {"..": -1, ".": 0, "a": 1}[part]
        inside = inside and place >= 0
    try:
        check_link("/".join(path), "/".join(target))
    except RefusedError:
        assert not inside
    else:
        assert inside


def member(name: str, kind: bytes = tarfile.REGTYPE, *, size: int = 0, link: str = "") -> tarfile.TarInfo:
    """Return a member as somebody else may have made it."""
    info = tarfile.TarInfo(name)
    info.type, info.size, info.linkname = kind, size, link
    return info


HOSTILE = [
    [member("../out")],
    [member("/etc/passwd")],
    [member("a/../../out")],
    [member("a/./b")],
    [member("")],
    [member("no/folder")],
    [member("twice"), member("twice")],
    [member("dev", tarfile.CHRTYPE)],
    [member("dev", tarfile.BLKTYPE)],
    [member("pipe", tarfile.FIFOTYPE)],
    [member("a"), member("hard", tarfile.LNKTYPE, link="a")],
    [member("hard", tarfile.LNKTYPE, link="/etc/passwd")],
    [member("soft", tarfile.SYMTYPE, link="/etc/passwd")],
    [member("soft", tarfile.SYMTYPE, link="../../etc/passwd")],
    [member("soft", tarfile.SYMTYPE, link="."), member("soft/file")],
    [member("soft", tarfile.SYMTYPE, link="."), member("soft")],
    [member("x" * 300)],
    [member("/".join("d" * 100))],
    [member("odd", b"V")],
    [member("cont", tarfile.CONTTYPE)],
    [member("sparse", tarfile.GNUTYPE_SPARSE)],
]


@pytest.mark.parametrize("members", HOSTILE, ids=lambda members: ascii(members[-1].name[:20]) + repr(members[-1].type))
def test_hostile_members_are_refused(members: list[tarfile.TarInfo], tmp_path: Path) -> None:
    """What would lie outside, or is no plain file, folder or inner link, is refused, and nothing is made outside."""
    archive = tmp_path / "archive"
    with tarfile.open(archive, "w", format=tarfile.GNU_FORMAT) as tar:
        for each in members:
            tar.addfile(each)
    before = sorted(tmp_path.iterdir())
    with pytest.raises((PayloadError, RefusedError)):
        unpacked(archive, tmp_path / "target")
    assert sorted(tmp_path.iterdir()) == sorted([*before, tmp_path / "target"])


def test_names_and_sizes_that_eat_memory_or_disk(tmp_path: Path) -> None:
    """A name of gigabytes is not read, a bomb of files or bytes ends at its bound, a cut archive is refused."""
    info = tarfile.TarInfo("././@LongLink")
    info.type, info.size = tarfile.GNUTYPE_LONGNAME, 2**33
    (tmp_path / "name").write_bytes(info.tobuf(tarfile.GNU_FORMAT) + bytes(4096))
    big = tarfile.TarInfo("big")
    big.size = 2**40
    (tmp_path / "big").write_bytes(big.tobuf(tarfile.GNU_FORMAT) + bytes(4096))
    cut = tarfile.TarInfo("cut")
    cut.size = 2**20
    (tmp_path / "cut").write_bytes(cut.tobuf(tarfile.GNU_FORMAT) + bytes(4096))
    with tarfile.open(tmp_path / "many", "w") as tar:
        for number in range(30):
            tar.addfile(tarfile.TarInfo(f"f{number}"))
    for name, limits in {"name": {}, "big": {}, "cut": {}, "many": {"most_files": 20}}.items():
        with pytest.raises((PayloadError, RefusedError)):
            unpacked(tmp_path / name, tmp_path / f"{name}-target", **limits)


@given(noise=st.binary(max_size=3000), at=st.integers(0, 20_000))
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_noise_is_unpacked_or_refused(noise: bytes, at: int, tmp_path: Path) -> None:
    """An archive with any bytes anywhere is unpacked below its folder or refused with one of our errors."""
    work = tmp_path / os.urandom(8).hex()
    root = work / "root"
    root.mkdir(parents=True)
    (root / "a").write_bytes(bytes(range(256)) * 40)
    (root / "d").mkdir()
    packed(root, work / "archive")
    out = io.BytesIO((work / "archive").read_bytes())
    out.seek(at)
    out.write(noise)
    (work / "archive").write_bytes(out.getvalue())
    with contextlib.suppress(SwiftbotError):
        unpacked(work / "archive", work / "target")
    assert sorted(each.name for each in work.iterdir()) == ["archive", "root", "target"]
