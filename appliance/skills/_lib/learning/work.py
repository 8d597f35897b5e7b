"""What the handlers of federated learning share: models and updates as artifacts, data sets as samples."""

import time
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from _lib import params
from _lib.context import Context, Surroundings
from numpy.typing import NDArray

from . import coding, loading, models, partition, shards
from .listings import DataError, Item, Listing
from .models import Model, ModelError, Tensor
from .orders import Base, OrderError, Part
from .seeds import seed as derive
from .shards import Manifest, ModelFileError, Piece, Spec

FOLDER = "learning"
"""The gateway's folder of data sets, as manifests name it."""
TRAINED = "models"
"""Folder in it with models in NAME: a user's own (model.toml, model.py), and trained ones (manifest.json, shards)."""
ALIVE_S = 0.5
"""How often a long piece of work gives a sign of life."""

Floats = NDArray[np.float32]
Reference = dict[str, Any]


def model_of(ctx: Surroundings, name: str) -> Model:
    """Return a model by its name, of the gateway's folder of data or of the product; ctx.Fail where there is none."""
    own = ctx.host_folder(FOLDER) / TRAINED
    try:
        return models.read(name, [models.FOLDER, own])
    except ModelError as error:
        raise ctx.Fail(
            str(error), f"take one of those, or put its folder into {TRAINED}/ of the folder of data"
        ) from error


def refused(ctx: Context, error: OrderError) -> Exception:
    """Return the exception that ends a run whose parameter cannot be."""
    return ctx.CallError("payload", str(error), error.remedy)


class Alive:
    """Gives a sign of life now and then, however often it is called."""

    def __init__(self, ctx: Context) -> None:
        self._ctx = ctx
        self._last = time.monotonic()

    def __call__(self, *_: object) -> None:
        """Give one if the last is a while ago."""
        if time.monotonic() - self._last > ALIVE_S:
            self._last = time.monotonic()
            self._ctx.alive()


# --- models and updates


def manifest_of(ctx: Context, given: Mapping[str, Any]) -> Manifest:
    """Return a manifest given as its table, or as a reference to an artifact that holds it.

    Raises:
        ModelFileError: it is none.
    """
    if "artifact" not in given:
        return shards.parse_manifest(dict(given))
    return shards.parse_manifest(parse_json(fetch(ctx, dict(given))))


def fetch(ctx: Context, reference: Reference) -> bytes:
    """Return the bytes of an artifact; ModelFileError `lost` where no gateway has them, or only damaged ones."""
    try:
        return ctx.get_artifact(reference)
    except Exception as error:
        if getattr(error, "code", "") not in ("not-found", "payload"):
            raise
        raise ModelFileError("lost", str(error)) from error


def parse_json(data: bytes) -> object:
    """Return the value of a JSON file of at most 1 MiB; ModelFileError(`manifest`)."""
    import json  # noqa: PLC0415 - loaded already; here it is read once a run

    if len(data) > 1 << 20:
        raise ModelFileError("manifest", f"a manifest of {len(data):,} bytes")
    try:
        return json.loads(data)
    except (ValueError, RecursionError) as error:
        raise ModelFileError("manifest", f"the manifest is no JSON: {error}"[:200]) from error


def check_tensors(manifest: Manifest, tensors: Sequence[Tensor]) -> None:
    """Check that a manifest is of a model with these tensors; ModelFileError `missing`, `extra`, `shape`, `dtype`."""
    found = {each.name: each for each in shards.specs(manifest)}
    for tensor in tensors:
        spec = found.pop(tensor.name, None)
        if spec is None:
            raise ModelFileError("missing", f"tensor {tensor.name!r} is missing")
        if spec.dtype != "F32":
            raise ModelFileError("dtype", f"tensor {tensor.name!r} is {spec.dtype}, expected F32")
        if spec.shape != tensor.shape:
            raise ModelFileError("shape", f"tensor {tensor.name!r} has shape {spec.shape}, expected {tensor.shape}")
    if found:
        raise ModelFileError("extra", f"{len(found)} tensors that the model does not have, such as {min(found)!r}")


def shapes_of(manifest: Manifest) -> dict[str, tuple[int, ...]]:
    """Return the shapes of a manifest's tensors by name."""
    return {each.name: each.shape for each in shards.specs(manifest)}


def fetch_shard(ctx: Context, manifest: Manifest, references: Sequence[Reference], index: int) -> bytes:
    """Return a shard's bytes; the announced size is looked at before it is fetched. ModelFileError `size`."""
    reference, wanted = references[index], manifest.shards[index]
    announced = reference.get("bytes")
    if announced is not None and announced != wanted.bytes:
        raise ModelFileError(
            "size", f"shard {index} is announced with {announced} bytes, the manifest says {wanted.bytes}"
        )
    return fetch(ctx, reference)


def check_count(manifest: Manifest, references: Sequence[Reference]) -> None:
    """Check that there is one reference for each shard; ModelFileError `manifest`."""
    if len(references) != len(manifest.shards):
        raise ModelFileError("manifest", f"{len(references)} shards, the manifest has {len(manifest.shards)}")


def base_values(ctx: Context, base: Base | None, tensors: Sequence[Tensor], run_seed: int) -> dict[str, Floats]:
    """Return the values of a model: of the artifacts, or those that a run begins with; ctx.Fail if they are wrong."""
    if base is None:
        return models.initial(tensors, run_seed)
    try:
        manifest = manifest_of(ctx, base.manifest)
        check_tensors(manifest, tensors)
        check_count(manifest, base.shards)
        return shards.join(manifest, (fetch_shard(ctx, manifest, base.shards, n) for n in range(len(base.shards))))
    except ModelFileError as error:
        raise base_refused(ctx, error) from error


def base_refused(ctx: Context, error: ModelFileError) -> Exception:
    """Return the exception that ends a run whose round begins with a model that cannot be used."""
    if error.reason == "lost":
        text = f"the model that this round begins with cannot be fetched: {error}"
        return ctx.CallError("not-found", text, "bring back a gateway that keeps it", retryable=True)
    return ctx.Fail(
        f"the model that this round begins with is refused ({error.reason}): {error}",
        "see that recipe and model are of the same run",
    )


def keep(
    ctx: Context, values: Mapping[str, NDArray[Any]], name: str, *, masked: bool = False
) -> tuple[dict[str, Any], list[Reference]]:
    """Keep a model or update as artifacts; returns its manifest as a table, and references to its shards."""
    norm = None if masked else shards.squared_norm(values[each] for each in sorted(values)) ** 0.5
    files = list(shards.split(values))
    references = [
        ctx.put_artifact(f"{name}-{number:05d}.safetensors", data, "application/x-safetensors")
        for number, (_, data) in enumerate(files)
    ]
    return shards.collect(files, norm=norm).to_json(), references


def fetch_coded(ctx: Context, manifest: Manifest, references: Sequence[Reference], index: int) -> bytes:
    """Return a shard of an update in 8 bits, unpacked; the announced size is looked at before it is fetched.

    `zlib` makes of what it cannot pack 5 bytes more for 16 kB, and some for the whole.

    Raises:
        ModelFileError: `size`, `format`, `lost`.
    """
    reference, wanted = references[index], manifest.shards[index]
    announced = reference.get("bytes")
    if not isinstance(announced, int) or not 0 < announced <= wanted.bytes + wanted.bytes // 1000 + 64:
        raise ModelFileError(
            "size", f"shard {index} is announced with {announced} bytes, packed from {wanted.bytes:,} of the manifest"
        )
    return coding.inflate(fetch(ctx, reference), wanted.bytes)


class Coded(NamedTuple):
    """An update in 8 bits as artifacts: its manifest, its shards, and the shards of what coding left over."""

    manifest: dict[str, Any]
    shards: list[Reference]
    residual: list[Reference]


def keep_coded(
    ctx: Context, values: Mapping[str, Floats], residual: Mapping[str, Floats], name: str, *, scale: float
) -> Coded:
    """Keep an update in 8 bits as artifacts.

    Args:
        ctx: of the run.
        values: the update's tensors by name.
        residual: what coding left over of the client's last update, by the keys of pieces; may be empty.
        name: of the files.
        scale: what the update is multiplied by where it is summed: of a third of an epoch three. What is left over is
            kept as it would be in the model, so that work of different lengths fits together.

    Raises:
        ModelFileError: (`nan`) the update is not finite.
    """
    files: list[tuple[tuple[Piece, ...], bytes]] = []
    sent: list[Reference] = []
    kept: list[Reference] = []
    for number, (pieces, data) in enumerate(shards.split(values)):
        carried = {key: each / np.float32(scale) for key, each in residual.items()}
        tensors, left = coding.encode_shard(shards.decode_pieces(data, pieces), pieces, carried)
        file = shards.encode(tensors)
        files.append((coding.coded_pieces(pieces), file))
        sent.append(ctx.put_artifact(f"{name}-{number:05d}.int8", coding.deflate(file), "application/octet-stream"))
        left = {key: each * np.float32(scale) for key, each in left.items()}
        kept.append(
            ctx.put_artifact(f"residual-{number:05d}.safetensors", shards.encode(left), "application/x-safetensors")
        )
    return Coded(shards.collect(files).to_json(), sent, kept)


def residual(ctx: Context, parts: Sequence[Sequence[Reference]], tensors: Sequence[Tensor]) -> dict[str, Floats]:
    """Return what coding left over of a client's last update, summed over its parts, by the keys of pieces.

    What cannot be had any more is left out: the update is then as that of a client that begins.
    """
    pieces = shards.layout(Spec(each.name, "F32", each.shape) for each in tensors)
    total: dict[str, Floats] = {}
    for references in parts:
        try:
            found = _residual_of(ctx, references, pieces)
        except ModelFileError as error:
            ctx.log(f"what coding left over of the last update is not added: {error}")
            continue
        total = {key: array + total[key] if key in total else array for key, array in found.items()}
    return total


def _residual_of(ctx: Context, references: Sequence[Reference], pieces: Sequence[Piece]) -> dict[str, Floats]:
    """Return what coding left over of one part of an update; ModelFileError where it is not that of this model."""
    count = 1 + pieces[-1].shard
    if len(references) != count:
        raise ModelFileError("manifest", f"{len(references)} shards of {count}")
    found: dict[str, Floats] = {}
    for index, reference in enumerate(references):
        found |= shards.decode_pieces(fetch(ctx, reference), [piece for piece in pieces if piece.shard == index])
    return found


def trained(ctx: Context, model: Model, tensors: Sequence[Tensor]) -> dict[str, Floats] | None:
    """Return the values of a model for use: those handed on by a subtask before, else the gateway's; None: it has none.

    Raises:
        ctx.Fail: they are not what the model needs.
    """
    handed = [table for table in map(params.table, ctx.inputs.values()) if isinstance(table.get("model"), dict)]
    try:
        if handed:
            given = params.table(handed[-1]["model"])
            manifest, references = (
                manifest_of(ctx, params.table(given.get("manifest"))),
                params.rows(given.get("shards")),
            )
            check_count(manifest, references)
            files = [fetch_shard(ctx, manifest, references, number) for number in range(len(references))]
        else:
            folder = ctx.host_folder(FOLDER) / TRAINED / model.name
            if not (folder / "manifest.json").is_file():
                return None
            manifest = shards.parse_manifest(parse_json((folder / "manifest.json").read_bytes()))
            files = [
                (folder / f"model-{number:05d}.safetensors").read_bytes() for number in range(len(manifest.shards))
            ]
        check_tensors(manifest, tensors)
        return shards.join(manifest, files)
    except (ModelFileError, OSError) as error:
        raise ctx.Fail(f"the trained model {model.name} cannot be used: {error}", "export it again") from error


def trained_or_fail(ctx: Context, model: Model) -> dict[str, Floats]:
    """Return the values of a model for use; ctx.Fail where neither a subtask nor the gateway has one."""
    values = trained(ctx, model, model.tensors(len(class_names(ctx, model))))
    if values is None:
        raise ctx.Fail(
            f"there is no trained model {model.name} on this gateway",
            f"train one (swiftbot learn start {model.name}) and export it to {TRAINED}/{model.name} of its folder",
        )
    return values


def class_names(ctx: Surroundings, model: Model) -> tuple[str, ...]:
    """Return the classes of the gateway's trained model: `classes.txt` beside it, a line each, else the model's own."""
    file = ctx.host_folder(FOLDER) / TRAINED / model.name / "classes.txt"
    if not file.is_file():
        return model.classes
    return tuple(line.strip() for line in file.read_text(encoding="utf-8").splitlines() if line.strip())


# --- data


class Share(NamedTuple):
    """A client's part of a data set, ready to be learned from."""

    arrays: loading.Arrays
    targets: list[Any]
    classes: tuple[str, ...]
    damaged: int
    listed: int
    """Items of the part before damaged ones and `indices`."""


def share(
    ctx: Context,
    model: Model,
    data: str,
    part: Part,
    *,
    run_seed: int,
    split: Literal["train", "test"] = "train",
    limit: int | None = None,
) -> Share:
    """Load a client's part of a data set; ctx.Fail, with the list of damaged files, where it cannot be used.

    Args:
        ctx: of the run.
        model: what is trained: it decides how items are decoded, and which classes there are where the data name none.
        data: path of the data set in the gateway's folder.
        part: which items.
        run_seed: what the partition is drawn from.
        split: of the data set.
        limit: at most so many items, spread over the part.
    """
    folder = ctx.host_folder(FOLDER) / data
    try:
        listing = labelled(loading.read(folder, split, cache=ctx.cache), model)
        loading.refuse_if_damaged(listing.damaged, len(listing.items), what=data)
        parts = partition.split(listing.items, by=part.by, of=part.of, seed=derive(run_seed, 0, "", "partition"))
        held = [int(index) for index in parts[part.number]]
        chosen = picked(held, part)
        if limit is not None and limit < len(chosen):
            chosen = [chosen[at * len(chosen) // limit] for at in range(limit)]
        found = loading.load(listing, chosen, model.input, cache=ctx.cache, alive=Alive(ctx))
    except DataError as error:
        raise ctx.Fail(error.message, error.remedy) from error
    classes = listing.classes
    return Share(
        arrays=found.arrays,
        targets=[target(item, classes, model.task) for item in found.items],
        classes=classes,
        damaged=len(listing.damaged) + len(found.damaged),
        listed=len(held),
    )


def labelled(listing: Listing, model: Model) -> Listing:
    """Return a listing with the model's classes where the data name none; what has another label is damaged."""
    if model.task == "transcribe":
        known = set(model.classes)
        wrong = [item for item in listing.items if not set(item.label) <= known]
        reason = "its transcript has symbols that the model does not know"
        named = listing._replace(classes=model.classes)
    elif listing.classes:
        return listing
    else:
        wrong = [item for item in listing.items if item.label not in model.classes]
        reason = "its transcript is none of the model's classes"
        named = listing._replace(classes=model.classes)
    return named.without(loading.Damage(item.path, f"{reason}: {item.label[:40]!r}") for item in wrong)


def picked(held: Sequence[int], part: Part) -> list[int]:
    """Return the items of a part, or of it those positions that it names; DataError beyond its end."""
    if part.indices is None:
        return list(held)
    if max(part.indices) >= len(held):
        raise DataError(
            f"part.indices has {max(part.indices)}, the part has {len(held)} items", "name positions within the part"
        )
    return [held[index] for index in part.indices]


def target(item: Item, classes: Sequence[str], task: str) -> Any:
    """Return what a model is to say of an item: the number of its class, or the numbers of its symbols."""
    if task == "transcribe":
        return tuple(classes.index(symbol) for symbol in item.label)
    return classes.index(item.label)
