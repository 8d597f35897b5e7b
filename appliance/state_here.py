"""State volumes and images on this gateway, and their ways to and from others; neither without Podman.

Its parts are the pool's (`pool.volumes`, `pool.transfer`); here they are built, told of what others hold, and asked
what this gateway says of itself.
"""

import asyncio
import contextlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import structlog

from appliance.errors import PrerequisiteError
from appliance.model import VolumeInfo
from appliance.plane.node import Plane
from appliance.pool.settings import PoolConfig
from appliance.pool.state import ALONE, State
from appliance.pool.storage import PodmanStorage
from appliance.pool.transfer.transfers import Transfers
from appliance.pool.volumes import Volumes
from appliance.tasks.offload import Links, UnmeasuredLinks

log = structlog.get_logger(__name__)


class StateHere:
    """The ledger of state volumes, and the transfers of them and of images; `open` it, `close` it in any case."""

    def __init__(
        self, config: PoolConfig, *, plane: Plane, fleet: str, data_dir: Path, on_change: Callable[[], None]
    ) -> None:
        self.state: State = ALONE
        """What the pool may do with state; nothing without Podman."""
        self.links: Links = UnmeasuredLinks()
        """How fast others are reached."""
        self._config = config
        self._plane = plane
        self._fleet = fleet
        self._data = data_dir
        self._on_change = on_change
        self._volumes: Volumes | None = None
        self._transfers: Transfers | None = None
        self._stack = contextlib.AsyncExitStack()

    async def open(self, signed: Callable[[str, Any], Any] = lambda _, handler: handler) -> None:
        """Build and start the parts.

        Args:
            signed: puts an audit around the handler of an operator's verb.
        """
        try:
            storage = PodmanStorage(self._config.podman_url)
        except PrerequisiteError as error:
            log.warning("state volumes and images cannot be moved", reason=str(error))
            return

        async def let_go() -> None:
            await asyncio.to_thread(storage.close)

        self._stack.push_async_callback(let_go)
        plane, settings = self._plane, self._config.transfer
        self._volumes = volumes = Volumes(
            settings, fleet=self._fleet, gateway=plane.gateway, store=plane.store, records=plane.dht, storage=storage
        )
        await volumes.start()
        self._stack.push_async_callback(volumes.close)
        volumes.on_change = self._on_change
        plane.registry.on_change.append(self._hear_of_volumes)
        plane.on_member_lost.append(lambda gateway: volumes.hear(gateway, ()))
        self._transfers = transfers = Transfers(
            settings, plane=plane, volumes=volumes, storage=storage, data_dir=self._data
        )
        await transfers.start(signed)
        self._stack.push_async_callback(transfers.close)
        transfers.on_change = self._on_change
        self.state = State(
            bring=transfers.bring_newest,
            use=volumes.use,
            newest_here=volumes.newest_here,
            bring_image=transfers.bring_image,
        )
        self.links = transfers

    def _hear_of_volumes(self, what: str) -> None:
        if what == "gateway" and self._volumes is not None:
            for gateway, status in self._plane.registry.gateways.items():
                if gateway != self._plane.gateway:
                    self._volumes.hear(gateway, status.volumes)

    def volumes_mb(self, names: Iterable[str]) -> float:
        """Size of the newest states of volumes that are not here, MiB: what would have to come."""
        return self._volumes.size_bytes(names) / 2**20 if self._volumes is not None else 0.0

    def volumes(self) -> tuple[VolumeInfo, ...]:
        """The volumes whose newest state is here."""
        return self._volumes.infos() if self._volumes is not None else ()

    def images(self) -> tuple[str, ...]:
        """References of the images here that others may fetch."""
        return self._transfers.images() if self._transfers is not None else ()

    @property
    def refused(self) -> list[dict[str, int]]:
        """Counts of bad input, by kind."""
        return [each.refused for each in (self._volumes, self._transfers) if each is not None]

    async def close(self) -> None:
        """Stop the parts in reverse order."""
        await self._stack.aclose()
