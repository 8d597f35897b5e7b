"""The door of transfers: bring a volume's newest state or an image here, and give ours to others.

Guarantees:
    - What was there stays whole until what arrived is verified whole; a transfer that breaks changes nothing.
    - A broken transfer goes on where it was when it is asked for again, from the same gateway or another.
    - Transfers, what they hold on the disk and what is on its way are bounded (`TransferConfig`).
"""

from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path

from msgspec import Struct

from appliance.plane.node import Plane
from appliance.pool.engine import PodmanEngine
from appliance.pool.transfer.settings import TransferConfig
from appliance.pool.volumes import Volumes


class Brought(Struct, frozen=True, kw_only=True):
    """What a transfer did. `wire_bytes` is what came over the network, 0 when nothing had to."""

    what: str
    """`volume/NAME` or `image/REFERENCE`."""
    gateway: str = ""
    """Where it came from; empty when it was here already."""
    size_bytes: int = 0
    wire_bytes: int = 0
    duration_ms: float = 0.0
    resumed_bytes: int = 0
    """What was here from an earlier try or an older state."""


class Progress(Struct, frozen=True, kw_only=True):
    """A transfer under way; put on `gw/{gateway}/transfer/{id}` about twice a second, and once at its end."""

    id: str
    what: str
    gateway: str
    """Where it arrives."""
    source: str
    state: str
    """`waiting`, `preparing`, `moving`, `applying`; at the end `done`, `failed` or `cancelled`."""
    done_bytes: int = 0
    size_bytes: int = 0
    rate_mbps: float = 0.0
    """Megabits per second."""
    problem: str = ""


class Transfers:
    """Transfers to and from one gateway.

    Args:
        config: table `[pool.transfer]`.
        plane: this gateway's membership.
        volumes: the ledger of its state volumes.
        data_dir: the gateway's data folder; `transfer` in it is ours.
        make_engine: Podman, a client of its own: an image takes seconds, and must not hold up starts.
    """

    def __init__(
        self,
        config: TransferConfig,
        *,
        plane: Plane,
        volumes: Volumes,
        data_dir: Path,
        make_engine: Callable[[], PodmanEngine],
    ) -> None:
        self._config, self._plane, self._volumes, self._data = config, plane, volumes, data_dir
        self._make_engine = make_engine
        self.refused: Counter[str] = Counter()
        """Bad input and refusals by kind, for GatewayStatus.refused."""

    async def start(self) -> None:
        """Serve what others ask for, and look at what an earlier life of this gateway left in the spool."""

    async def close(self) -> None:
        """Give up what is under way (it can be resumed) and serve no more."""

    # --- bringing here ----------------------------------------------------------------------------------------

    async def bring_volume(self, name: str, source_gateway: str = "") -> Brought:
        """Bring the newest state of a volume here; nothing when it is here already.

        `source_gateway` is asked first, then every other gateway that has that state. Waits (`use_wait_s`) until
        no run here uses the volume. Concurrent calls for one volume share one transfer.

        Raises:
            UnreachableError: no gateway that has the newest state answers; what is here is older. The transfer
                goes on where it was when it is asked for again.
            RefusedError: no room, too many transfers, too large, or a run uses the volume here or there.
            PayloadError: what arrived is not what was announced; counted, nothing changed.
            PoolError, CancelledByOperatorError: Podman will not; somebody cancelled it.
        """
        raise NotImplementedError

    async def bring_newest(self, names: Iterable[str]) -> None:
        """Bring the newest state of each volume here, as `bring_volume`: what a run asks for before it begins."""
        raise NotImplementedError

    async def bring_image(self, reference: str, source_gateway: str = "") -> Brought:
        """Bring an image here from a gateway that has it, only the layers that are not here; errors as above.

        Raises:
            NotFoundError: no gateway that answers has it.
        """
        raise NotImplementedError

    async def images(self) -> tuple[str, ...]:
        """Return the references of the images that are here and can be given, for GatewayStatus.images."""
        raise NotImplementedError

    # --- what it costs ----------------------------------------------------------------------------------------

    def bandwidth_mbps(self, gateway: str) -> float:
        """Megabits per second measured with a gateway (moving average); a careful guess before there is any."""
        raise NotImplementedError

    def cost_ms(self, size_bytes: int, gateway: str) -> float:
        """MigCost without the start: size / bandwidth + serialise + deserialise, milliseconds (algorithms, Phase 2)."""
        raise NotImplementedError

    # --- watching ---------------------------------------------------------------------------------------------

    def active(self) -> tuple[Progress, ...]:
        """Transfers to this gateway that are under way or wait."""
        raise NotImplementedError

    def cancel(self, transfer: str) -> bool:
        """End a transfer by its id; False when there is none. What arrived is kept for the next try."""
        raise NotImplementedError
