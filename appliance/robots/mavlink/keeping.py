"""What signed links know, kept in the store: after a restart nothing old is believed and no time used twice."""

import asyncio
from collections.abc import Sequence

import msgspec
import structlog

from appliance.model import encode
from appliance.robots.ledger import KeyValues
from appliance.robots.mavlink.links import Link
from appliance.robots.mavlink.signing import Memory, Signer, read_key
from appliance.robots.settings import MavlinkLink

log = structlog.get_logger(__name__)

REMEMBER_S = 5.0
"""How often it is kept; what a crash forgets may be replayed within a minute."""


def _key(link: MavlinkLink) -> str:
    return f"mavlink/signing/{link.remote}"


async def load_signer(link: MavlinkLink, index: int, store: KeyValues) -> Signer | None:
    """Return the key of a link with what it knew before; None for a link that does not sign. ConfigError: no key."""
    if not link.signing:
        return None
    key = await asyncio.to_thread(read_key, link.signing)
    kept = dict(await store.scan(_key(link))).get(_key(link))
    try:
        memory = msgspec.json.decode(kept, type=Memory) if kept else Memory()
    except msgspec.DecodeError as error:
        log.warning("what a signed link knew is lost", link=str(link.remote), reason=str(error))
        memory = Memory()
    return Signer(key, link_id=index % 256, memory=memory)


async def remember(links: Sequence[Link], settings: Sequence[MavlinkLink], store: KeyValues) -> None:
    """Keep what the signed links know."""
    for link, setting in zip(links, settings, strict=False):
        if link.codec.signer is not None:
            await store.put(_key(setting), encode(link.codec.signer.memory))
