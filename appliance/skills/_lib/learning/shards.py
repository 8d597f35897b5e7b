"""Models and updates as lists of safetensors files ("shards") with a manifest, and the check of a file against it.

A shard has at most 8 MiB, so that it fits an artifact, and is known by its SHA-256. A tensor that is larger is cut
along its first axis into `NAME#0`, `NAME#1`, …, as the manifest says. The layout follows from names, types and shapes
alone, and `encode` writes the same bytes for the same arrays: equal models have equal digests.

Manifest, as JSON:

    {"format": 1,
     "tensors": [{"name": "conv.weight", "dtype": "F32", "shape": [8, 3, 3, 3], "shard": 0, "cut": null},
                 {"name": "head.weight", "dtype": "F32", "shape": [512, 4096], "shard": 1, "cut": [0, 2]}, ...],
     "shards": [{"digest": SHA-256, "bytes": 1234}, ...],
     "norm": 12.5}

`shape` is that of the piece in the shard, whose key there is `NAME`, or `NAME#k` where `cut` is `[k, of]`; `norm` the
L2 norm of all values, or null. Updates come from machines that are not trusted: what `decode` returns has the
digest, keys, types and shapes that the manifest names and only finite values; anything else is a `ModelFileError`
with one of `REASONS`. The file format is that of safetensors 0.4 (8 bytes header length, JSON header, data without
holes); its library accepts NaN, further tensors and other shapes, which is why it is not what decides here.
"""

import hashlib
import json
import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

SHARD_BYTES = 8 << 20
"""Largest shard."""
MAX_HEADER_BYTES = 1 << 20
"""Largest header of a shard; safetensors itself allows 100 MB, to be parsed before anything is known of the file."""
MAX_PIECES = 4096
"""Most tensors, or pieces of tensors, in a model."""
MAX_SHARDS = 4096
"""Most shards of a model: 32 GiB."""
MAX_DIMENSIONS = 8
FORMAT = 1

DTYPES: dict[str, np.dtype[Any]] = {
    "F32": np.dtype("<f4"),
    "I8": np.dtype("i1"),
    "I64": np.dtype("<i8"),
}
"""Types that a manifest may name: values; coded values (`coding`); sums that are not yet divided (`sums`)."""
_NAMES = {dtype: name for name, dtype in DTYPES.items()}
_SIZES = (
    dict.fromkeys(("BOOL", "U8", "I8"), 1)
    | dict.fromkeys(("I16", "U16", "F16", "BF16"), 2)
    | dict.fromkeys(("I32", "U32", "F32"), 4)
    | dict.fromkeys(("I64", "U64", "F64"), 8)
)
"""Bytes of a value of each type of the file format: one that no manifest names is still told from a damaged file."""

REASONS = {
    "manifest": "the manifest is not one",
    "digest": "the bytes are not those that were announced",
    "size": "the file has another size than announced, or is too large",
    "format": "not a safetensors file (a pickle, a zip, another format)",
    "truncated": "the file ends before its data",
    "header": "the header is too large, no JSON, or contradicts itself",
    "missing": "a tensor of the model is missing",
    "extra": "a tensor that the model does not have",
    "dtype": "a tensor of another type",
    "shape": "a tensor of another shape",
    "nan": "NaN or infinite values",
    "norm": "the norm is beyond the bound",
    "zero": "all values are zero",
    "lost": "its bytes are on no gateway that answers",
}
"""Why a file or an update is refused: codes that records, counters and `swiftbot learn show` use."""

_NAME = re.compile(r"[^\s#@/\\\x00-\x1f\x7f]{1,200}(@[a-z]{1,20})?")
"""A tensor's name; `@` is only in those that a coding adds (`coding`), `#` only in keys of parts."""
_DIGEST = re.compile(r"[0-9a-f]{64}")


class ModelFileError(ValueError):
    """A manifest or shard is refused.

    Attributes:
        reason: one of `REASONS`.
    """

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


class Piece(NamedTuple):
    """A tensor, or a part of one, as it lies in a shard. `cut`: (which part, of how many), None for a whole tensor."""

    name: str
    dtype: str
    shape: tuple[int, ...]
    shard: int
    cut: tuple[int, int] | None = None

    @property
    def key(self) -> str:
        """Its name in the shard."""
        return self.name if self.cut is None else f"{self.name}#{self.cut[0]}"

    @property
    def bytes(self) -> int:
        """Length of its data."""
        return math.prod(self.shape) * DTYPES[self.dtype].itemsize


class Shard(NamedTuple):
    """A file: SHA-256 and length."""

    digest: str
    bytes: int


class Manifest(NamedTuple):
    """What a model or update consists of."""

    pieces: tuple[Piece, ...]
    shards: tuple[Shard, ...]
    norm: float | None = None

    def of_shard(self, index: int) -> tuple[Piece, ...]:
        """Return the pieces in a shard."""
        return tuple(piece for piece in self.pieces if piece.shard == index)

    @property
    def bytes(self) -> int:
        """Length of all shards."""
        return sum(shard.bytes for shard in self.shards)

    @property
    def digest(self) -> str:
        """SHA-256 of the content, whatever its norm was said to be: two equal models have the same."""
        text = json.dumps(self._replace(norm=None).to_json(), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()

    def to_json(self) -> dict[str, Any]:
        """Return the manifest as the table described above."""
        return {
            "format": FORMAT,
            "tensors": [
                {
                    "name": piece.name,
                    "dtype": piece.dtype,
                    "shape": list(piece.shape),
                    "shard": piece.shard,
                    "cut": None if piece.cut is None else list(piece.cut),
                }
                for piece in self.pieces
            ],
            "shards": [{"digest": shard.digest, "bytes": shard.bytes} for shard in self.shards],
            "norm": self.norm,
        }


def parse_manifest(value: object) -> Manifest:
    """Return a manifest from its JSON value; ModelFileError(`manifest`) that names what is wrong with it."""
    table = _table(value, "the manifest")
    if table.get("format") != FORMAT:
        raise _manifest(f"format {table.get('format')!r}: this version reads format {FORMAT}")
    listed, files = _list(table, "tensors", MAX_PIECES), _list(table, "shards", MAX_SHARDS)
    shards = tuple(_shard(entry, f"shards[{number}]") for number, entry in enumerate(files))
    pieces = tuple(_piece(entry, f"tensors[{number}]", len(shards)) for number, entry in enumerate(listed))
    norm = table.get("norm")
    if norm is not None and not (isinstance(norm, int | float) and math.isfinite(norm) and norm >= 0):
        raise _manifest(f"norm: {norm!r} is no length")
    manifest = Manifest(pieces, shards, None if norm is None else float(norm))
    _check_whole(manifest)
    return manifest


def _check_whole(manifest: Manifest) -> None:
    """Check what the parts of a manifest say together: names once, parts without gaps, sizes of shards."""
    keys = [piece.key for piece in manifest.pieces]
    if len(set(keys)) != len(keys):
        raise _manifest(f"tensor {next(key for key in keys if keys.count(key) > 1)!r} is listed twice")
    parts: dict[str, list[Piece]] = {}
    for piece in manifest.pieces:
        parts.setdefault(piece.name, []).append(piece)
    for name, pieces in parts.items():
        cuts = [piece.cut for piece in pieces]
        if cuts != [None] and cuts != [(number, len(pieces)) for number in range(len(pieces))]:
            raise _manifest(f"tensor {name!r} has the parts {cuts}, not each once and in order")
        if len({(piece.dtype, piece.shape[1:]) for piece in pieces}) > 1:
            raise _manifest(f"the parts of tensor {name!r} have different types or shapes")
    held = [0] * len(manifest.shards)
    for piece in manifest.pieces:
        held[piece.shard] += piece.bytes
    for index, (shard, data) in enumerate(zip(manifest.shards, held, strict=True)):
        if not data < shard.bytes <= data + 8 + MAX_HEADER_BYTES:
            raise _manifest(f"shards[{index}] has {shard.bytes:,} bytes for {data:,} bytes of tensors")


def _piece(value: object, where: str, shards: int) -> Piece:
    table = _table(value, where)
    name, dtype, shape, shard = table.get("name"), table.get("dtype"), table.get("shape"), table.get("shard")
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise _manifest(f"{where}.name: {str(name)[:80]!r} is no name (no spaces, '#', '@' or '/')")
    if not isinstance(dtype, str) or dtype not in DTYPES:
        raise _manifest(f"{where}.dtype: {str(dtype)[:20]!r}; possible: {', '.join(DTYPES)}")
    sizes = _sizes(shape)
    if sizes is None or math.prod(sizes) * DTYPES[dtype].itemsize > SHARD_BYTES:
        raise _manifest(f"{where}.shape: {str(shape)[:80]} is no shape of at most {SHARD_BYTES:,} bytes")
    if not _whole(shard) or not 0 <= cast("int", shard) < shards:
        raise _manifest(f"{where}.shard: {str(shard)[:20]}, of {shards} shards")
    cut = table.get("cut")
    if cut is None:
        return Piece(name, dtype, sizes, cast("int", shard))
    pair = _sizes(cut)
    if pair is None or len(pair) != 2 or not pair[0] < pair[1] or not sizes:
        raise _manifest(f"{where}.cut: {str(cut)[:40]} is not [part, parts]")
    return Piece(name, dtype, sizes, cast("int", shard), (pair[0], pair[1]))


def _shard(value: object, where: str) -> Shard:
    table = _table(value, where)
    digest, size = table.get("digest"), table.get("bytes")
    if not isinstance(digest, str) or not _DIGEST.fullmatch(digest):
        raise _manifest(f"{where}.digest: {str(digest)[:80]!r} is no SHA-256")
    if not _whole(size) or not 8 < cast("int", size) <= SHARD_BYTES:
        raise _manifest(f"{where}.bytes: {str(size)[:40]}, a shard has at most {SHARD_BYTES:,}")
    return Shard(digest, cast("int", size))


def _table(value: object, where: str) -> dict[str, object]:
    if not isinstance(value, dict):
        raise _manifest(f"{where} is a {type(value).__name__}, not a table")
    return cast("dict[str, object]", value)


def _list(table: dict[str, object], key: str, longest: int) -> list[object]:
    value = table.get(key)
    if not isinstance(value, list):
        raise _manifest(f"{key} is no list")
    listed = cast("list[object]", value)
    if not 0 < len(listed) <= longest:
        raise _manifest(f"{key} has {len(listed):,} entries; possible: 1 to {longest:,}")
    return listed


def _whole(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _sizes(value: object) -> tuple[int, ...] | None:
    """Return a list of non-negative whole numbers as a tuple, None where it is anything else."""
    if not isinstance(value, list | tuple):
        return None
    sizes = cast("Sequence[object]", value)
    if len(sizes) > MAX_DIMENSIONS or any(not _whole(size) or cast("int", size) < 0 for size in sizes):
        return None
    return tuple(cast("Sequence[int]", sizes))


def _manifest(message: str) -> ModelFileError:
    return ModelFileError("manifest", f"manifest: {message}")


# --- layout


class Spec(NamedTuple):
    """A whole tensor: name, type, shape."""

    name: str
    dtype: str
    shape: tuple[int, ...]


def specs(manifest: Manifest) -> tuple[Spec, ...]:
    """Return the whole tensors of a manifest, in its order."""
    whole: dict[str, Spec] = {}
    for piece in manifest.pieces:
        before = whole.get(piece.name)
        shape = piece.shape if before is None else (before.shape[0] + piece.shape[0], *piece.shape[1:])
        whole[piece.name] = Spec(piece.name, piece.dtype, shape)
    return tuple(whole.values())


def layout(tensors: Iterable[Spec], *, shard_bytes: int = SHARD_BYTES) -> tuple[Piece, ...]:
    """Return where each tensor lies: in order of names, cut where it is too large, each shard as full as can be.

    Args:
        tensors: whole tensors; their order makes no difference.
        shard_bytes: largest shard, its header included.

    Raises:
        ModelFileError: (`manifest`) no tensor, too many, a name or type that is none, a row too large for a shard.
    """
    pieces: list[Piece] = []
    shard, used, header = 0, 8 + _HEADER_END, 0
    for spec in sorted(tensors):
        if not _NAME.fullmatch(spec.name) or "@" in spec.name or spec.dtype not in DTYPES:
            raise _manifest(f"tensor {spec.name[:80]!r} of type {spec.dtype} has no place in a model")
        for part in _cut(spec, shard_bytes):
            entry = len(part.key.encode()) + _HEADER_ENTRY
            if header and (used + part.bytes + entry > shard_bytes or header + entry > MAX_HEADER_BYTES):
                shard, used, header = shard + 1, 8 + _HEADER_END, 0
            used += part.bytes + entry
            header += entry
            pieces.append(part._replace(shard=shard))
    if not 0 < len(pieces) <= MAX_PIECES:
        raise _manifest(f"a model has 1 to {MAX_PIECES:,} tensors, this one {len(pieces):,}")
    return tuple(pieces)


_HEADER_ENTRY = 220
"""Longest entry of a header besides the key, in bytes: type, eight sizes, two offsets."""
_HEADER_END = 16
"""Braces and padding of a header."""


def _cut(spec: Spec, shard_bytes: int) -> list[Piece]:
    whole = Piece(spec.name, spec.dtype, spec.shape, 0)
    room = shard_bytes - 8 - _HEADER_END - _HEADER_ENTRY - len(spec.name.encode()) - 6
    if whole.bytes <= room:
        return [whole]
    rows = spec.shape[0] if spec.shape else 0
    row_bytes = whole.bytes // rows if rows else whole.bytes
    per_part = room // row_bytes
    if per_part < 1:
        raise _manifest(f"tensor {spec.name!r} has rows of {row_bytes:,} bytes; at most {room:,} are possible")
    count = -(-rows // per_part)
    sizes = [min(per_part, rows - number * per_part) for number in range(count)]
    return [
        Piece(spec.name, spec.dtype, (size, *spec.shape[1:]), 0, (number, count)) for number, size in enumerate(sizes)
    ]


def split(arrays: Mapping[str, Array], *, shard_bytes: int = SHARD_BYTES) -> Iterator[tuple[tuple[Piece, ...], bytes]]:
    """Yield a model's shards, each with its pieces; `collect` makes the manifest of them.

    Raises:
        ModelFileError: as `layout`; (`dtype`) an array of a type that no model has; (`nan`).
    """
    whole: list[Spec] = []
    for name, array in arrays.items():
        if array.dtype not in _NAMES:
            raise ModelFileError("dtype", f"tensor {name!r} is {array.dtype}; possible: {', '.join(DTYPES)}")
        if not finite(array):
            raise ModelFileError("nan", f"tensor {name!r} has NaN or infinite values")
        whole.append(Spec(name, _NAMES[array.dtype], array.shape))
    pieces = layout(whole, shard_bytes=shard_bytes)
    starts = _starts(pieces)
    for index in range(pieces[-1].shard + 1):
        here = tuple(piece for piece in pieces if piece.shard == index)
        yield here, encode({piece.key: _part(arrays[piece.name], piece, starts[piece.key]) for piece in here})


def _starts(pieces: Iterable[Piece]) -> dict[str, int]:
    """Return the first row of each piece in its tensor, by key."""
    starts: dict[str, int] = {}
    rows: dict[str, int] = {}
    for piece in pieces:
        starts[piece.key] = rows.get(piece.name, 0)
        rows[piece.name] = starts[piece.key] + (piece.shape[0] if piece.shape else 0)
    return starts


def _part(array: Array, piece: Piece, start: int) -> Array:
    return array if piece.cut is None else array[start : start + piece.shape[0]]


def collect(shards: Iterable[tuple[tuple[Piece, ...], bytes]], *, norm: float | None = None) -> Manifest:
    """Return the manifest of shards from `split`, or of the same pieces with other values."""
    pieces: list[Piece] = []
    files: list[Shard] = []
    for here, data in shards:
        pieces.extend(here)
        files.append(Shard(hashlib.sha256(data).hexdigest(), len(data)))
    return Manifest(tuple(pieces), tuple(files), norm)


def join(manifest: Manifest, shards: Iterable[bytes]) -> dict[str, Array]:
    """Return whole arrays of a model from its shards, in the manifest's order; ModelFileError as `decode`."""
    parts: dict[str, list[Array]] = {piece.name: [] for piece in manifest.pieces}
    for index, data in enumerate(shards):
        arrays = decode(data, manifest, index)
        for piece in manifest.of_shard(index):
            parts[piece.name].append(arrays[piece.key])
    expected = Counter(piece.name for piece in manifest.pieces)
    missing = [name for name, arrays in parts.items() if len(arrays) != expected[name]]
    if missing:
        raise ModelFileError("missing", f"tensor {missing[0]!r} is in a shard that was not given")
    return {name: arrays[0] if len(arrays) == 1 else np.concatenate(arrays) for name, arrays in parts.items()}


# --- files


def encode(arrays: Mapping[str, Array]) -> bytes:
    """Return a safetensors file of those arrays: the same bytes for the same arrays in the same order.

    Types with longer values come first, so that each value lies where a processor reads it best.
    """
    header: dict[str, object] = {}
    blocks: list[bytes] = []
    offset = 0
    for key, array in sorted(arrays.items(), key=lambda item: -item[1].dtype.itemsize):
        block = np.ascontiguousarray(array).tobytes()
        header[key] = {
            "dtype": _NAMES[array.dtype],
            "shape": list(array.shape),
            "data_offsets": [offset, offset + len(block)],
        }
        blocks.append(block)
        offset += len(block)
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 8)
    return b"".join((len(text).to_bytes(8, "little"), text, *blocks))


class Entry(NamedTuple):
    """A tensor in a file: type, shape, and where its data is in the file, in bytes."""

    dtype: str
    shape: tuple[int, ...]
    start: int
    end: int


def header_bytes(start: bytes, size: int) -> int:
    """Return how long the header of a file of `size` bytes is from its first 8 bytes, before any more is read.

    Raises:
        ModelFileError: `format`, `truncated`, `header`.
    """
    if size < 8 or len(start) < 8:
        raise ModelFileError("truncated", f"a file of {size:,} bytes has no header")
    length = int.from_bytes(start[:8], "little")
    if start[:2] in (b"PK", b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05") and length > MAX_HEADER_BYTES:
        raise ModelFileError("format", "a pickle or zip archive: only safetensors files are read")
    if length > MAX_HEADER_BYTES:
        raise ModelFileError("header", f"a header of {length:,} bytes, more than the {MAX_HEADER_BYTES:,} allowed")
    if 8 + length > size:
        raise ModelFileError("truncated", f"a header of {length:,} bytes in a file of {size:,}")
    return length


def read_header(start: bytes, size: int) -> dict[str, Entry]:
    """Return what a file's header says, checked against the file's size alone: no value is read.

    Args:
        start: the file's beginning, at least its header.
        size: length of the whole file in bytes.

    Raises:
        ModelFileError: `format`, `truncated`, `header`.
    """
    length = header_bytes(start, size)
    text = start[8 : 8 + length]
    if len(text) < length:
        raise ModelFileError("truncated", "the header is not there whole")
    if not text.startswith(b"{"):
        raise ModelFileError("format", "the header does not begin with '{': not a safetensors file")
    entries: dict[str, Entry] = {}
    for key, value in _parse(text):
        if key == "__metadata__":
            continue
        if key in entries:
            raise ModelFileError("header", f"tensor {key[:80]!r} is there twice")
        if len(entries) >= MAX_PIECES:
            raise ModelFileError("header", f"more than {MAX_PIECES:,} tensors")
        entries[key] = _entry(key, value, 8 + length)
    _check_data(entries, 8 + length, size)
    return entries


def _parse(text: bytes) -> list[tuple[str, object]]:
    """Return keys and values of a JSON table in order, doubled keys too."""
    try:
        value = json.loads(text.decode(), object_pairs_hook=_Pairs)
    except (ValueError, RecursionError) as error:
        raise ModelFileError("header", f"the header is no JSON: {str(error)[:120]}") from None
    if not isinstance(value, _Pairs):
        raise ModelFileError("header", "the header is no table")
    return value.pairs


class _Pairs:
    """A JSON table as it was written: a dict would hide a key that is there twice."""

    def __init__(self, pairs: list[tuple[str, object]]) -> None:
        self.pairs = pairs


def _entry(key: str, value: object, data: int) -> Entry:
    table = dict(value.pairs) if isinstance(value, _Pairs) else {}
    dtype, shape, offsets = table.get("dtype"), _sizes(table.get("shape")), _sizes(table.get("data_offsets"))
    if not isinstance(dtype, str) or dtype not in _SIZES or shape is None or offsets is None or len(offsets) != 2:
        raise ModelFileError("header", f"tensor {key[:80]!r} is not described by dtype, shape and data_offsets")
    if offsets[1] - offsets[0] != math.prod(shape) * _SIZES[dtype]:
        raise ModelFileError("header", f"tensor {key[:80]!r}: shape and offsets contradict each other")
    return Entry(dtype, shape, data + offsets[0], data + offsets[1])


def _check_data(entries: dict[str, Entry], start: int, size: int) -> None:
    """Check that the data of all tensors fill the file, without holes and overlaps."""
    at = start
    for key, entry in sorted(entries.items(), key=lambda item: (item[1].start, item[1].end)):
        if entry.start != at:
            raise ModelFileError("header", f"the data of tensor {key[:80]!r} overlap others, or leave a hole")
        at = entry.end
    if at > size:
        raise ModelFileError("truncated", f"the tensors need {at:,} bytes, the file has {size:,}")
    if at < size:
        raise ModelFileError("header", f"{size - at:,} bytes belong to no tensor")


def check_header(entries: Mapping[str, Entry], pieces: Iterable[Piece]) -> None:
    """Check by its header that a file has exactly those pieces; ModelFileError `missing`, `extra`, `dtype`, `shape`."""
    expected = {piece.key: piece for piece in pieces}
    for key, piece in expected.items():
        entry = entries.get(key)
        if entry is None:
            raise ModelFileError("missing", f"tensor {key!r} is missing")
        if entry.dtype != piece.dtype:
            raise ModelFileError("dtype", f"tensor {key!r} is {entry.dtype}, expected {piece.dtype}")
        if entry.shape != piece.shape:
            raise ModelFileError("shape", f"tensor {key!r} has shape {entry.shape}, expected {piece.shape}")
    extra = sorted(entries.keys() - expected.keys())
    if extra:
        raise ModelFileError("extra", f"{len(extra)} tensors that the model does not have, such as {extra[0][:80]!r}")


def decode(data: bytes, manifest: Manifest, index: int) -> dict[str, Array]:
    """Return the arrays of a shard by key, read-only views of `data`, after every check of this module.

    Raises:
        ModelFileError: one of `REASONS`, in this order: size, digest, header, tensors, values.
    """
    shard = manifest.shards[index]
    if len(data) != shard.bytes:
        raise ModelFileError("size", f"shard {index} has {len(data):,} bytes, announced were {shard.bytes:,}")
    if hashlib.sha256(data).hexdigest() != shard.digest:
        raise ModelFileError("digest", f"shard {index} does not have the announced digest {shard.digest[:12]}…")
    return decode_pieces(data, manifest.of_shard(index))


def decode_pieces(data: bytes, pieces: Iterable[Piece]) -> dict[str, Array]:
    """Return the arrays of a file that must hold exactly those pieces; ModelFileError, all but `size` and `digest`."""
    entries = read_header(data, len(data))
    check_header(entries, pieces)
    arrays: dict[str, Array] = {}
    for key, entry in entries.items():
        dtype = DTYPES[entry.dtype]
        count = math.prod(entry.shape)
        array: Array = np.frombuffer(data, dtype=dtype, count=count, offset=entry.start).reshape(entry.shape)
        if not finite(array):
            raise ModelFileError("nan", f"tensor {key!r} has NaN or infinite values")
        arrays[key] = array
    return arrays


def check_same(update: Manifest, base: Manifest) -> None:
    """Check that an update has the model's tensors in the model's layout; ModelFileError as `check_header`."""
    if len(update.shards) != len(base.shards):
        raise ModelFileError("manifest", f"{len(update.shards)} shards, the model has {len(base.shards)}")
    for index in range(len(base.shards)):
        entries = {piece.key: Entry(piece.dtype, piece.shape, 0, 0) for piece in update.of_shard(index)}
        check_header(entries, base.of_shard(index))


# --- values


def finite(array: Array) -> bool:
    """Whether all values are finite. In pieces: a mask of a whole tensor would be memory outside the bound."""
    if array.dtype.kind != "f":
        return True
    flat = array.reshape(-1)
    return all(bool(np.isfinite(flat[at : at + _BLOCK]).all()) for at in range(0, flat.size, _BLOCK))


_BLOCK = 1 << 18
"""Values that are looked at together."""


def squared_norm(arrays: Iterable[Array]) -> float:
    """Return the sum of squares of all values, in double precision; the same for the same arrays in the same order."""
    total = 0.0
    for array in arrays:
        flat = array.reshape(-1)
        for at in range(0, flat.size, _BLOCK):
            block = flat[at : at + _BLOCK].astype(np.float64)
            total += float(np.dot(block, block))
    return total


def norm_bound(norms: Sequence[float], *, factor: float = 3.0) -> float:
    """Return the largest norm that an update of a round may have: `factor` times the median of all.

    With one or two updates there is no majority to compare with; the bound then is `factor` times the larger.
    """
    if not norms:
        return math.inf
    ordered = sorted(norms)
    return factor * (ordered[-1] if len(ordered) < 3 else ordered[(len(ordered) - 1) // 2])


def check_norm(norm: float, bound: float) -> None:
    """Refuse an update whose norm is zero (`zero`), not finite (`nan`) or beyond the bound (`norm`)."""
    if not math.isfinite(norm):
        raise ModelFileError("nan", "the norm of the update is not finite")
    if norm == 0.0:
        raise ModelFileError("zero", "all values of the update are zero: nothing was trained")
    if norm > bound:
        raise ModelFileError("norm", f"norm {norm:.4g} is beyond the bound {bound:.4g} (3 x the median of the round)")
