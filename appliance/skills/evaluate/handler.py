"""evaluate: how good a model is on data that it was not trained on; or, with `export`, the model in another format."""

import json
from typing import Any

from _lib.context import Context
from _lib.learning import orders, training, work
from _lib.learning.models import Model
from _lib.learning.orders import Base, OrderError
from _lib.learning.shards import ModelFileError
from _lib.learning.training import Samples


def run(ctx: Context) -> dict[str, Any]:
    """Return number and accuracy (0 to 1), loss, items; of sentences 1 less the word error rate is the accuracy.

    With `export`: the format, its file as an artifact, and an artifact with what the model makes of some inputs.
    """
    try:
        order = orders.evaluation(ctx.params)
    except OrderError as error:
        raise work.refused(ctx, error) from error
    training.set_threads()
    model = work.model_of(ctx, order.model)
    if order.export:
        return _exported(ctx, model, order.base, order.export)
    ctx.progress(0.0, f"loading {order.data}")
    held = work.share(ctx, model, order.data, order.part, run_seed=order.seed, split=order.split, limit=order.limit)
    tensors = model.tensors(len(held.classes))
    values = work.trained(ctx, model, tensors) if order.base is None else None
    if values is None:
        values = work.base_values(ctx, order.base, tensors, order.seed)
    try:
        module = training.build(model, len(held.classes))
    except ValueError as error:
        raise ctx.Fail(str(error), "write model.toml and model.py alike") from error
    training.put(module, values)
    count = len(held.arrays)
    verdict = training.judge(
        module,
        Samples(held.arrays, held.targets),
        model.task,
        symbols=held.classes,
        alive=lambda done: ctx.progress(done / count, f"{done} of {count} items"),
    )
    accuracy = verdict.right / max(1, verdict.total)
    return {
        "number": accuracy,
        "target": f"accuracy of {order.model}",
        "accuracy": accuracy,
        "loss": verdict.loss,
        "items": verdict.items,
        "right": verdict.right,
        "total": verdict.total,
        "damaged": held.damaged,
    }


def _exported(ctx: Context, model: Model, base: Base | None, format_: str) -> dict[str, Any]:
    from _lib.learning import onnx_export  # noqa: PLC0415 - what is judged does not need it

    if base is None:
        raise ctx.Fail("there is no trained model to export", "name one that a run keeps (swiftbot learn models RUN)")
    try:
        classes = model.classes_of(work.shapes_of(work.manifest_of(ctx, base.manifest)))
        module = training.build(model, classes)
        training.put(module, work.base_values(ctx, base, model.tensors(classes), 0))
        data, checks = onnx_export.to_onnx(module, model)
    except ModelFileError as error:
        raise work.base_refused(ctx, error) from error
    except ValueError as error:
        raise ctx.Fail(str(error), "export it as safetensors, which takes any model") from error
    file = ctx.put_artifact(f"{model.name}.{format_}", data, "application/octet-stream")
    check = ctx.put_artifact("checks.json", json.dumps(checks).encode(), "application/json")
    return {
        "number": 1.0,
        "target": f"{format_} file of {model.name}",
        "format": format_,
        "file": file,
        "checks": check,
    }
