"""Files of keys and certificates: written whole or not at all, and private ones readable by their owner alone."""

import fcntl
import os
import stat
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from appliance import durable
from appliance.errors import ConflictError, IdentityError

PRIVATE = 0o600
PUBLIC = 0o644
FOLDER = 0o700
MOST_BYTES = 65_536
"""Of a file of keys and certificates."""


def write(path: Path, data: bytes, *, mode: int, replace: bool = True) -> None:
    """Write a file: after a power cut there is the old one or the new one.

    Args:
        path: where.
        data: all of it.
        mode: permission bits, from the first byte on.
        replace: whether one that is there may be replaced; ConflictError otherwise.
    """
    try:
        durable.write(path, data, mode=mode, replace=replace)
    except FileExistsError:
        raise ConflictError(f"{path} exists", remedy="remove it, or name another file with --out") from None
    except OSError as error:
        raise _unwritable(path, error) from error


def make_folder(path: Path) -> None:
    """Make a folder for private files, with those above it, unless it is there; IdentityError where that fails."""
    try:
        path.mkdir(mode=FOLDER, parents=True, exist_ok=True)
    except OSError as error:
        raise _unwritable(path, error) from error


def _unwritable(path: Path, error: OSError) -> IdentityError:
    return IdentityError(f"{path} cannot be written: {error.strerror}", remedy="name a folder that this user may write")


def read(path: Path, *, private: bool, absent: str, most: int = MOST_BYTES) -> bytes:
    """Read a file.

    Args:
        path: where.
        private: whether its owner alone may read it.
        absent: what to do where there is none.
        most: bytes that it may have.

    Raises:
        IdentityError: there is none, it cannot be read, is too large, or a private one is open to others.
    """
    try:
        with path.open("rb") as file:
            about = os.fstat(file.fileno())
            if private and stat.S_IMODE(about.st_mode) & 0o077:
                raise IdentityError(
                    f"{path} holds a private key, and its mode {stat.S_IMODE(about.st_mode):04o} lets others read it",
                    remedy=f"chmod 600 {path}; if others had access to it, revoke it and issue another",
                )
            data = file.read(most + 1)
    except FileNotFoundError:
        raise IdentityError(f"there is no {path}", remedy=absent) from None
    except OSError as error:
        raise IdentityError(
            f"{path} cannot be read: {error.strerror}", remedy="it must belong to the user that runs this"
        ) from error
    if len(data) > most:
        raise IdentityError(f"{path} has more than {most:,} bytes", remedy="that is no file of keys")
    return data


@contextmanager
def locked(folder: Path) -> Generator[None]:
    """Keep others from changing a folder meanwhile.

    Raises:
        ConflictError: another command is changing it.
        IdentityError: it cannot be written.
    """
    try:
        handle = os.open(folder / ".lock", os.O_RDWR | os.O_CREAT, PRIVATE)
    except OSError as error:
        raise _unwritable(folder, error) from error
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ConflictError(f"another command is changing {folder}", remedy="try again once it is done") from None
        yield
    finally:
        os.close(handle)
