"""Files that later runs compare with, by name, in the state volume `baselines`. Written in one step."""

import os
import uuid
from collections.abc import Callable
from typing import TypeVar

from . import params
from .context import Context

VOLUME = "baselines"

T = TypeVar("T")


def last(ctx: Context, name: str, read: Callable[[bytes], T]) -> T | None:
    """Return what was kept under a name as `read` understands it; None when nothing was, or it is damaged (logged)."""
    try:
        data = (ctx.volume(VOLUME) / params.slug(name)).read_bytes()
    except FileNotFoundError:
        return None
    try:
        return read(data)
    except Exception as error:  # noqa: BLE001 - whatever is wrong with the file, the next comparison must not fail for it
        ctx.log(f"what was kept as {name} cannot be read and is replaced", reason=str(error), bytes=len(data))
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
