"""Layers that depend on their content only, and what is in an image."""

import hashlib
import io
import json
import tarfile
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import PrerequisiteError
from appliance.pool import oci
from appliance.pool.oci import Package

MADE = 1_735_689_600
STATUS = """\
Package: bash
Status: install ok installed
Version: 5.2-1
Architecture: amd64
Description: a shell
 Package: not this

Package: gone
Status: deinstall ok config-files
Version: 1
Architecture: all
"""
LISTS = """\
Package: bash
Version: 5.2-1
Architecture: amd64
SHA256: {digest}

Package: bash
Version: 5.2-2
Architecture: amd64
SHA256: {other}
"""


def member(name: str, kind: bytes = tarfile.REGTYPE, link: str = "", mode: int = 0o644) -> tarfile.TarInfo:
    """Return a member of a root filesystem's archive."""
    info = tarfile.TarInfo(name)
    info.type, info.linkname, info.mode = kind, link, mode
    return info


CONTENTS: dict[str, tuple[tarfile.TarInfo, bytes]] = {
    "./": (member("./", tarfile.DIRTYPE, mode=0o755), b""),
    "./etc": (member("./etc", tarfile.DIRTYPE, mode=0o755), b""),
    "./etc/hostname": (member("./etc/hostname"), b"one\n"),
    "./etc/shadow": (member("./etc/shadow", mode=0o640), b"root:*:20089::::::\n"),
    "./etc/x": (member("./etc/x", tarfile.SYMTYPE, "shadow"), b""),
    "./usr": (member("./usr", tarfile.DIRTYPE, mode=0o755), b""),
    "./usr/share": (member("./usr/share", tarfile.DIRTYPE, mode=0o755), b""),
    "./usr/zz": (member("./usr/zz"), b"content"),
    "./usr/link": (member("./usr/link", tarfile.LNKTYPE, "./usr/zz"), b""),
    "./usr/share/a": (member("./usr/share/a", tarfile.LNKTYPE, "./usr/zz"), b""),
    "./var/log": (member("./var/log", tarfile.DIRTYPE, mode=0o755), b""),
    "./var/log/x": (member("./var/log/x"), b"at noon"),
}


def archive(path: Path, names: list[str], *, at: float = 0.0, owner: str = "", said: bytes = b"") -> Path:
    """Write members in an order, all of one time; `said` is in the files that a machine writes for itself."""
    with tarfile.open(path, "w", format=tarfile.PAX_FORMAT) as tar:
        for name in names:
            info, data = CONTENTS[name]
            data += said if name in ("./etc/hostname", "./var/log/x") else b""
            info.mtime, info.uname, info.size = at, owner, len(data)
            info.pax_headers = {"SCHILY.xattr.user.x": "y"} if name == "./etc/shadow" else {}
            tar.addfile(info, io.BytesIO(data))
    return path


def layer(folder: Path, source: Path) -> bytes:
    """Return the layer that is made of an archive."""
    path = folder / "layer"
    digest, size = oci.write_layer(source, path, made=MADE, extra={"usr/share/list": b"bash 5\n"})
    data = path.read_bytes()
    assert (digest, size) == (hashlib.sha256(data).hexdigest(), len(data))
    return data


@given(data=st.data(), at=st.floats(0, 2**31), said=st.binary(max_size=9))
def test_the_same_content_makes_the_same_layer(
    data: st.DataObject, at: float, said: bytes, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Whatever the order, times, names of owners, host name and logs, as on two machines at two times."""
    folder = tmp_path_factory.mktemp("layers")
    links = ["./usr/link", "./usr/share/a"]  # an archive names a file's content first
    others = [name for name in CONTENTS if name not in links]
    order = [*data.draw(st.permutations(others)), *data.draw(st.permutations(links))]
    one = layer(folder, archive(folder / "one", list(CONTENTS)))
    assert one == layer(folder, archive(folder / "other", order, at=at, owner="operator", said=said))


def test_what_a_layer_has_in_it(tmp_path: Path) -> None:
    """Sorted, of one time; modes, links and attributes stay, and content comes before the names that link to it."""
    data = layer(tmp_path, archive(tmp_path / "root", list(CONTENTS), at=1.5, owner="root"))
    with tarfile.open(fileobj=io.BytesIO(data)) as tar:
        members = {each.name: each for each in tar}
        assert list(members) == [
            ".", "etc", "etc/shadow", "etc/x", "usr", "usr/link", "usr/share", "usr/share/a", "usr/share/list",
            "usr/zz", "var/log",
        ]  # fmt: skip
        assert {(each.mtime, each.uname, each.gname) for each in members.values()} == {(MADE, "", "")}
        assert members["etc/shadow"].mode == 0o640
        assert members["etc/shadow"].pax_headers == {"SCHILY.xattr.user.x": "y"}
        assert members["etc/x"].linkname == "shadow"
        for name in ("usr/link", "usr/share/a", "usr/zz"):
            file = tar.extractfile(name)
            assert file is not None
            assert file.read() == b"content"
        assert members["usr/link"].isreg()
        assert members["usr/zz"].linkname == "usr/link"


def test_another_content_makes_another_layer(tmp_path: Path) -> None:
    """A file that is missing, or a mode, changes the digest."""
    names = list(CONTENTS)
    assert layer(tmp_path, archive(tmp_path / "one", names)) != layer(
        tmp_path, archive(tmp_path / "other", [name for name in names if name != "./etc/x"])
    )


def test_the_configuration_is_the_same_at_any_time() -> None:
    """It has the time that it is given; its digest is the image's id."""
    config = oci.configuration("a" * 64, made=MADE)
    assert config == oci.configuration("a" * 64, made=MADE)
    read = json.loads(config)
    assert read["created"] == "2025-01-01T00:00:00Z"
    assert read["rootfs"]["diff_ids"] == [f"sha256:{'a' * 64}"]


def root_with(folder: Path, status: str) -> Path:
    """Write a root filesystem's archive with that status of packages."""
    path = folder / "root.tar"
    with tarfile.open(path, "w") as tar:
        info = tarfile.TarInfo("./var/lib/dpkg/status")
        info.size = len(status)
        tar.addfile(info, io.BytesIO(status.encode()))
    return path


def test_packages_are_listed_with_their_digests(tmp_path: Path) -> None:
    """Those that are installed, in the version that is installed; the listing has a line for each."""
    lists = tmp_path / "lists"
    lists.mkdir()
    (lists / "host_Packages").write_text(LISTS.format(digest="1" * 64, other="2" * 64))
    found = oci.packages(root_with(tmp_path, STATUS), lists)
    assert found == (Package("bash", "5.2-1", "amd64", "1" * 64),)
    assert oci.listing(found) == f"bash 5.2-1 amd64 {'1' * 64}\n".encode()


def test_a_package_that_no_list_knows(tmp_path: Path) -> None:
    """It cannot be told what the image is made of; the message names the package."""
    with pytest.raises(PrerequisiteError, match=r"no digest of bash 5\.2-1"):
        oci.packages(root_with(tmp_path, STATUS), tmp_path)
    with tarfile.open(tmp_path / "empty.tar", "w"):
        pass
    with pytest.raises(PrerequisiteError, match="has no list of packages"):
        oci.packages(tmp_path / "empty.tar", tmp_path)
