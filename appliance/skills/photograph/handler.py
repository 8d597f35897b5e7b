"""photograph: take one or several pictures of a target and keep them."""

from typing import Any

from _lib import params, pictures
from _lib.context import Context


def run(ctx: Context) -> dict[str, Any]:
    """Return image (the first), images, target, count and what the camera said."""
    target = params.text(ctx, "target")
    count = params.whole(ctx, "count", default=1, low=1, high=10)
    images: list[pictures.Reference] = []
    about: dict[str, Any] = {}
    for number in range(1, count + 1):
        data, about = pictures.take(ctx, target)
        images.append(pictures.keep(ctx, target, data, number))
        ctx.progress(number / count, f"picture {number} of {count}")
        if number < count:
            ctx.partial({"images": images})
    return {"image": images[0], "images": images, "target": target, "count": count, "camera": about}
