"""A connection to a fleet: asks any gateway, and another one when that is gone. What is asked stands in `client`.

It sits anywhere on the Zenoh network; no gateway need run in its process. The endpoints of a fleet that runs on
this machine are found by its state file.
"""

import asyncio
import copy
import difflib
import os
import time
from pathlib import Path
from types import TracebackType
from typing import Literal, Self

import msgspec
from msgspec import Struct

from appliance.errors import ConfigError, DeadlineError, NotFoundError, SwiftbotError, UnreachableError
from appliance.model.keys import Q, R, Verb
from appliance.model.roles import Role
from appliance.model.steering import MAX_BY
from appliance.plane.client import PlaneClient
from appliance.plane.settings import PlaneConfig

PATIENCE_S = 6.0
"""How long another gateway is looked for when the one that was asked is gone: detection takes a second."""


def operator_name() -> str:
    """Who gives orders from this process: `SWIFTBOT_OPERATOR`, else the user's name."""
    return (os.environ.get("SWIFTBOT_OPERATOR") or os.environ.get("USER") or f"uid {os.getuid()}")[:MAX_BY]


class Endpoint(Struct, frozen=True, kw_only=True):
    """Where a fleet is: its name, and endpoints of gateways or routers (`tcp/host:port`)."""

    fleet: str
    connect: tuple[str, ...]
    keys: str = ""
    """File with the client's keys; empty: without, to gateways on this machine."""

    def plane(self, mode: Literal["peer", "client"] = "client") -> PlaneConfig:
        """How to connect, with plain settings otherwise."""
        return PlaneConfig(mode=mode, connect=self.connect, keys=self.keys)


class FleetConnection:
    """A connection to a fleet; use it as an async context manager, or `open` and `close` it.

    Args:
        endpoint: where the fleet is.
        operator: labels orders; with keys it is the name that these have.
        plane: how to connect, when it is not as a client with plain settings.
    """

    def __init__(self, endpoint: Endpoint, *, operator: str = "", plane: PlaneConfig | None = None) -> None:
        self.endpoint = endpoint
        self._config = plane or endpoint.plane()
        self.operator = operator or operator_name()
        self.role: Role | None = None
        """What the certificate says that this one may do; None without keys, or before it is connected."""
        self._plane: PlaneClient | None = None

    async def open(self) -> Self:
        """Connect, unless that was done; UnreachableError when nothing answers."""
        if self._plane is not None:
            return self
        self._plane = await PlaneClient.open(self._config, fleet=self.endpoint.fleet)
        if (credentials := self._plane.session.credentials) is not None:
            # Gateways go by that name; it is shown and put as they will have it.
            self.operator, self.role = credentials.identity.name, credentials.identity.role
        return self

    def acting(self, operator: str) -> Self:
        """Return this connection, open as it is, under another name; with keys it is the certificate's all the same."""
        other = copy.copy(self)
        if self.role is None:
            other.operator = operator[:MAX_BY]
        return other

    async def close(self) -> None:
        """Disconnect, unless that was done."""
        if self._plane is not None:
            await self._plane.close()
            self._plane = None

    async def __aenter__(self) -> Self:
        return await self.open()

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    @property
    def plane(self) -> PlaneClient:
        """The open connection."""
        if self._plane is None:
            raise UnreachableError("the connection to the fleet is not open")
        return self._plane

    async def gateway(self) -> str:
        """Any gateway that is present; UnreachableError when there is none."""
        return await self.plane.any_gateway()

    async def _ask(
        self,
        verb: Verb[Q, R],
        request: Q,
        *,
        timeout_s: float | None = None,
        patience_s: float = PATIENCE_S,
        first: str = "",
    ) -> R:
        """Ask any gateway, and another one when it is gone or silent: every verb used here may be repeated.

        `first`: the one to ask first, if it is there.
        """
        give_up = time.monotonic() + patience_s
        silent: set[str] = set()
        while True:
            gateway = first if first not in silent and first in self.plane.members() else ""
            gateway = gateway or await self.plane.any_gateway(avoid=silent)
            try:
                return await self.plane.rpc.call(gateway, verb, request, timeout_s=timeout_s)
            except UnreachableError:
                if time.monotonic() > give_up:
                    raise
                first = ""
                await asyncio.sleep(0.1)
            except DeadlineError:
                # It may be frozen, which is only noticed when its lease ends.
                silent.add(gateway)
                if time.monotonic() > give_up or silent >= self.plane.members():
                    raise

    async def _known(self, gateway: str) -> None:
        """Raise when there is no such gateway, or none at all."""
        await self.gateway()
        if gateway and gateway not in self.plane.members():
            members = sorted(self.plane.members())
            near = difflib.get_close_matches(gateway, members, n=1)
            there = f"there are: {', '.join(members)}"
            remedy = f"did you mean {near[0]}? {there}" if near else there
            raise NotFoundError(f"no gateway {gateway[:60]!r}", remedy=remedy)

    async def _each(self, gateway: str, verb: Verb[Q, R], request: Q) -> tuple[dict[str, R], dict[str, SwiftbotError]]:
        """Ask one gateway, or all; what they answered, and why some did not."""
        names = [gateway] if gateway else sorted(self.plane.members())
        calls = (self.plane.rpc.call(name, verb, request) for name in names)
        found: dict[str, R] = {}
        failed: dict[str, SwiftbotError] = {}
        for name, answer in zip(names, await asyncio.gather(*calls, return_exceptions=True), strict=True):
            if isinstance(answer, SwiftbotError):
                failed[name] = answer
            elif isinstance(answer, BaseException):
                raise answer
            else:
                found[name] = answer
        return found, failed

    async def _all_of(self, gateway: str, verb: Verb[Q, R], request: Q) -> dict[str, R]:
        """The same, but when none did what was asked, the reason of the first is raised."""
        await self._known(gateway)
        found, failed = await self._each(gateway, verb, request)
        if not found:
            raise failed[min(failed)]
        return found


class Process(Struct, frozen=True, kw_only=True):
    """A process of the fleet; `started` (Unix seconds) tells it from another with the same pid later."""

    name: str
    pid: int
    started: float
    log: str


class FleetState(Struct, frozen=True, kw_only=True):
    """The state file `fleet.json` of a local fleet, in its directory."""

    fleet: str
    directory: str
    endpoints: tuple[str, ...]
    gateways: tuple[str, ...]
    robots: tuple[str, ...]
    record_dir: str
    processes: tuple[Process, ...]
    keys: str = ""
    """Keys that commands on this machine use; empty: the fleet has none."""

    @property
    def endpoint(self) -> Endpoint:
        """Where clients connect."""
        return Endpoint(fleet=self.fleet, connect=self.endpoints, keys=self.keys)


def default_directory(fleet: str) -> Path:
    """Where a local fleet keeps its files: under XDG_STATE_HOME."""
    state = os.environ.get("XDG_STATE_HOME") or str(Path.home() / ".local" / "state")
    return Path(state) / "swiftbot" / fleet


def read_state(directory: Path) -> FleetState:
    """Read a fleet's state file; NotFoundError when no fleet was started there."""
    path = directory / "fleet.json"
    try:
        return msgspec.json.decode(path.read_bytes(), type=FleetState)
    except FileNotFoundError:
        raise NotFoundError(
            f"no fleet runs in {directory}",
            remedy="name the endpoint of a gateway with --connect, or start a local fleet with `swiftbot up`",
        ) from None
    except OSError as error:
        raise ConfigError(
            f"{path} cannot be read: {error.strerror}", remedy="give a --dir that is a readable folder"
        ) from error
    except msgspec.DecodeError as error:
        raise ConfigError(f"{path} cannot be read: {error}", remedy="remove it and start the fleet again") from error
