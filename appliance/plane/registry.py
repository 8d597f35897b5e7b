"""The latest facts of the fleet: every gateway's status and containers, every robot. Each fact has one owner.

Owners put facts when they change; whoever comes later asks each member once (`facts`). What a gateway said goes
with it; a robot whose token goes is shown offline for a while and then forgotten.
"""

import asyncio
import contextlib
import math
import time
from collections.abc import Callable

import structlog
from msgspec import Struct
from msgspec.structs import replace

from appliance.errors import SwiftbotError
from appliance.model import ContainerInfo, ContainerState, GatewayStatus, RobotInfo, encode
from appliance.plane.membership import Membership
from appliance.plane.rpc import Rpc
from appliance.plane.session import Closer, Session
from appliance.plane.settings import PlaneConfig

log = structlog.get_logger(__name__)

ROBOT_KEPT_S = 300.0
"""How long a robot that went offline is still shown."""
MOST_ROBOTS = 10_000
MOST_CONTAINERS = 4096
"""Bounds on what is believed: robots in a fleet, containers of one gateway."""
_FACTS_S = 2.0
_FACTS_TRIES = 3
_TICK_S = 5.0


class FactsAsk(Struct, frozen=True):
    """`facts`: what do you know?"""


class Facts(Struct, frozen=True, omit_defaults=True):
    """A gateway's own facts, and the robots it knows of."""

    gateway: str
    status: GatewayStatus | None = None
    containers: tuple[ContainerInfo, ...] = ()
    robots: tuple[RobotInfo, ...] = ()


class Registry:
    """What is known of the fleet just now. `on_change` gets `gateway`, `container` or `robot`."""

    def __init__(
        self, config: PlaneConfig, *, session: Session, rpc: Rpc, membership: Membership, gateway: str | None
    ) -> None:
        self.gateways: dict[str, GatewayStatus] = {}
        self.containers: dict[str, dict[str, ContainerInfo]] = {}
        self.robots: dict[str, RobotInfo] = {}
        self.on_change: list[Callable[[str], None]] = []
        self._coalesce_s = config.coalesce_ms / 1e3
        self._session = session
        self._rpc = rpc
        self._membership = membership
        self._gateway = gateway
        self._closers: list[Closer] = []
        self._heard: dict[str, int] = {}
        self._heard_at: dict[str, float] = {}
        """Gateway -> when anything was last heard of it, on this machine's monotonic clock."""
        self._asking: dict[str, asyncio.Task[None]] = {}
        self._status: GatewayStatus | None = None
        self._wanted: tuple[ContainerInfo, ...] | None = None
        self._published: dict[str, ContainerInfo] = {}
        self._timer: asyncio.TimerHandle | None = None
        self._gone: dict[str, float] = {}
        self._sweeping: asyncio.Task[None] | None = None
        if gateway is not None:
            rpc.register("facts", FactsAsk, self._on_facts, exchange=False)
        membership.on_joined.append(self._ask)
        membership.on_lost.append(self._forget)

    def start(self) -> None:
        """Begin to listen."""
        session, keys = self._session, self._session.keys
        self._closers = [
            session.subscribe_typed(keys.status(), GatewayStatus, self._on_status),
            session.subscribe_typed(keys.container(), ContainerInfo, self._on_container),
            session.subscribe_typed(keys.robot(), RobotInfo, self._on_robot),
            session.watch_alive(keys.robot_alive(), self._on_robot_alive),
        ]
        self._sweeping = asyncio.create_task(self._keep_sweeping(), name="registry")

    # --- our own facts ----------------------------------------------------------------------------------------

    def publish_status(self, status: GatewayStatus) -> None:
        """Tell the fleet about this gateway, together with what else changes within `coalesce_ms`."""
        self._status = status
        self.gateways[status.id] = status
        self._soon()
        self._tell("gateway")

    def publish_containers(self, containers: tuple[ContainerInfo, ...]) -> None:
        """Tell the fleet which containers this gateway holds: all of them; those left out are gone."""
        self._wanted = containers
        if self._gateway is not None:
            self.containers[self._gateway] = {each.id: each for each in containers}
        self._soon()
        self._tell("container")

    def _soon(self) -> None:
        if self._timer is None:
            self._timer = asyncio.get_running_loop().call_later(self._coalesce_s, self._publish)

    def _publish(self) -> None:
        self._timer = None
        keys, gateway = self._session.keys, self._gateway
        if gateway is None:
            return
        if self._wanted is not None:
            wanted = {each.id: each for each in self._wanted}
            for gone in self._published.keys() - wanted.keys():
                self._session.delete(keys.container(gateway, gone))
            for each in wanted.values():
                if self._published.get(each.id) != each:
                    self._session.put(keys.container(gateway, each.id), encode(each))
            self._published, self._wanted = wanted, None
        if self._status is not None:
            self._session.put(keys.status(gateway), encode(self._status))

    async def _on_facts(self, _: FactsAsk) -> Facts:
        gateway = self._gateway or ""
        return Facts(
            gateway=gateway,
            status=self.gateways.get(gateway),
            containers=tuple(self.containers.get(gateway, {}).values()),
            robots=tuple(self.robots.values()),
        )

    def age_s(self, gateway: str) -> float:
        """Seconds since anything was heard of a gateway: 0 for this one, infinite for one that never told anything."""
        if gateway == self._gateway:
            return 0.0
        at = self._heard_at.get(gateway)
        return math.inf if at is None else time.monotonic() - at

    # --- others' facts ----------------------------------------------------------------------------------------

    async def wait_for_facts(self) -> None:
        """Wait until every member that is known has told its facts, or could not within a few seconds."""
        if self._asking:
            await asyncio.wait(self._asking.values())

    def _on_status(self, key: str, status: GatewayStatus | None) -> None:
        gateway = key.split("/")[-2]
        if gateway == self._gateway or status is None or not self._is_member(gateway):
            return
        if status.id != gateway:
            self._session.refuse("misplaced gw/*/status", key=key, says=status.id)
            return
        self._count(gateway)
        self.gateways[gateway] = status
        self._tell("gateway")

    def _on_container(self, key: str, info: ContainerInfo | None) -> None:
        gateway, container = key.split("/")[-3], key.rsplit("/", maxsplit=1)[-1]
        if gateway == self._gateway or not self._is_member(gateway):
            return
        held = self.containers.setdefault(gateway, {})
        if info is None or info.state is ContainerState.DEAD:
            held.pop(container, None)
        elif info.id != container or info.gateway != gateway:
            self._session.refuse("misplaced gw/*/pool/*", key=key, says=f"{info.gateway}/{info.id}")
            return
        elif len(held) >= MOST_CONTAINERS and container not in held:
            self._session.refuse("too many gw/*/pool/*", key=key)
            return
        else:
            held[container] = info
        self._count(gateway)
        self._tell("container")

    def _is_member(self, gateway: str) -> bool:
        """Facts of those whose token is not seen are left: they are asked for when it comes."""
        return gateway in self._membership.members

    def _count(self, gateway: str) -> None:
        self._heard[gateway] = self._heard.get(gateway, 0) + 1
        self._heard_at[gateway] = time.monotonic()

    def _ask(self, gateway: str) -> None:
        """A member has come: ask for the facts it put before we listened."""
        if gateway == self._gateway:
            return
        task = asyncio.create_task(self._ask_facts(gateway), name=f"facts of {gateway}")
        self._asking[gateway] = task
        task.add_done_callback(lambda done: self._asked(gateway, done))

    def _asked(self, gateway: str, done: asyncio.Task[None]) -> None:
        if self._asking.get(gateway) is done:
            del self._asking[gateway]

    async def _ask_facts(self, gateway: str) -> None:
        for attempt in range(_FACTS_TRIES):
            heard = self._heard.get(gateway, 0)
            try:
                facts = await self._rpc.call(gateway, "facts", FactsAsk(), Facts, timeout_s=_FACTS_S)
            except SwiftbotError as error:
                log.info("facts could not be had", member=gateway, reason=str(error))
                await asyncio.sleep(0.1)
                continue
            if not self._is_member(gateway):
                return
            self._take_robots(facts)
            # What was put while the answer was on its way is newer than the answer: ask again.
            if self._heard.get(gateway, 0) == heard or attempt == _FACTS_TRIES - 1:
                self._take(gateway, facts)
                return

    def _take(self, gateway: str, facts: Facts) -> None:
        self._heard_at[gateway] = time.monotonic()
        if facts.status is not None and facts.status.id == gateway:
            self.gateways[gateway] = facts.status
            self._tell("gateway")
        self.containers[gateway] = {
            each.id: each
            for each in facts.containers[:MOST_CONTAINERS]
            if each.gateway == gateway and each.state is not ContainerState.DEAD
        }
        self._tell("container")

    def _take_robots(self, facts: Facts) -> None:
        for robot in facts.robots:
            if robot.id not in self.robots and len(self.robots) < MOST_ROBOTS:
                self.robots[robot.id] = robot
                if not robot.online:
                    self._gone[robot.id] = time.monotonic()
                self._tell("robot")

    def _forget(self, gateway: str) -> None:
        """A gateway is lost: what it said goes with it, what it said of itself no longer holds."""
        if task := self._asking.pop(gateway, None):
            task.cancel()
        self._heard.pop(gateway, None)
        self._heard_at.pop(gateway, None)
        if self.gateways.pop(gateway, None) is not None:
            self._tell("gateway")
        if self.containers.pop(gateway, None) is not None:
            self._tell("container")

    # --- robots -----------------------------------------------------------------------------------------------

    def _on_robot(self, key: str, info: RobotInfo | None) -> None:
        robot = key.split("/")[-2]
        if info is None:
            self._lose(robot)
            return
        if info.id != robot:
            self._session.refuse("misplaced robot/*/state", key=key, says=info.id)
            return
        if robot not in self.robots and len(self.robots) >= MOST_ROBOTS:
            self._session.refuse("too many robot/*/state", key=key)
            return
        before = self.robots.get(robot)
        self.robots[robot] = info
        if info.online:
            self._gone.pop(robot, None)
        else:
            self._gone.setdefault(robot, time.monotonic())
        if before != info:
            self._tell("robot")

    def _on_robot_alive(self, key: str, alive: bool) -> None:
        if not alive:
            self._lose(key.split("/")[-2])

    def _lose(self, robot: str) -> None:
        info = self.robots.get(robot)
        if info is not None and info.online:
            self.robots[robot] = replace(info, online=False)
            self._gone[robot] = time.monotonic()
            self._tell("robot")

    async def _keep_sweeping(self) -> None:
        while True:
            await asyncio.sleep(_TICK_S)
            before = time.monotonic() - ROBOT_KEPT_S
            for robot in [each for each, since in self._gone.items() if since < before]:
                del self._gone[robot]
                self.robots.pop(robot, None)
                self._tell("robot")

    def _tell(self, kind: str) -> None:
        for callback in tuple(self.on_change):
            try:
                callback(kind)
            except Exception:  # supervision boundary: a listener's defect must not stop the facts
                log.exception("a listener to the facts failed", kind=kind)

    async def close(self) -> None:
        """Publish what waits, listen no more."""
        if self._timer is not None:
            self._timer.cancel()
            self._publish()
        for closer in self._closers:
            closer.close()
        tasks = [each for each in (self._sweeping, *self._asking.values()) if each is not None]
        for task in tasks:
            task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await asyncio.gather(*tasks, return_exceptions=True)
