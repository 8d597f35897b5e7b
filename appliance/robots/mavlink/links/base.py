"""What all links have in common."""

import abc
import asyncio
from collections.abc import Callable, Iterable

from appliance.errors import ConfigError
from appliance.robots.mavlink.address import Address
from appliance.robots.mavlink.dialect import Codec, Damage, Frame, Message
from appliance.robots.mavlink.stats import Limiter, LinkStats
from appliance.robots.settings import Remote

__all__ = ["Address", "Link"]

_BUSY_S = 0.005


class Link(abc.ABC):
    """One link. `on_frame(frame, address)` runs on the event loop for each good frame.

    Args:
        remote: where it is.
        codec: decoder and encoder of this link alone.
        on_frame: told each good frame, and whose it is.
        refused: counters of bad input by kind, of all links together; its own are `damaged`.
        limit_hz: most frames a second from one end; 0 for no limit.
        busy: whether no more can be taken just now, so that streams are not read; datagrams cannot wait.
    """

    def __init__(
        self,
        remote: Remote,
        codec: Codec,
        on_frame: Callable[[Frame, Address], None],
        refused: dict[str, int] | None = None,
        *,
        limit_hz: float = 0.0,
        busy: Callable[[], bool] = lambda: False,
    ) -> None:
        self.remote = remote
        self.codec = codec
        self.refused: dict[str, int] = {} if refused is None else refused
        self.damaged: dict[str, int] = {}
        self.stats = LinkStats(self.now())
        self.problem = ""
        """Why nothing is heard just now, where that is known."""
        self._on_frame = on_frame
        self._limiter = Limiter(limit_hz)
        self._busy = busy

    @staticmethod
    def now() -> float:
        """Monotonic seconds, as the event loop counts them."""
        try:
            return asyncio.get_running_loop().time()
        except RuntimeError:
            return 0.0

    @property
    def received(self) -> int:
        """Good frames so far."""
        return self.stats.frames_in

    @abc.abstractmethod
    async def open(self) -> None:
        """Listen, or begin to connect; ConfigError with the remedy when a port cannot be listened on."""

    @property
    @abc.abstractmethod
    def address(self) -> Address:
        """Host and port of this end when it listens (port 0 becomes the one given by the system), else of the other."""

    @property
    @abc.abstractmethod
    def others(self) -> tuple[Address, ...]:
        """Other ends that are known before they have been heard: they are sent heartbeats, so that they know us."""

    @abc.abstractmethod
    def _write(self, raw: bytes, to: Address) -> bool:
        """Send bytes; False when they were dropped."""

    @abc.abstractmethod
    async def close(self) -> None:
        """Close everything; a port is free when it returns."""

    def transmit(self, raw: bytes, to: Address) -> None:
        """Send a frame as it is; links lose frames, so nothing is raised for one that cannot be sent.

        One that has no form in the link's version of MAVLink is empty, and counted.
        """
        if not raw:
            self.count("no_mavlink_1")
        elif self._write(raw, to):
            self.stats.frames_out += 1
            self.stats.bytes_out += len(raw)

    def send(self, message: Message, to: Address, *, system: int | None = None) -> bytes:
        """Send one message and return its frame; `system` as in `Codec.pack`."""
        raw = self.codec.pack(message, system=system)
        self.transmit(raw, to)
        return raw

    def count(self, kind: str) -> None:
        """Count one piece of bad input."""
        self.damaged[kind] = self.damaged.get(kind, 0) + 1
        self.refused[kind] = self.refused.get(kind, 0) + 1

    def take(self, found: Iterable[Frame | Damage], address: Address) -> int:
        """Pass on frames, count what is none; return how many pieces there were of both."""
        pieces, stats = 0, self.stats
        for each in found:
            if isinstance(each, Damage):
                if not each.counted:
                    continue
                self.count(each.kind)
            else:
                stats.frames_in += 1
                stats.bytes_in += len(each.raw)
                self._on_frame(each, address)
            pieces += 1
        return pieces

    def feed(self, data: bytes, address: Address) -> None:
        """Take in a datagram; those of an end that sends more than it may are dropped and counted."""
        now = self.now()
        if self._limiter.wait_s(address, now):
            self.count("flood")
            return
        self._limiter.spent(address, self.take(self.codec.read(data), address), now)

    async def pace(self, address: Address, frames: int) -> None:
        """Wait until an end of a stream may be read again: its own system then slows it down, and nothing is lost."""
        now = self.now()
        self._limiter.spent(address, frames, now)
        wait_s = self._limiter.wait_s(address, now)
        if wait_s:
            self.count("slowed")
            await asyncio.sleep(wait_s)
        while self._busy():  # noqa: ASYNC110 - what it waits for is a thread's queue, which tells nobody
            await asyncio.sleep(_BUSY_S)

    def taken(self, error: OSError) -> ConfigError:
        """The error for a port that cannot be listened on."""
        return ConfigError(
            f"MAVLink cannot listen on {self.remote}: {error.strerror or error}",
            remedy="another ground station or gateway has the port: stop it, or set another robots.mavlink listen",
        )
