"""Immutable, content-addressed copies of the code that containers load: skill folders and the runner.

Containers never mount a live folder: one that is started after an edit would run code that belongs to no digest the
gateway knows. `Snapshots.take` copies what is on disk once, when the gateway starts, and every container mounts
that copy read-only. The layout of the store:

    objects/SHA256[x]      each distinct file once, read-only; `x`: executable
    trees/DIGEST/ROOT/...  one snapshot; its files are hard links to the objects

A tree's digest is that of its paths and bytes. Objects and trees appear under their names only when they are whole,
and an object whose bytes no longer have its digest is written again, so neither a crash nor a damaged disk is served.

Bytecode is added to what containers mount or are made of (`add_bytecode`), since they cannot write any: without it each
would compile all that it imports, at each start.
"""

import hashlib
import os
import py_compile
import secrets
import shutil
import sys
from collections.abc import Callable, Collection, Mapping
from pathlib import Path

from msgspec import Struct

from appliance.errors import ConfigError
from appliance.identity.parts import listing_digest, regular_files


def add_bytecode(tree: Path, *, inside: Path | None = None) -> None:
    """Compile all modules below a folder with this Python; another version's ignores what is written.

    It is used only while it is of the very source beside it, whose hash it holds. A module that does not compile is
    left alone: importing it says what is wrong with it.

    Args:
        tree: the folder.
        inside: where the folder will be, for tracebacks; None: where it is.
    """
    for file in tree.rglob("*.py"):
        # Spelled out, since a prefix for bytecode in this process's environment is of no use to a container.
        compiled = file.parent / "__pycache__" / f"{file.stem}.{sys.implementation.cache_tag}.pyc"
        shown = str(inside / file.relative_to(tree)) if inside else None
        try:
            py_compile.compile(
                str(file),
                str(compiled),
                shown,
                doraise=True,
                invalidation_mode=py_compile.PycInvalidationMode.CHECKED_HASH,
            )
        except py_compile.PyCompileError:
            continue


NOT_LOADED = frozenset({"images", "sites"})
"""Folders beside the skills of which a container loads nothing."""
ATTEMPTS = 3
"""How often a folder is read that changes meanwhile: an editor replaces a file in two steps."""
_NEW = ".new-"


class Snapshot(Struct, frozen=True, kw_only=True):
    """One snapshot: `files` are the SHA-256 digests by path below `folder`, `ROOT/...`."""

    digest: str
    folder: Path
    files: dict[str, str]
    left_out: frozenset[str] = frozenset()
    """Parts that it lacks since they may not be used: `ROOT/PART`."""


def _part(path: str) -> str:
    """Return the part that a file of a folder of skills belongs to: the folder directly in it, or `.`."""
    first, slash, _ = path.partition("/")
    return first if slash else "."


def part_digests(files: Mapping[str, str]) -> dict[str, str]:
    """Return the digest of each part of a folder of skills, of the digests of its files."""
    parts: dict[str, dict[str, str]] = {}
    for path, digest in files.items():
        part = _part(path)
        parts.setdefault(part, {})[path.removeprefix(f"{part}/")] = digest
    return {part: listing_digest(digests) for part, digests in parts.items()}


def unexpected(loaded: Mapping[str, str], files: Mapping[str, str]) -> tuple[str, ...]:
    """Return the paths of loaded files that a snapshot does not hold with the same digest, sorted."""
    return tuple(sorted(path for path, digest in loaded.items() if files.get(path) != digest))


class Snapshots:
    """The snapshot store of one gateway. Its methods block: they read and write files."""

    def __init__(self, store: Path) -> None:
        self._objects = store / "objects"
        self._trees = store / "trees"

    def take(
        self, roots: Mapping[str, Path], may: Callable[[str, str, str], bool] = lambda _root, _part, _digest: True
    ) -> Snapshot:
        """Return a snapshot of folders, by the name that each has in it; what is stored already is linked.

        Args:
            roots: the folders.
            may: whether a part of one, of that digest, may be in it.

        Raises:
            ConfigError: a folder cannot be read, or the store cannot be written.
        """
        try:
            for folder in (self._objects, self._trees):
                folder.mkdir(parents=True, exist_ok=True, mode=0o700)
                for left in folder.glob(f"{_NEW}*"):  # of a gateway that was killed meanwhile
                    _remove(left)
            for attempt in range(1, ATTEMPTS + 1):
                try:
                    return self._take(roots, may)
                except FileNotFoundError:
                    if attempt == ATTEMPTS:
                        raise
        except OSError as error:
            raise ConfigError(
                f"no snapshot of the skills can be made: {error.filename or self._trees}: {error.strerror}",
                remedy=f"make the skill folders readable, and {self._trees.parent} writable with space left",
            ) from error
        raise AssertionError("unreachable")

    def _take(self, roots: Mapping[str, Path], may: Callable[[str, str, str], bool]) -> Snapshot:
        building = self._trees / f"{_NEW}{secrets.token_hex(6)}"
        objects: dict[str, str] = {}
        left_out: set[str] = set()
        try:
            for name, root in roots.items():
                (building / name).mkdir(parents=True)
                stored = {path: self._store(file) for file, path in regular_files(root, left_out=NOT_LOADED)}
                # Judged by the bytes that were stored: an edit after that is in no snapshot.
                refused = {part for part, digest in part_digests(stored).items() if not may(name, part, digest)}
                left_out.update(f"{name}/{part}" for part in refused)
                objects.update({f"{name}/{path}": each for path, each in stored.items() if _part(path) not in refused})
            for path, each in objects.items():
                place = building / path
                place.parent.mkdir(parents=True, exist_ok=True)
                os.link(self._objects / each, place)
            digest = listing_digest(objects)
            folder = self._trees / digest
            if not self._same(folder, objects):
                add_bytecode(building)
                if folder.exists():
                    folder.rename(self._trees / f"{_NEW}{secrets.token_hex(6)}")
                building.rename(folder)
        finally:
            _remove(building)
        return Snapshot(
            digest=digest,
            folder=folder,
            files={path: stored.rstrip("x") for path, stored in objects.items()},
            left_out=frozenset(left_out),
        )

    def _store(self, file: Path) -> str:
        """Store a file's bytes unless they are there; returns the object's name, which is of what was stored."""
        with file.open("rb") as source:
            suffix = "x" if os.fstat(source.fileno()).st_mode & 0o100 else ""
            name = hashlib.file_digest(source, "sha256").hexdigest() + suffix
            if self._whole(name):
                return name
            source.seek(0)
            temporary = self._objects / f"{_NEW}{secrets.token_hex(6)}"
            digest = hashlib.sha256()
            with temporary.open("xb") as copy:
                while block := source.read(2**20):
                    digest.update(block)
                    copy.write(block)
                os.fchmod(copy.fileno(), 0o555 if suffix else 0o444)
        name = digest.hexdigest() + suffix
        temporary.replace(self._objects / name)
        return name

    def _whole(self, name: str) -> bool:
        try:
            with (self._objects / name).open("rb") as stored:
                return hashlib.file_digest(stored, "sha256").hexdigest() == name.rstrip("x")
        except FileNotFoundError:
            return False

    def _same(self, folder: Path, objects: Mapping[str, str]) -> bool:
        """Whether a tree is there and each of its files is the very object it should be."""
        try:
            return all((folder / path).samefile(self._objects / stored) for path, stored in objects.items())
        except (FileNotFoundError, NotADirectoryError):
            return False

    def forget(self, keep: Collection[str]) -> tuple[str, ...]:
        """Remove all snapshots but those with these digests, and the objects only they had; returns what went.

        Raises:
            OSError: something cannot be removed.
        """
        gone = tuple(sorted(each.name for each in self._trees.iterdir() if each.name not in keep))
        for name in gone:
            _remove(self._trees / name)
        for stored in self._objects.iterdir() if gone else ():
            if stored.stat().st_nlink == 1:
                stored.unlink()
        return gone


def _remove(path: Path) -> None:
    """Remove a file or a folder; nothing when it is gone."""
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
