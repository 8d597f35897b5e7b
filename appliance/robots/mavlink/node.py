"""MAVLink on one gateway, put together: links, router, vehicles, onboard computer; one loop ticks them."""

import asyncio
import contextlib
from collections.abc import Callable

from appliance.errors import SwiftbotError
from appliance.model import RobotCommand, Site, keyspace
from appliance.model.robot_api import LinkFacts, LinkList
from appliance.plane.session import Session
from appliance.robots.executor import KeyValues
from appliance.robots.mavlink.companion import Companion
from appliance.robots.mavlink.frame_router import FrameRouter, FrameSender, FrameTap
from appliance.robots.mavlink.link_manager import REMEMBER_S, LinkManager, message_names
from appliance.robots.mavlink.routing import RoutingTable
from appliance.robots.mavlink.vehicle_manager import VehicleManager
from appliance.robots.settings import RobotsConfig
from appliance.robots.task_listener import Tasks

_TICK_S = 0.05
_LINKS_S = 1.0
"""How often the facts of links are put."""


class MavlinkNode:
    """All of it; made on the event loop."""

    def __init__(
        self,
        config: RobotsConfig,
        *,
        session: Session,
        store: KeyValues,
        gateway: str,
        site: Site,
        refused: dict[str, int],
        tasks: Tasks | None = None,
        gate: Callable[[str, RobotCommand], str] = lambda _, __: "",
    ) -> None:
        self._config = config
        self._session = session
        self._gateway = gateway
        self.routing = routing = RoutingTable(
            own_system=config.system_id,
            shared=message_names("robots.vehicles_share", config.vehicles_share),
            repeat_s=config.repeat_s,
        )
        self.links = links = LinkManager(
            config, store=store, routing=routing, refused=refused, keyed=session.credentials is not None
        )
        self._tap = tap = FrameTap(session, gateway)
        self._sender = sender = FrameSender(config, links=links, routing=routing, tap=tap)
        self.vehicles = vehicles = VehicleManager(
            config,
            session=session,
            store=store,
            gateway=gateway,
            site=site,
            refused=refused,
            gate=gate,
            links=links,
            routing=routing,
            sender=sender,
            tap=tap,
        )
        self.companion = companion = Companion(
            config,
            session=session,
            store=store,
            site=site,
            refused=refused,
            tasks=tasks,
            links=links,
            routing=routing,
            sender=sender,
            vehicles=vehicles,
        )
        endpoints = (vehicles, tap, companion)
        self._router = FrameRouter(
            config, links=links, routing=routing, tap=tap, sender=sender, endpoints=endpoints, refused=refused
        )
        self._ticking: asyncio.Task[None] | None = None

    async def start(self) -> None:
        """Bind the ports and begin; ConfigError with the remedy when a setting is wrong or a port taken."""
        try:
            await self.companion.open()
            await self.links.open(self._router)
        except SwiftbotError:
            await self.stop()
            raise
        self.vehicles.start()
        self._ticking = asyncio.create_task(self._tick(), name="MAVLink")

    async def stop(self) -> None:
        """End commands (they are resumed by the next process), take back what was declared, close the ports."""
        if self._ticking is not None:
            self._ticking.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._ticking
            self._ticking = None
        await self.companion.close()
        await self.vehicles.stop()
        await self.links.close()

    def link_list(self) -> LinkList:
        """All links, what went over them, and where each sender is."""
        return LinkList(gateway=self._gateway, links=self.links.all_facts(), routes=self.links.routes())

    async def remove_link(self, url: str, *, by: str) -> LinkFacts:
        """Close a link for good and let its vehicles go; NotFoundError when there is none of that name."""
        facts = await self.links.remove(url, by=by)
        self.vehicles.let_go_of(facts.number)
        self._tap.forget(facts.number)
        return facts

    async def _tick(self) -> None:
        loop = asyncio.get_running_loop()
        tell_at, remember_at = 0.0, loop.time() + REMEMBER_S
        while True:
            now = loop.time()
            if now >= remember_at:
                remember_at = now + REMEMBER_S
                with contextlib.suppress(SwiftbotError):  # a disk that is full now may not be so the next time
                    await self.links.remember()
            await self.vehicles.tick(now)
            if now >= tell_at:
                tell_at = now + _LINKS_S
                self._session.publish(keyspace.LINKS, self.link_list(), self._gateway)
            self.companion.tick(now)
            await asyncio.sleep(_TICK_S)
