"""Files that are whole after a power cut: each is written beside its place, synced, renamed, and its folder synced.

A rename alone is not enough. Without the sync before it the new name may stand for a file of 0 bytes, and systemd takes
a unit of 0 bytes for one that is masked; without the sync of the folder the rename itself may be lost.

Standard library only: the installer runs it before there is an environment. OSError comes out as it is; callers know
what the person should do about it.
"""

import contextlib
import errno
import os
import secrets
import shutil
import stat
from pathlib import Path

NEW = ".new"
"""Ending of what is not in its place yet."""


def beside(path: Path) -> Path:
    """Return a name in the same folder, hidden, for what will be renamed to `path`.

    Raises:
        IsADirectoryError: `path` has no name, such as `.` or `/`: it is a folder, whatever is on the disk.
    """
    if not path.name:
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}{NEW}")


def write(path: Path, data: bytes, *, mode: int, replace: bool = True) -> None:
    """Write a file: after a power cut there is the old one or the new one.

    Args:
        path: where.
        data: all of it.
        mode: permission bits, from the first byte on.
        replace: whether one that is there may be replaced; FileExistsError otherwise.
    """
    temporary = beside(path)
    try:
        handle = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, mode)
        with os.fdopen(handle, "wb") as file:
            os.fchmod(file.fileno(), mode)
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        if replace:
            temporary.replace(path)
        else:
            _place_new(temporary, path)
        sync_folder(path.parent)
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def _place_new(temporary: Path, path: Path) -> None:
    """Give a file its name; FileExistsError where that is taken."""
    try:
        os.link(temporary, path)
    except OSError as error:
        if error.errno not in (errno.EPERM, errno.EOPNOTSUPP):
            raise
        # A stick with FAT has no second names for a file.
        if os.path.lexists(path):
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path)) from None
        temporary.replace(path)
    else:
        temporary.unlink()


def link(path: Path, target: str) -> None:
    """Make a symbolic link, or let one point elsewhere, or replace a file by one: it is the old or the new."""
    if path.is_symlink() and str(path.readlink()) == target:
        return
    temporary = beside(path)
    try:
        temporary.symlink_to(target)
        temporary.replace(path)
        sync_folder(path.parent)
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def remove(path: Path) -> None:
    """Remove a file or link for good; nothing where there is none."""
    if path.is_symlink() or path.exists():
        path.unlink()
        sync_folder(path.parent)


def make_folder(path: Path, *, mode: int) -> None:
    """Make a folder with those above it (0755), so that what is renamed into it cannot be lost with it."""
    for each in (*reversed(path.parents), path):
        if not each.is_dir():
            each.mkdir(mode=mode if each == path else 0o755)
            sync_folder(each.parent)


def rename(source: Path, target: Path) -> None:
    """Rename a file or folder within one file system, for good."""
    source.replace(target)
    sync_folder(target.parent)
    if source.parent != target.parent:
        sync_folder(source.parent)


def sync_file(path: Path) -> None:
    """Write a file's content to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def sync_folder(folder: Path) -> None:
    """Write the names in a folder to the disk."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def sync_tree(folder: Path) -> None:
    """Write all files and names below a folder to the disk."""
    for found, _, names in os.walk(folder):
        at = Path(found)
        for name in names:
            file = at / name
            if stat.S_ISREG(file.lstat().st_mode):
                sync_file(file)
        sync_folder(at)


def clear(folder: Path, name: str = "") -> None:
    """Remove what writes that were cut off have left in a folder; `name`: only what was to get that name."""
    for left in folder.glob(f".{name}*{NEW}"):
        if left.is_dir() and not left.is_symlink():
            shutil.rmtree(left)
        else:
            left.unlink()
