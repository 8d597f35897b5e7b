"""Files that later runs compare with, by name, in the state volume `baselines`. Written in one step."""

import os
import uuid

from . import params
from .context import Context

VOLUME = "baselines"


def last(ctx: Context, name: str) -> bytes | None:
    """Return what was kept under a name, None when nothing was."""
    try:
        return (ctx.volume(VOLUME) / params.slug(name)).read_bytes()
    except FileNotFoundError:
        return None


def keep(ctx: Context, name: str, data: bytes) -> None:
    """Keep data under a name, in place of what was there."""
    folder = ctx.volume(VOLUME)
    fresh = folder / f".{uuid.uuid4().hex}"
    try:
        fresh.write_bytes(data)
        os.replace(fresh, folder / params.slug(name))  # noqa: PTH105 - the same with a path
    finally:
        fresh.unlink(missing_ok=True)
