"""What all links have in common."""

import abc
from collections.abc import Callable

from appliance.errors import ConfigError
from appliance.robots.mavlink.dialect import Codec, Damage, Frame, Message
from appliance.robots.settings import Remote

Address = tuple[str, int]
"""Host and port of the other end."""


class Link(abc.ABC):
    """One link. `on_frame(frame, address)` runs on the event loop for each good frame."""

    def __init__(
        self,
        remote: Remote,
        codec: Codec,
        on_frame: Callable[[Frame, Address], None],
        refused: dict[str, int] | None = None,
    ) -> None:
        self.remote = remote
        self.codec = codec
        self.received = 0
        self.refused: dict[str, int] = {} if refused is None else refused
        self._on_frame = on_frame

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
    def transmit(self, raw: bytes, to: Address) -> None:
        """Send a frame as it is; links lose frames, so nothing is raised for one that cannot be sent."""

    @abc.abstractmethod
    async def close(self) -> None:
        """Close everything; a port is free when it returns."""

    def send(self, message: Message, to: Address, *, system: int | None = None) -> bytes:
        """Send one message and return its frame; `system` as in `Codec.pack`."""
        raw = self.codec.pack(message, system=system)
        self.transmit(raw, to)
        return raw

    def count(self, kind: str) -> None:
        """Count one piece of bad input."""
        self.refused[kind] = self.refused.get(kind, 0) + 1

    def take(self, found: Frame | Damage, address: Address) -> None:
        """Pass on a frame, or count what is none."""
        if isinstance(found, Damage):
            self.count(found.kind)
        else:
            self.received += 1
            self._on_frame(found, address)

    def feed(self, data: bytes, address: Address) -> None:
        """Take in bytes as if they had come in a datagram."""
        for each in self.codec.read(data):
            self.take(each, address)

    def taken(self, error: OSError) -> ConfigError:
        """The error for a port that cannot be listened on."""
        return ConfigError(
            f"MAVLink cannot listen on {self.remote}: {error.strerror or error}",
            remedy="another ground station or gateway has the port: stop it, or set another robots.mavlink listen",
        )
