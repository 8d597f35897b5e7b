"""A router: what a large fleet's gateways are clients of, so that they need no links with each other.

A few gateways link as peers, each with each. Beyond some thirty that costs too much memory and descriptors; there,
three to five routers are linked sparsely (a line or a star: link state does not scale in dense graphs), and every
gateway is a client of those near it (`plane.mode = "client"`). A router holds no records and no place on the ring:
the overlay addresses gateways by key and the routers find the way, so any of them can be restarted at any time.
Eclipse Zenoh's own `zenohd` does the same; this one needs nothing that a gateway does not have.
"""

import asyncio
from collections.abc import Callable

import structlog
from msgspec.structs import replace

from appliance.errors import ConfigError
from appliance.plane.session import Session
from appliance.plane.settings import PlaneConfig

log = structlog.get_logger(__name__)

_FLEET = "router"
"""A session belongs to a fleet by the keys it uses; a router uses none, and routes for all fleets."""
_LOOK_S = 1.0


async def run_router(
    config: PlaneConfig, *, stop: asyncio.Event, ready: Callable[[Session], None], alive: Callable[[], None]
) -> None:
    """Route until `stop`. `ready` is called once it listens, `alive` about every second after that.

    Raises:
        ConfigError: there is nothing to listen on, or it is in use.
    """
    if not config.listen:
        raise ConfigError("a router has nothing to listen on", remedy="give --listen, such as tcp/0.0.0.0:7447")
    session = await Session.open(replace(config, mode="router"), _FLEET)
    try:
        log.info("routing", listen=config.listen, connect=config.connect)
        ready(session)
        linked = -1
        while not stop.is_set():
            alive()
            if session.linked != linked:
                linked = session.linked
                log.info("linked", routers_and_peers=linked)
            try:
                async with asyncio.timeout(_LOOK_S):
                    await stop.wait()
            except TimeoutError:
                continue
    finally:
        await session.close()
    log.info("stopped")
