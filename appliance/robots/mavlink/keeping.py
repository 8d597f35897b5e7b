"""What signed links know, kept in the store: after a restart nothing old is believed and no time used twice."""

import asyncio
from collections.abc import Iterable

import msgspec
import structlog

from appliance.model import encode
from appliance.robots.ledger import KeyValues
from appliance.robots.mavlink.links import Link
from appliance.robots.mavlink.signing import Memory, Signer, read_key
from appliance.robots.settings import MavlinkLink

log = structlog.get_logger(__name__)

REMEMBER_S = 5.0
"""How often it is kept; `signing.AHEAD` and `signing.SINCE` are longer."""


def _key(link: MavlinkLink) -> str:
    return f"mavlink/signing/{link.remote}"


async def load_signer(link: MavlinkLink, number: int, store: KeyValues) -> Signer | None:
    """Return the key of a link with what it knew before; None for a link that does not sign. ConfigError: no key.

    From then on the time kept is ahead of what is used, so that a crash at any moment makes none be used twice.
    """
    if not link.signing:
        return None
    key = await asyncio.to_thread(read_key, link.signing)
    kept = dict(await store.scan(_key(link))).get(_key(link))
    try:
        memory = msgspec.json.decode(kept, type=Memory) if kept else Memory()
    except msgspec.DecodeError as error:
        log.warning("what a signed link knew is lost", link=str(link.remote), reason=str(error))
        memory = Memory()
    signer = Signer(key, link_id=number % 256, memory=memory)
    await store.put(_key(link), encode(signer.ahead))
    return signer


async def remember(links: Iterable[tuple[MavlinkLink, Link]], store: KeyValues, *, last: bool = False) -> None:
    """Keep what the signed links know; `last`: nothing more is sent or heard, so it is exact."""
    for setting, link in links:
        signer = link.codec.signer
        if signer is not None:
            await store.put(_key(setting), encode(signer.memory if last else signer.ahead))
