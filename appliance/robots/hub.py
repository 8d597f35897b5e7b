"""Robots as one gateway has them: its MAVLink vehicles, and the tasks that robots of the fleet ask for.

Zenoh robots speak for themselves and need nothing of a gateway; MAVLink vehicles are spoken for by the vehicle manager.
"""

import asyncio
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import structlog

from appliance.errors import NotFoundError, RefusedError
from appliance.model import RobotCommand, RobotInfo, Site, TaskRequest, keyspace
from appliance.model.robot_api import Forgotten, LinkAdd, LinkFacts, LinkList, LinkRemove, LinksAsk, RobotForget
from appliance.plane.session import Session
from appliance.robots.executor import KeyValues
from appliance.robots.settings import RobotsConfig
from appliance.robots.task_listener import TaskListener, Tasks

if TYPE_CHECKING:
    from appliance.robots.mavlink.node import MavlinkNode


log = structlog.get_logger(__name__)

ADDED_LINKS = "mavlink/links"
"""Where links added at run time are kept in the gateway's store."""


class RobotHub:
    """One per gateway. `refused` counts bad input by kind; `on_task` and `tasks` take what robots ask for.

    `gate` says why a robot may not be given a command just now; `roster` is what is known of the fleet's robots.
    """

    def __init__(
        self,
        config: RobotsConfig,
        *,
        session: Session,
        store: KeyValues,
        gateway: str,
        site: Site,
        on_task: Callable[[str, TaskRequest], None] | None = None,
        tasks: Tasks | None = None,
        gate: Callable[[str, RobotCommand], str] = lambda _, __: "",
        roster: Mapping[str, RobotInfo] | None = None,
        keeps_ground: Callable[[str], bool] = lambda _: False,
    ) -> None:
        self._config = config
        self._roster: Mapping[str, RobotInfo] = {} if roster is None else roster
        self._keeps_ground = keeps_ground
        """Whether ground is kept for a robot of that name, which the roster may not have any more."""
        self._gate = gate
        self._session = session
        self._store = store
        self._gateway = gateway
        self._site = site
        self._tasks = tasks
        self.refused: dict[str, int] = {}
        submit = None if tasks is None else tasks.submit_of
        self._intake = None if on_task is None else TaskListener(session, on_task, self.refused, submit=submit)
        self._mavlink: MavlinkNode | None = None
        self._opening = asyncio.Lock()

    @property
    def attached(self) -> tuple[str, ...]:
        """Names of the MAVLink vehicles heard since start, online or not."""
        return () if self._mavlink is None else self._mavlink.vehicles.attached

    async def start(self) -> None:
        """Bind the ports and begin; ConfigError with the remedy when a setting is wrong or a port taken."""
        self._config.check()
        if self._config.mavlink or await self._store.scan(ADDED_LINKS):
            await self._open_mavlink()
        if self._intake is not None:
            self._intake.start()

    async def _open_mavlink(self) -> "MavlinkNode":
        async with self._opening:
            if self._mavlink is not None:
                return self._mavlink
            # pymavlink's dialect costs 15 MB and 30 ms: only gateways with vehicles pay for it.
            from appliance.robots.mavlink.node import MavlinkNode  # noqa: PLC0415

            node = MavlinkNode(
                self._config,
                session=self._session,
                store=self._store,
                gateway=self._gateway,
                site=self._site,
                refused=self.refused,
                tasks=self._tasks,
                gate=self._gate,
            )
            await node.start()
            self._mavlink = node
            return node

    # --- links at run time: the verbs robot_links, robot_link_add, robot_link_remove ---------------------------

    async def links(self, ask: LinksAsk) -> LinkList:
        """All MAVLink links of this gateway, and what went over them."""
        del ask
        return LinkList(gateway=self._gateway) if self._mavlink is None else self._mavlink.link_list()

    async def add_link(self, ask: LinkAdd) -> LinkFacts:
        """Open a link and keep it over restarts; ConfigError or RefusedError when it cannot be."""
        ask.link.check()
        node = await self._open_mavlink()
        return await node.links.add(ask.link, by=ask.by)

    async def remove_link(self, ask: LinkRemove) -> LinkFacts:
        """Close a link for good; NotFoundError when there is none of that name."""
        if self._mavlink is None:
            raise NotFoundError(f"no MAVLink link {ask.url[:120]!r}", remedy="this gateway has none")
        return await self._mavlink.remove_link(ask.url, by=ask.by)

    async def forget(self, ask: RobotForget) -> Forgotten:
        """Remove the row of a robot that is offline, here and in every roster: the verb robot_forget.

        Raises:
            NotFoundError: there is none of that name.
            RefusedError: it is online, and would be back at once.
        """
        name = ask.robot[:120]
        mine = name in self.attached
        known = self._roster.get(name)
        if not mine and known is None and not self._keeps_ground(name):
            raise NotFoundError(f"no robot {name!r}", remedy="see `swiftbot robots`")
        if (known is not None and known.online) or (self._mavlink is not None and self._mavlink.vehicles.online(name)):
            raise RefusedError(f"{name} is online", remedy="switch it off, or remove its link, first")
        if self._mavlink is not None:
            await self._mavlink.vehicles.forget(name)
        # A deleted key is what every roster knows a removed row by.
        self._session.delete(self._session.keys(keyspace.ROBOT, name))
        log.info("robot forgotten", robot=name, by=ask.by[:120])
        return Forgotten(robot=name, gateway=self._gateway)

    async def stop(self) -> None:
        """End commands (the next process resumes them), take back what was declared, close the ports."""
        if self._intake is not None:
            self._intake.stop()
        if self._mavlink is not None:
            await self._mavlink.stop()
            self._mavlink = None
