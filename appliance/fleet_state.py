"""The state file of a fleet that runs on this machine: commands find its endpoints by it."""

import os
from pathlib import Path

import msgspec
from msgspec import Struct

from appliance.connection import Endpoint
from appliance.errors import ConfigError, NotFoundError


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

    @property
    def endpoint(self) -> Endpoint:
        """Where clients connect."""
        return Endpoint(fleet=self.fleet, connect=self.endpoints)


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
        raise ConfigError(f"{path} cannot be read: {error}", remedy="remove it and start the fleet anew") from error
