"""classify_action: what is done in a clip, from the features that encode_clip made of it."""

from typing import Any, cast

import numpy as np
from _lib import params
from _lib.context import Context
from _lib.learning import work

SHOWN = 3
"""Likeliest actions that are in the result."""


def run(ctx: Context) -> dict[str, Any]:
    """Return label, confidence (0 to 1) and the likeliest actions with theirs."""
    given = [table for table in map(params.table, ctx.inputs.values()) if isinstance(table.get("features"), list)]
    if not given:
        raise ctx.CallError(
            "precondition", "no features were handed on", "encode the clip in a subtask before this one"
        )
    model = work.model_of(ctx, str(given[-1].get("model", "clips")))
    values = work.trained_or_fail(ctx, model)
    names = work.class_names(ctx, model)
    weight, bias = values["head.weight"], values["head.bias"]
    features = _numbers(ctx, cast("list[Any]", given[-1]["features"]), weight.shape[1])
    scores = weight.astype(np.float64) @ features + bias
    chances = np.exp(scores - scores.max())
    chances /= chances.sum()
    order = np.argsort(-chances)[:SHOWN]
    best = int(order[0])
    return {
        "label": names[best],
        "confidence": round(float(chances[best]), 4),
        "likely": [{"label": names[int(at)], "confidence": round(float(chances[at]), 4)} for at in order],
    }


def _numbers(ctx: Context, given: list[Any], count: int) -> Any:
    try:
        features = np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        features = np.zeros(0)
    if features.shape != (count,) or not np.isfinite(features).all():
        raise ctx.CallError(
            "payload", f"the features are not {count} finite numbers", "encode the clip again with the same model"
        )
    return features
