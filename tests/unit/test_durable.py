"""Files that are whole after a power cut, on file systems with and without second names."""

import errno
import os
from pathlib import Path

import pytest

from appliance import durable


@pytest.mark.parametrize("code", [0, errno.EPERM, errno.EOPNOTSUPP])
def test_a_new_file_replaces_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int) -> None:
    """With `replace=False` a file is written once, also where the file system has no hard links, as FAT."""

    def refused(_source: Path, _target: Path) -> None:
        raise OSError(code, os.strerror(code))

    if code:
        monkeypatch.setattr(os, "link", refused)
    path = tmp_path / "file"
    durable.write(path, b"first", mode=0o600, replace=False)
    with pytest.raises(FileExistsError):
        durable.write(path, b"second", mode=0o600, replace=False)
    assert (path.read_bytes(), path.stat().st_mode & 0o777) == (b"first", 0o600)
    assert list(tmp_path.iterdir()) == [path]
