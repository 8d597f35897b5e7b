"""Pictures and other files between handlers: taking them, finding them among the inputs."""

from collections.abc import Iterator
from typing import Any, cast

from . import params
from .context import Context

MAX_PICTURES = 20
"""Pictures of its inputs a skill looks at; the newest."""

Reference = dict[str, Any]


def take(ctx: Context, target: str) -> tuple[bytes, dict[str, Any]]:
    """Take one picture; return its PNG bytes and what the robot says about it."""
    answer = ctx.command("capture", timeout_s=60, target=target)
    blobs: dict[str, bytes] = answer.get("blobs") or {}
    about = {key: value for key, value in answer.items() if key != "blobs"}
    data = blobs.get("image.png") or next((blobs[name] for name in sorted(blobs)), b"")
    if not data:
        raise ctx.Fail(f"{ctx.robot} sent no picture of {target}", "look at its camera", retryable=True)
    return data, about


def keep(ctx: Context, target: str, data: bytes, number: int = 1) -> Reference:
    """Store a picture under a name that says what it shows."""
    return ctx.put_artifact(f"{params.slug(target)}-{number}.png", data, media_type(data))


def media_type(data: bytes) -> str:
    """Tell PNG from JPEG by the first bytes; robots send either."""
    return "image/jpeg" if data[:3] == b"\xff\xd8\xff" else "image/png"


def references(value: Any, kind: str) -> Iterator[Reference]:
    """Yield every file reference of a media type (`image/`, `video/`) in a result, in order, each file once."""
    seen: set[str] = set()
    for found in _walk(value, 0):
        if str(found.get("media_type", "")).startswith(kind) and found["artifact"] not in seen:
            seen.add(found["artifact"])
            yield found


def _walk(value: Any, depth: int) -> Iterator[Reference]:
    if depth > 8:
        return
    if isinstance(value, dict):
        table = params.table(cast("object", value))
        if isinstance(table.get("artifact"), str):
            yield table
            return
        for key, each in table.items():
            if key != "annotated":  # a marked copy is for people; looking at it again would find the marks
                yield from _walk(each, depth + 1)
    elif isinstance(value, list | tuple):
        for each in cast("list[Any]", value):
            yield from _walk(each, depth + 1)
