"""detect: find coloured things in the pictures handed on, or in one taken now."""

from typing import Any

from _lib import looking, params
from _lib.context import Context


def run(ctx: Context) -> dict[str, Any]:
    """Return detections, count, target, the pictures looked at and marked copies of them."""
    target = params.text(ctx, "target")
    return looking.detect(ctx, target, looking.images(ctx, target))
