"""State volumes and images: which state is here and the newest, and how what is elsewhere comes here.

Doors:
    State, ALONE           what the pool asks of all this, as plain functions: a pool without other gateways (a
                           benchmark, a test) has none of it, everything is here and nothing can be brought
    registry.Volumes       this gateway's volumes: versions, and which runs use them
    transfers.Transfers    bring a volume or an image here; serve ours to others

One transfer for both: what is moved is named by a manifest, and moved in chunks over Zenoh, checked, compressed,
resumable. A volume's manifest is of a tar archive; an image's of a list of blobs, each with a manifest of its own.

Inside: lineage (which state is newer; pure), store (volumes on this machine), archive (a volume as a tar file),
protocol (what is moved, how fast; pure), source (gives), target (fetches). Settings: `TransferConfig` of
`pool.settings`.
"""

import contextlib
from collections.abc import AsyncGenerator, Awaitable, Callable, Iterable
from contextlib import AbstractAsyncContextManager

from msgspec import Struct

from appliance.errors import NotFoundError


@contextlib.asynccontextmanager
async def _unwatched(names: Iterable[str]) -> AsyncGenerator[None]:
    del names
    yield


async def _all_here(names: Iterable[str]) -> None:
    del names


async def _nobody_has(reference: str) -> None:
    raise NotFoundError(f"no other gateway is known that has {reference}")


class State(Struct, frozen=True, kw_only=True):
    """Where state and images come from."""

    bring: Callable[[Iterable[str]], Awaitable[object]] = _all_here
    """Bring the newest state of these volumes here; nothing when it is here already."""
    use: Callable[[Iterable[str]], AbstractAsyncContextManager[None]] = _unwatched
    """A run uses these volumes for as long as the context lasts; at its end what changed is noted for the fleet."""
    newest_here: Callable[[str], bool] = lambda _: True
    """Whether no newer state of a volume than ours is known of."""
    bring_image: Callable[[str], Awaitable[object]] = _nobody_has
    """Bring an image here from a gateway that has it."""


ALONE = State()
"""A pool without other gateways."""
