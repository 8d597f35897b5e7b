"""A client's part in a fleet: command line, terminal UI, recorder, robots. It owns nothing on the ring."""

import asyncio
import random
from collections.abc import Set

from appliance.errors import UnreachableError
from appliance.model import keyspace
from appliance.model.keys import Keys
from appliance.plane.events import FleetEvent, FleetEvents, Joined, Stage
from appliance.plane.membership import Membership
from appliance.plane.registry import Registry
from appliance.plane.ring import Ring
from appliance.plane.rpc import Rpc
from appliance.plane.session import Session
from appliance.plane.settings import PlaneConfig


class PlaneClient:
    """Everybody else's connection: command line, terminal UI, recorder, robots. Owns nothing on the ring."""

    def __init__(self, config: PlaneConfig, *, session: Session) -> None:
        self.config = config
        self.session = session
        self.keys: Keys = session.keys
        self.rpc = Rpc(session, None)
        self.events = FleetEvents()
        self._membership = Membership(session, gateway=None, virtual_nodes=config.virtual_nodes, events=self.events)
        self.registry = Registry(
            config, session=session, rpc=self.rpc, membership=self._membership, events=self.events, gateway=None
        )
        self._came = asyncio.Event()
        self.events.subscribe(Stage.WATCHERS, self._on_event)
        self._gateway = ""

    @classmethod
    async def open(cls, config: PlaneConfig, *, fleet: str) -> "PlaneClient":
        """Connect, and learn who is there and what they know.

        Raises:
            ConfigError: a setting is wrong.
            UnreachableError: no endpoint answers.
        """
        client = cls(config, session=await Session.open(config, fleet))
        try:
            client.registry.start()
            client._membership.start()
            for key in await client.session.alive_now(client.keys(keyspace.GATEWAY_ALIVE)):
                client._membership.add(key)
            await client.registry.wait_for_facts()
        except BaseException:
            await client.close()
            raise
        return client

    def _on_event(self, event: FleetEvent) -> None:
        if isinstance(event, Joined):
            self._came.set()

    @property
    def ring(self) -> Ring:
        """The ring of the gateways that are there just now, if they have as many virtual nodes as configured here."""
        return self._membership.ring

    def members(self) -> frozenset[str]:
        """Ids of the gateways that are there."""
        return self._membership.members

    async def any_gateway(self, *, timeout_s: float = 3.0, avoid: Set[str] = frozenset()) -> str:
        """Return a gateway that is there, the same one while it is; UnreachableError when there is none.

        One to `avoid` is returned only when there is no other.
        """
        until = asyncio.get_running_loop().time() + timeout_s
        while not self.members():
            self._came.clear()
            try:
                async with asyncio.timeout_at(until):
                    await self._came.wait()
            except TimeoutError:
                raise UnreachableError(
                    f"no gateway of fleet {self.keys.fleet} is there",
                    remedy=f"is the fleet name right, and is it up? asked at {', '.join(self.config.connect)}",
                ) from None
        if self._gateway not in self.members() or self._gateway in avoid:
            others = sorted(self.members() - avoid) or sorted(self.members())
            self._gateway = random.choice(others)  # noqa: S311 - spreads load, protects nothing
        return self._gateway

    async def close(self) -> None:
        """Disconnect."""
        self._membership.close()
        try:
            await self.registry.close()
        finally:  # also where the one who closes is interrupted
            await self.session.close()
