"""Reads a handler's parameters: plans come from a language model, so nothing is taken on trust."""

import math
import re
from typing import Any, cast

from .context import Context


def text(ctx: Context, name: str, *, default: str | None = None) -> str:
    """Return a text parameter, trimmed; ctx.Fail when it is missing without default, empty or no text."""
    value = ctx.params.get(name)
    if value is None and default is not None:
        return default
    if not isinstance(value, str) or not value.strip():
        raise ctx.CallError("payload", f"parameter {name!r} is missing or empty", f"give {name} as text")
    return " ".join(value.split())[:2000]


def number(ctx: Context, name: str, *, default: float, low: float, high: float) -> float:
    """Return a number parameter in `low` to `high`; ctx.Fail otherwise."""
    value = ctx.params.get(name)
    if value is None:
        return default
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ctx.CallError("payload", f"{name} is {value!r}, not a number", f"give a number from {low:g} to {high:g}")
    if not low <= value <= high:
        raise ctx.CallError(
            "payload", f"{name} is {value:g}, outside {low:g} to {high:g}", f"give a number from {low:g} to {high:g}"
        )
    return float(value)


def whole(ctx: Context, name: str, *, default: int, low: int, high: int) -> int:
    """Return a whole-number parameter in `low` to `high`; ctx.Fail otherwise."""
    value = number(ctx, name, default=default, low=low, high=high)
    if value != int(value):
        raise ctx.CallError("payload", f"{name} is {value:g}, not a whole number", f"give one from {low} to {high}")
    return int(value)


def table(value: object) -> dict[str, Any]:
    """Return a value of a result if it is a dict, an empty one otherwise."""
    return cast("dict[str, Any]", value) if isinstance(value, dict) else {}


def rows(value: object) -> list[dict[str, Any]]:
    """Return the dicts of a list in a result, an empty list where it is none."""
    return [table(each) for each in cast("list[Any]", value) if each] if isinstance(value, list) else []


def slug(name: str) -> str:
    """Return a name fit for a file: `red box` is `red-box`."""
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")[:60] or "file"
