"""aggregate: many clients' updates into one new model; `_lib.learning.aggregation` does it, shard by shard."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from _lib import params
from _lib.context import Context
from _lib.learning import aggregation, masks, models, orders, shards, work
from _lib.learning.aggregation import Aggregator, File, TooFewError, Update, Verdict
from _lib.learning.masks import Masked, Seed
from _lib.learning.orders import Aggregation, OrderError
from _lib.learning.shards import ModelFileError, Piece, Spec


def run(ctx: Context) -> dict[str, Any]:
    """Return the new model (shards, manifest), a verdict on each update, the weight summed and the bound of norms.

    Of too few updates no model can be made: with `report` the verdicts and how many are `needed` are returned, without
    it the run fails.
    """
    try:
        order = orders.aggregation(_with_inputs(ctx))
    except OrderError as error:
        raise work.refused(ctx, error) from error
    model = work.model_of(ctx, order.model)
    if order.masks is not None:
        return _unmasked(ctx, order, model, order.masks)
    refused: dict[str, Verdict] = {}
    updates = _updates(ctx, order, refused)
    classes = order.classes or _classes([file.manifest for each in updates for file in each.files], model)
    pieces = shards.layout(Spec(each.name, "F32", each.shape) for each in model.tensors(classes))
    references: dict[int, dict[str, Any]] = {}

    def keep(index: int, data: bytes) -> None:
        references[index] = ctx.put_artifact(f"model-{index:05d}.safetensors", data, "application/x-safetensors")
        ctx.progress((index + 1) / (1 + pieces[-1].shard), f"shard {index + 1} of {1 + pieces[-1].shard}")

    try:
        aggregator = Aggregator(pieces, _base(ctx, order, model, classes, pieces), keep, alive=work.Alive(ctx))
        result = aggregator.run(updates, order.rule, clip=order.clip, noise=order.noise)
    except ModelFileError as error:
        raise work.base_refused(ctx, error) from error
    except TooFewError as error:
        if order.report:
            return {"needed": error.needed, "verdicts": _told(refused | error.verdicts)}
        raise _refusal(ctx, error, refused) from error
    except ValueError as error:
        raise _refusal(ctx, error, refused) from error
    manifest = result.manifest.to_json()
    kept = [references[index] for index in sorted(references)]
    verdicts = _told(refused | result.verdicts)
    return {
        "model": {"manifest": manifest, "shards": kept},
        "manifest": manifest,
        "shards": kept,
        "verdicts": verdicts,
        "norms": {client: each["norm"] for client, each in verdicts.items() if each["norm"] is not None},
        "weight": result.weight,
        "bound": result.bound,
    }


def _unmasked(ctx: Context, order: Aggregation, model: work.Model, seeds: Sequence[Seed]) -> dict[str, Any]:
    """Return the new model of masked updates, of which nothing but their sum can be read.

    Where it cannot be made of all of them, what was summed is not known to anybody: with `report` that is a result,
    with a verdict on the client whose file is wrong, or, where masks do not cancel, on all.
    """
    updates: list[Masked] = []
    unreadable: dict[str, Verdict] = {}
    for each in order.updates:
        try:
            manifest = work.manifest_of(ctx, each.manifest)
            work.check_count(manifest, each.shards)
            fetch = partial(work.fetch_shard, ctx, manifest, each.shards)
            updates.append(Masked(each.client, manifest, fetch, each.weight))
        except ModelFileError as error:
            unreadable[each.client] = Verdict(accepted=False, reason=error.reason, message=str(error))
    classes = order.classes or _classes([each.manifest for each in updates], model)
    tensors = model.tensors(classes)
    try:
        if unreadable:
            raise TooFewError("an update cannot be read", 1, unreadable)
        layout = shards.layout(Spec(each.name, "I64", each.shape) for each in tensors)
        changes = masks.mean(updates, layout, seeds)
    except masks.UnreadableError as error:
        verdict = Verdict(accepted=False, reason=error.reason, message=str(error))
        return _too_few(ctx, order, TooFewError(str(error), 1, {error.client: verdict}))
    except ValueError as error:
        told = {each.client: Verdict(accepted=False, reason="lost", message=str(error)) for each in order.updates}
        return _too_few(ctx, order, error if isinstance(error, TooFewError) else TooFewError(str(error), 1, told))
    base = work.base_values(ctx, order.base, tensors, order.seed)
    deviation = 0.0 if order.noise is None else order.noise / sum(each.weight for each in updates)
    noisy = {name: aggregation.noisy(changes.pop(name), deviation) for name in sorted(base)}
    values = {name: (base[name] + change).astype(np.float32) for name, change in noisy.items()}
    manifest, references = work.keep(ctx, values, "model")
    verdicts = _told({each.client: Verdict(accepted=True) for each in updates})
    made = {"manifest": manifest, "shards": references}
    return {"model": made, **made, "verdicts": verdicts, "weight": sum(each.weight for each in updates)}


def _too_few(ctx: Context, order: Aggregation, error: TooFewError) -> dict[str, Any]:
    if not order.report:
        raise _refusal(ctx, error, {})
    return {"needed": error.needed, "verdicts": _told(error.verdicts)}


def _told(verdicts: Mapping[str, Verdict]) -> dict[str, dict[str, Any]]:
    return {client: each._asdict() for client, each in verdicts.items()}


def _refusal(ctx: Context, error: ValueError, refused: Mapping[str, Verdict]) -> Exception:
    """Return the exception that ends an aggregation that cannot be."""
    reasons = "; ".join(f"{client}: {each.message}" for client, each in refused.items())
    text = f"{error}; {reasons}" if reasons else str(error)
    return ctx.CallError("precondition", text[:2000], "wait for more updates, or take another rule")


def _with_inputs(ctx: Context) -> dict[str, Any]:
    """Return the parameters; in a plan the updates are the results of the subtasks before."""
    given = dict(ctx.params)
    if "updates" not in given:
        results = [
            (name, result) for name, result in sorted(ctx.inputs.items()) if isinstance(result.get("update"), dict)
        ]
        given["updates"] = [
            {
                "client": name,
                **params.table(result["update"]),
                "weight": int(result.get("samples", 0)) * 1024,
                "scale": {"num": result.get("steps_of_epoch", 1), "den": result.get("steps", 1)}
                if result.get("steps", 0) < result.get("steps_of_epoch", 0)
                else 1,
            }
            for name, result in results
        ]
    return given


def _updates(ctx: Context, order: Aggregation, refused: dict[str, Verdict]) -> list[Update]:
    """Return the updates whose manifests can be read; those of one client are parts of one whole.

    What cannot be read goes into `refused`, with all of its client's.
    """
    found: dict[str, Update] = {}
    for each in order.updates:
        try:
            manifest = work.manifest_of(ctx, each.manifest)
            work.check_count(manifest, each.shards)
        except ModelFileError as error:
            refused[each.client] = Verdict(accepted=False, reason=error.reason, message=str(error))
            continue
        coded = each.coding == "int8"
        fetch = work.fetch_coded if coded else work.fetch_shard
        file = File(manifest, partial(fetch, ctx, manifest, each.shards), coded)
        before = found.get(each.client, Update(each.client, (), each.weight, each.scale))
        if manifest.digest in {other.manifest.digest for other in before.files}:
            ctx.log(f"an update of {each.client} is there twice and counts once")
            continue
        found[each.client] = before._replace(files=(*before.files, file))
    return [each for each in found.values() if each.client not in refused]


def _classes(manifests: Sequence[shards.Manifest], model: work.Model) -> int:
    """Return how many classes the model has: as most updates say."""
    symbolic = [(name, shape.index("classes")) for name, shape in model.shapes if "classes" in shape]
    if not symbolic:
        return len(model.classes)
    name, axis = symbolic[0]
    votes = [
        spec.shape[axis]
        for manifest in manifests
        for spec in shards.specs(manifest)
        if spec.name == name and len(spec.shape) > axis
    ]
    return max(set(votes), key=lambda vote: (votes.count(vote), -vote)) if votes else len(model.classes)


def _base(
    ctx: Context, order: Aggregation, model: work.Model, classes: int, pieces: tuple[Piece, ...]
) -> aggregation.Base:
    """Return what gives the values of a shard of the model that the round began with.

    Raises:
        ModelFileError: the model is none of this kind.
    """
    if order.base is None:
        initial = models.initial(model.tensors(classes), order.seed)
        return partial(_initial, initial, pieces)
    manifest = work.manifest_of(ctx, order.base.manifest)
    work.check_count(manifest, order.base.shards)
    work.check_tensors(manifest, model.tensors(classes))
    given = order.base

    def fetch(index: int) -> Mapping[str, Any]:
        return shards.decode(work.fetch_shard(ctx, manifest, given.shards, index), manifest, index)

    return fetch


def _initial(values: Mapping[str, Any], pieces: tuple[Piece, ...], index: int) -> Mapping[str, Any]:
    """Return the initial values of a shard's pieces."""
    found: dict[str, Any] = {}
    rows: dict[str, int] = {}
    for piece in pieces:
        start = rows.get(piece.name, 0)
        if piece.cut is not None:
            rows[piece.name] = start + piece.shape[0]
        if piece.shard == index:
            whole = values[piece.name]
            found[piece.key] = whole if piece.cut is None else whole[start : start + piece.shape[0]]
    return found
