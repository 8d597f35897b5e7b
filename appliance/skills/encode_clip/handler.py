"""encode_clip: pictures of a clip into 64 numbers, by the network that `swiftbot learn` trains as `clips`."""

import io
from typing import Any

import numpy as np
from _lib import params, pictures
from _lib.context import Context
from _lib.learning import loading, training, work
from PIL import Image

MODEL = "clips"
FEW = 8
"""Below so many pictures a movement can hardly be told."""


def run(ctx: Context) -> dict[str, Any]:
    """Return features (64 numbers), how many frames they are of, and the model's name."""
    given = _frames(ctx)
    if not given:
        raise ctx.CallError("precondition", "no frames were handed on", "extract frames in a subtask before this one")
    training.set_threads()
    model = work.model_of(ctx, MODEL)
    values = work.trained_or_fail(ctx, model)
    chosen = [given[at] for at in loading.spread(len(given), loading.FRAMES)]
    seen: dict[str, Any] = {}
    for number, reference in enumerate(chosen, start=1):
        digest = str(reference["artifact"])
        if digest not in seen:
            seen[digest] = _grey(ctx, reference)
        ctx.progress(0.9 * number / len(chosen), f"frame {number} of {len(chosen)}")
    clip = np.stack([seen[str(reference["artifact"])] for reference in chosen])
    module = training.build(model, len(work.class_names(ctx, model)))
    training.put(module, values)
    features = training.features(module, clip)
    result: dict[str, Any] = {"features": features, "model": MODEL, "count": len(given)}
    if len(given) < FEW:
        result["note"] = f"only {len(given)} frames: extract at least {FEW}, with a higher fps, to tell a movement"
    return result


def _frames(ctx: Context) -> list[pictures.Reference]:
    """Return the frames handed on last, in order; the same picture again is a moment in which nothing moved."""
    lists = [rows for table in ctx.inputs.values() if (rows := params.rows(params.table(table).get("frames")))]
    frames = lists[-1] if lists else list(pictures.references(ctx.inputs, "image/"))
    return [frame for frame in frames if isinstance(frame.get("artifact"), str)]


def _grey(ctx: Context, reference: pictures.Reference) -> Any:
    try:
        picture = Image.open(io.BytesIO(ctx.get_artifact(reference)))
        return np.asarray(picture.convert("L").resize((loading.SIDE, loading.SIDE), Image.Resampling.BILINEAR))
    except (OSError, ValueError, Image.DecompressionBombError) as error:
        name = str(reference.get("name", "frame"))
        raise ctx.Fail(f"{name} is no picture: {error}", "extract the frames again") from error
