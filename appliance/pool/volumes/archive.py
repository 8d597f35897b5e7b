"""A volume's files as one tar archive, and back: the same state gives the same bytes on every gateway.

Files come in the order of their age: what did not change since the last transfer keeps its place at the front,
and with it its chunks. Only plain files, folders and symbolic links that stay inside are moved; the owner is
always the service user (root in a container), times are whole seconds. An archive of somebody else is believed
in nothing: whatever would end up outside, or is anything else, is refused before it is made.
"""

import errno
import hashlib
import os
import stat
import tarfile
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import BinaryIO, cast

from msgspec import Struct

from appliance.errors import PayloadError, RefusedError
from appliance.model.transfer_api import Manifest
from appliance.pool.volumes.protocol import root_digest

_COPY = 2**20
_HEADERS = 64 * 2**10
"""Largest piece tarfile may want at once for names: its long names would be read whole, however long."""
_MOST_DEPTH = 64
_MOST_PATH = 1024
_LATEST = 2**33
FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
"""What the system says when there is no more room."""


class Entry(Struct, frozen=True):
    """A file, folder or link of a volume. `path` is relative, with slashes."""

    path: str
    mode: int
    size: int
    mtime_ns: int
    ctime_ns: int
    inode: int
    target: str = ""


class _Walk:
    """Everything below a folder, links never followed, in a fixed order; special files are left out."""

    def __init__(self, root: Path, *, most_files: int) -> None:
        self._root, self._most = root, most_files

    def entries(self) -> list[Entry]:
        found: list[Entry] = []
        for path, folder, names in self._folders():
            prefix = f"{path}/" if path else ""
            for name in names:
                status = os.stat(name, dir_fd=folder, follow_symlinks=False)
                kind = stat.S_IFMT(status.st_mode)
                if kind not in (stat.S_IFREG, stat.S_IFDIR, stat.S_IFLNK):
                    continue  # a socket or pipe is no state
                if len(found) >= self._most:
                    raise RefusedError(
                        f"more than {self._most:,} files in {self._root}", remedy="raise pool.transfer.most_files"
                    )
                target = os.readlink(name, dir_fd=folder) if kind == stat.S_IFLNK else ""
                size = status.st_size if kind == stat.S_IFREG else 0
                found.append(
                    Entry(
                        prefix + name,
                        status.st_mode,
                        size,
                        status.st_mtime_ns,
                        status.st_ctime_ns,
                        status.st_ino,
                        target,
                    )
                )
        return found

    def _folders(self) -> Iterator[tuple[str, int, list[str]]]:
        for base, folders, files, folder in os.fwalk(self._root, onerror=self._cannot):
            folders.sort()
            path = Path(base).relative_to(self._root).as_posix()
            yield ("" if path == "." else path), folder, sorted(folders + files)

    def _cannot(self, error: OSError) -> None:
        raise _unreadable(error, str(error.filename)) from error


def _unreadable(error: OSError, path: Path | str) -> RefusedError:
    return RefusedError(
        f"{path} cannot be read: {error.strerror}",
        remedy="files of a state volume must be readable for the container's root user",
    )


def fingerprint(root: Path, *, most_files: int) -> tuple[str, int]:
    """Return a hash of all names, modes, sizes, times and inodes below a folder, and the bytes of its files.

    Nothing is read of the files themselves: 10,000 files take some 50 ms.

    Raises:
        RefusedError: too many files, or a folder that cannot be read.
    """
    digest, size = hashlib.sha256(), 0
    _open_up(root)
    for each in sorted(_Walk(root, most_files=most_files).entries(), key=lambda entry: entry.path):
        digest.update(repr(each).encode())
        size += each.size
    return digest.hexdigest(), size


def _open_up(root: Path) -> None:
    """Make every folder readable for its owner; a skill may have closed one."""
    for base, folders, _ in os.walk(root):
        for name in folders:
            path = Path(base, name)
            mode = path.lstat().st_mode
            if stat.S_ISDIR(mode) and mode & 0o700 != 0o700:
                try:
                    _change_mode(path, mode | 0o700)
                except PermissionError as error:
                    raise _unreadable(error, path) from error


def _change_mode(path: Path, mode: int) -> None:
    """Change the mode of what is there, never of what a link leads to."""
    handle = os.open(path, os.O_PATH | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        Path(f"/proc/self/fd/{handle}").chmod(stat.S_IMODE(mode))
    finally:
        os.close(handle)


class Digests:
    """SHA-256 of each chunk of what passes by."""

    def __init__(self, chunk_bytes: int) -> None:
        self._chunk_bytes = self._room = chunk_bytes
        self._hash = hashlib.sha256()
        self._digests = bytearray()
        self.size = 0

    def update(self, data: bytes) -> None:
        """Take the next piece, of any size."""
        self.size += len(data)
        view = memoryview(data)
        while view:
            part, view = view[: self._room], view[self._room :]
            self._hash.update(part)
            self._room -= len(part)
            if not self._room:
                self._end()

    def _end(self) -> None:
        self._digests += self._hash.digest()
        self._hash, self._room = hashlib.sha256(), self._chunk_bytes

    def manifest(self, kind: str, name: str) -> Manifest:
        """Return the manifest of all that passed."""
        if self._room != self._chunk_bytes:
            self._end()
        chunks = bytes(self._digests)
        digest = root_digest(self.size, self._chunk_bytes, chunks)
        return Manifest(
            kind=kind, name=name, digest=digest, size_bytes=self.size, chunk_bytes=self._chunk_bytes, chunks=chunks
        )


class _Writer:
    """A file for tarfile to write to that digests what passes."""

    def __init__(self, out: BinaryIO, digests: Digests) -> None:
        self._out, self._digests = out, digests

    def write(self, data: bytes) -> int:
        self._digests.update(data)
        return self._out.write(data)

    def tell(self) -> int:
        return self._digests.size


def pack(root: Path, target: Path, *, name: str, chunk_bytes: int, most_files: int, most_bytes: int) -> Manifest:
    """Write a volume's files into an archive and return its manifest. Blocks.

    Raises:
        RefusedError: too many files or bytes, a link that leads outside, a file of another user, no room.
    """
    _open_up(root)
    entries = _Walk(root, most_files=most_files).entries()
    if (size := sum(each.size for each in entries)) > most_bytes:
        raise RefusedError(
            f"volume {name} has {size:,} bytes, more than the {most_bytes:,} that are moved",
            remedy="raise pool.transfer.most_mb",
        )
    digests = Digests(chunk_bytes)
    try:
        with target.open("wb") as out:
            writer = cast("BinaryIO", _Writer(out, digests))
            with tarfile.TarFile(fileobj=writer, mode="w", format=tarfile.PAX_FORMAT, copybufsize=_COPY) as tar:
                for each in _ordered(entries):
                    _add(tar, root, each)
    except OSError as error:
        target.unlink(missing_ok=True)
        raise no_room(error, f"volume {name}") from error
    except BaseException:
        target.unlink(missing_ok=True)
        raise
    return digests.manifest("volume", name)


def _ordered(entries: list[Entry]) -> Iterator[Entry]:
    """Files by age, each folder before the first that lies in it; then empty folders, then links.

    So what is new stands behind what is old, and the old keeps its place in the archive and its chunks. An archive
    knows whole seconds alone: of files of one second the largest stand first, since they lose most by moving.
    """
    folders = {each.path: each for each in entries if stat.S_ISDIR(each.mode)}
    files = [each for each in entries if stat.S_ISREG(each.mode)]
    for file in sorted(files, key=lambda each: (_seconds(each), -each.size, each.path)):
        for parent in reversed(PurePosixPath(file.path).parents):
            if (folder := folders.pop(parent.as_posix(), None)) is not None:
                yield folder
        yield file
    yield from (folders[path] for path in sorted(folders))
    yield from sorted((each for each in entries if stat.S_ISLNK(each.mode)), key=lambda each: each.path)


def _seconds(entry: Entry) -> int:
    return max(0, min(entry.mtime_ns // 10**9, _LATEST))


def _add(tar: tarfile.TarFile, root: Path, entry: Entry) -> None:
    info = tarfile.TarInfo(entry.path)
    info.mode, info.mtime = entry.mode & 0o777, _seconds(entry)
    if stat.S_ISDIR(entry.mode):
        info.type, info.mtime = tarfile.DIRTYPE, 0
        tar.addfile(info)
    elif stat.S_ISLNK(entry.mode):
        check_link(entry.path, entry.target)
        info.type, info.linkname, info.mode, info.mtime = tarfile.SYMTYPE, entry.target, 0o777, 0
        tar.addfile(info)
    else:
        info.size = entry.size
        with _open_file(root / entry.path, entry) as file:
            tar.addfile(info, file)
            if file.read(1):
                raise RefusedError(f"{entry.path} grew while it was read", remedy="ask again when no run uses it")


def _open_file(path: Path, entry: Entry) -> BinaryIO:
    """Open a file that a container made: never a link in its place, also where its owner closed it to himself."""
    flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC
    try:
        return os.fdopen(os.open(path, flags), "rb")
    except PermissionError as error:
        try:
            _change_mode(path, entry.mode | stat.S_IRUSR)
        except PermissionError:
            raise _unreadable(error, path) from error
        try:
            return os.fdopen(os.open(path, flags), "rb")
        finally:
            _change_mode(path, entry.mode)


def check_link(path: str, target: str) -> None:
    """Check that a symbolic link leads to somewhere inside; RefusedError otherwise."""
    depth = len(PurePosixPath(path).parts) - 1
    inside = bool(target) and not target.startswith("/") and len(target) <= _MOST_PATH and "\0" not in target
    for part in PurePosixPath(target).parts:
        depth += -1 if part == ".." else 1
        inside = inside and depth >= 0
    if not inside:
        raise RefusedError(
            f"{path[:200]} is a link to {target[:200]!r}, outside of its volume",
            remedy="use a relative link that stays inside",
        )


def no_room(error: OSError, what: str) -> RefusedError:
    """Say that something could not be written, and what to do."""
    why = "there is no more room on the disk" if error.errno in FULL else str(error.strerror or error)
    where = f" ({error.filename})" if error.filename else ""
    return RefusedError(
        f"{what} could not be written: {why}{where}",
        remedy="free space there; nothing was changed, and it can be asked for again",
    )


# --- unpacking ------------------------------------------------------------------------------------------------


class _Careful:
    """An archive to read from that gives tarfile no piece larger than it has business with."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file

    def read(self, size: int = -1) -> bytes:
        if not 0 <= size <= _HEADERS:
            raise PayloadError(f"an archive with a name of {size:,} bytes")
        return self._file.read(size)

    def seek(self, offset: int, whence: int = 0) -> int:
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        return self._file.tell()


def unpack(archive: Path, target: Path, *, most_files: int, most_bytes: int) -> int:
    """Make an archive's files below an empty folder; returns their bytes. Blocks.

    The caller removes the folder when this fails.

    Raises:
        PayloadError: a member that is not a plain file, folder or link inside, or no archive at all.
        RefusedError: too many files or bytes; no room.
    """
    total, links, folders = 0, list[tuple[str, str]](), {"": 0o700}
    seen: set[str] = set()
    try:
        with archive.open("rb") as raw, tarfile.open(fileobj=cast("BinaryIO", _Careful(raw)), mode="r:") as tar:
            for member in tar:
                path = check_member(member, seen=seen, folders=folders)
                total += member.size if member.isreg() else 0
                if len(seen) > most_files or total > most_bytes:
                    raise RefusedError(
                        f"an archive of more than {most_files:,} files or {most_bytes:,} bytes",
                        remedy="raise pool.transfer.most_files or most_mb",
                    )
                if member.isdir():
                    (target / path).mkdir(mode=0o700)
                    folders[path] = member.mode & 0o777
                elif member.issym():
                    links.append((path, member.linkname))
                else:
                    _make_file(raw, member, target / path)
    except (tarfile.TarError, EOFError, UnicodeError) as error:
        raise PayloadError(f"an archive that cannot be read: {error}") from error
    except OSError as error:
        raise no_room(error, "an archive's files") from error
    # Links last: nothing is ever written through one. Modes of folders after that, the deepest first.
    for path, link in links:
        (target / path).symlink_to(link)
    for path in sorted(folders, key=len, reverse=True):
        if path:
            (target / path).chmod(folders[path] | 0o700)
    return total


def check_member(member: tarfile.TarInfo, *, seen: set[str], folders: dict[str, int]) -> str:
    """Return the path of a member that may be made; PayloadError (or RefusedError for a link) otherwise."""
    path = member.name.rstrip("/")
    parts = path.split("/")
    kind = member.type
    plain = kind in (tarfile.REGTYPE, tarfile.AREGTYPE) and member.sparse is None
    problem = ""
    if not (plain or kind in (tarfile.DIRTYPE, tarfile.SYMTYPE)):
        problem = "is a device, hard link or something stranger"
    elif not all(_is_name(part) for part in parts):
        problem = "leads outside or nowhere"
    elif len(parts) > _MOST_DEPTH or len(path) > _MOST_PATH:
        problem = "is too deep or too long"
    elif path in seen:
        problem = "is there twice"
    elif "/".join(parts[:-1]) not in folders:
        problem = "is in no folder of the archive"
    elif member.size < 0:
        problem = "has a size below 0"
    if problem:
        raise PayloadError(f"archive member {path[:200]!r} {problem}", remedy="look at the gateway that gave it")
    if kind == tarfile.SYMTYPE:
        check_link(path, member.linkname)
    seen.add(path)
    return path


def _is_name(part: str) -> bool:
    return part not in ("", ".", "..") and "\0" not in part and len(part.encode(errors="surrogateescape")) <= 255


def _make_file(raw: BinaryIO, member: tarfile.TarInfo, path: Path) -> None:
    mode = member.mode & 0o777
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    with os.fdopen(descriptor, "wb") as out:
        raw.seek(member.offset_data)
        left = member.size
        while left:
            data = raw.read(min(left, _COPY))
            if not data:
                raise PayloadError(f"archive member {member.name[:200]!r} is cut off")
            out.write(data)
            left -= len(data)
        out.flush()
        os.fchmod(descriptor, mode)
        seconds = max(0, min(int(member.mtime), _LATEST))
        os.utime(descriptor, (seconds, seconds))
