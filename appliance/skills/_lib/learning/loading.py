"""Items of a data set as arrays to learn from: decoded, scaled, cached.

A clip becomes (16, 40, 40) of uint8, a word the spectrogram of its second, (98, 40), a sentence one of its length, both
float16. Decoding takes milliseconds and training an item takes less, so what was decoded is kept in a cache: a file for
each item, known by path, size and time of the original, written in one step. A file that turns out to be damaged is
noted there too.
"""

import contextlib
import hashlib
import io
import json
import os
import uuid
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol, overload

import numpy as np
from numpy.typing import NDArray

from . import decoders, librispeech, sounds, ucf101
from .decoders import CorruptFileError
from .listings import Damage, DataError, Item, Listing, refuse_if_damaged

Kind = Literal["clip", "word", "sentence"]
Array = NDArray[Any]

FRAMES, SIDE = 16, 40
"""Pictures of a clip, and their height and width."""
WORD = sounds.RATE
"""Samples of a word: one second."""
MOST_FRAMES = 20_000
"""Pictures of a video that are looked at: 13 minutes at 25 a second."""
SENTENCE_S = 35.0
"""Longest recording: LibriSpeech's has 34.955 s."""
VERSION = "2"
"""Changes when items are decoded otherwise, so that nothing is taken from an older cache."""
CACHE_MB = 2048
"""Size of the cache beyond which what was written longest ago is removed."""


class Arrays(Sequence[Array]):
    """Items that are read from the cache when they are first used, so that training begins before all are read."""

    def __init__(self, read: Sequence[Array | Callable[[], Array]]) -> None:
        self._read = list(read)

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self._read)

    @overload
    def __getitem__(self, index: int) -> Array: ...

    @overload
    def __getitem__(self, index: slice) -> list[Array]: ...

    def __getitem__(self, index: int | slice) -> Array | list[Array]:
        """Return one, or some; CorruptFileError where a file was damaged since it was looked at."""
        if isinstance(index, slice):
            return [self[each] for each in range(*index.indices(len(self)))]
        found = self._read[index]
        if callable(found):
            found = self._read[index] = found()
        return found


class Loaded(NamedTuple):
    """Items as arrays.

    Attributes:
        arrays: One for each item that could be decoded.
        items: Those items, in the same order.
        damaged: The others.
    """

    arrays: Arrays
    items: tuple[Item, ...]
    damaged: tuple[Damage, ...]


def read(folder: Path, split: Literal["train", "test"], *, cache: Path | None = None) -> Listing:
    """Return a split of a folder in whichever of the two layouts it has; DataError where it has none.

    Args:
        folder: of the data set.
        split: which.
        cache: folder that a listing is kept in, for as long as no file comes, goes or is replaced.
    """
    if ucf101.is_here(folder):
        return _kept(ucf101, folder, split, cache)
    if librispeech.is_here(folder):
        return _kept(librispeech, folder, split, cache)
    raise _neither(folder)


class Outline(NamedTuple):
    """What lists say of a data set, without a look at its files.

    Attributes:
        classes: in order; empty where the data name none.
        items: listed for training.
    """

    classes: tuple[str, ...]
    items: int


def outline(folder: Path) -> Outline:
    """Return what the lists of a folder say; DataError where it has neither layout, or they cannot be read."""
    if ucf101.is_here(folder):
        return Outline(*ucf101.outline(folder))
    if librispeech.is_here(folder):
        return Outline((), librispeech.count(folder))
    raise _neither(folder)


def _neither(folder: Path) -> DataError:
    return DataError(
        f"{folder} has neither {ucf101.VIDEOS}/ and {ucf101.LISTS}/ nor {librispeech.HOME}/",
        "lay the data out as docs/learning.md shows",
    )


class _Layout(Protocol):
    """A module that reads a layout."""

    def read(self, folder: Path, split: Any) -> Listing:
        """Return a split."""
        ...

    def places(self, folder: Path) -> Iterator[Path]:
        """Yield the files and folders whose times tell that something has changed."""
        ...


def _kept(layout: _Layout, folder: Path, split: str, cache: Path | None) -> Listing:
    """Return a listing from the cache, or read and keep it: looking at the header of each file takes long."""
    if cache is None:
        return layout.read(folder, split)
    digest = hashlib.sha256(f"{VERSION}/{split}".encode())
    for path in sorted(layout.places(folder)):
        try:
            facts = path.stat()
        except OSError:
            continue
        digest.update(f"{path}\0{facts.st_size}\0{facts.st_mtime_ns}\0".encode())
    file = cache / "listings" / f"{digest.hexdigest()}.json"
    try:
        table = json.loads(file.read_text(encoding="utf-8"))
        return Listing(
            Path(table["folder"]),
            tuple(Item(*item) for item in table["items"]),
            tuple(table["classes"]),
            tuple(Damage(*damage) for damage in table["damaged"]),
            tuple(table["notes"]),
        )
    except (OSError, ValueError, KeyError, TypeError):  # not there, or the machine went down while it was written
        pass
    listing = layout.read(folder, split)
    _write(file, json.dumps({**listing._asdict(), "folder": str(listing.folder)}).encode())
    return listing


def _write(file: Path, data: bytes) -> None:
    """Keep something in the cache; where the disk has no room for it, it is worked out again the next time."""
    temporary = file.parent / f".{uuid.uuid4().hex}"
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(data)
        temporary.replace(file)
    except OSError:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def load(
    listing: Listing,
    indices: Sequence[int],
    kind: Kind,
    *,
    cache: Path,
    alive: Callable[[int], None] = lambda _: None,
    decode: Callable[[Path, Kind], Array] | None = None,
) -> Loaded:
    """Return items as arrays; what is not in the cache is decoded now, what is there is read when it is used.

    Args:
        listing: what the indices are of.
        indices: which items.
        kind: what they become.
        cache: folder of the cache.
        alive: told how many items are done, after each.
        decode: `decode_file`, or a stand-in for it.

    Raises:
        DataError: more than 5 % of all files of the listing and of these are damaged, with the list.
    """
    arrays: list[Array | Callable[[], Array]] = []
    items: list[Item] = []
    damaged: list[Damage] = []
    written = False
    for done, index in enumerate(indices):
        item = listing.items[index]
        try:
            entry = _Entry(listing.folder / item.path, kind, cache, decode or decode_file)
            fresh = not entry.kept.is_file()
            arrays.append(entry.decoded() if fresh else entry.read)
            written = written or fresh
            items.append(item)
        except CorruptFileError as error:
            damaged.append(Damage(item.path, str(error)))
        alive(done + 1)
    if written:
        prune(cache, most_bytes=CACHE_MB << 20)
    refuse_if_damaged(damaged, len(items), what=str(listing.folder))
    return Loaded(Arrays(arrays), tuple(items), tuple(damaged))


class _Entry:
    """An item in the cache. CorruptFileError where its file is not there."""

    def __init__(self, path: Path, kind: Kind, cache: Path, decode: Callable[[Path, Kind], Array]) -> None:
        try:
            facts = path.stat()
        except OSError as error:
            raise CorruptFileError(f"cannot be read: {error.strerror}") from error
        key = hashlib.sha256(f"{VERSION}/{kind}/{path}/{facts.st_size}/{facts.st_mtime_ns}".encode()).hexdigest()
        self.kept = cache / key[:2] / f"{key}.npy"
        self._bad = self.kept.with_suffix(".bad")
        self._path = path
        self._kind: Kind = kind
        self._decode = decode

    def read(self) -> Array:
        """Return it from the cache, or decoded again where the machine went down while it was written, or it went."""
        try:
            return np.load(self.kept, allow_pickle=False)
        except (OSError, ValueError, EOFError):
            return self.decoded()

    def decoded(self) -> Array:
        """Decode it and keep that; CorruptFileError, now or at an earlier time, is kept as well."""
        if self._bad.is_file():
            raise CorruptFileError(self._bad.read_text(encoding="utf-8"))
        try:
            array = self._decode(self._path, self._kind)
        except CorruptFileError as error:
            _write(self._bad, str(error).encode())
            raise
        out = io.BytesIO()
        # Headers of version 1, which `np.save` writes, are tokenised when they are read: a fifth of an epoch's time.
        np.lib.format.write_array(out, array, version=(3, 0), allow_pickle=False)
        _write(self.kept, out.getvalue())
        return array


def prune(cache: Path, *, most_bytes: int) -> int:
    """Remove what was written longest ago until the cache has at most so many bytes; returns how many are left."""
    found: list[tuple[float, int, Path]] = []
    for folder, _, names in os.walk(cache):
        for name in names:
            path = Path(folder) / name
            try:
                facts = path.stat()
            except OSError:
                continue  # another run removed it
            found.append((facts.st_mtime, facts.st_size, path))
    total = sum(size for _, size, _ in found)
    for _, size, path in sorted(found):
        if total <= most_bytes:
            break
        path.unlink(missing_ok=True)
        total -= size
    return total


def decode_file(path: Path, kind: Kind) -> Array:
    """Return a file as an array; CorruptFileError where it cannot be decoded whole."""
    if kind == "clip":
        pictures = decoders.pictures(path, side=SIDE, most=MOST_FRAMES)
        return np.stack([pictures[at] for at in spread(len(pictures), FRAMES)])
    wave = decoders.sound(path)
    if kind == "word":
        return sounds.log_mel(sounds.fit(wave, WORD)).astype(np.float16)
    if len(wave) > SENTENCE_S * sounds.RATE:
        raise CorruptFileError(f"{len(wave) / sounds.RATE:.0f} s long, more than {SENTENCE_S:g}")
    return sounds.log_mel(wave).astype(np.float16)


def spread(count: int, wanted: int) -> list[int]:
    """Return which of `count` pictures are taken for `wanted`: evenly spread, the middle of each part."""
    return [min(count - 1, (2 * number + 1) * count // (2 * wanted)) for number in range(wanted)]
