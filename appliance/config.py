"""One TOML file a gateway: read strictly, so that a typing error is an error and not a silent default.

Each room defines its own section; this module only composes them. `docs/configuration.md` lists every key with
its default and the reason for it, made from these structs.
"""

import tomllib
from pathlib import Path
from typing import Any, cast

import msgspec
import tomli_w
from msgspec import Struct, field

from appliance.alerts.settings import AlertsConfig
from appliance.errors import ConfigError, PayloadError
from appliance.floor.settings import FloorConfig
from appliance.llm.settings import LlmConfig, SafetyConfig
from appliance.model.keys import check_name
from appliance.observe.settings import ObserveConfig
from appliance.plane.settings import PlaneConfig, dialled_here
from appliance.pool.settings import PoolConfig
from appliance.record.settings import RecordConfig
from appliance.robots.settings import RobotsConfig
from appliance.tasks.settings import TasksConfig


class GatewayConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Everything that can be set of a gateway; sections are the rooms."""

    id: str
    """Name of this gateway, unique in the fleet and kept for good: its place on the ring follows from it."""
    fleet: str = "default"
    """Gateways, robots and clients of one fleet see each other; others on the same network do not."""
    data_dir: str = "/var/lib/swiftbot/data"
    """SQLite file, artifacts, snapshots of skills."""
    run_dir: str = ""
    """Sockets into containers; empty: under XDG_RUNTIME_DIR. Short, since socket paths end at 108 bytes."""
    site: str = "warehouse"
    """Name of a built-in site, or path of a site file: what place names mean, and where robots must not go."""
    skills: tuple[str, ...] = ()
    """Folders with further skills, beside the built-in ones."""
    log_level: str = "info"
    log_format: str = "json"
    """`json` for journald and machines, `text` for a terminal."""
    drain_s: float = 20.0
    """On SIGTERM: how long runs in progress may take to end before they are cancelled."""
    keep_containers: bool = True
    """On SIGTERM: leave warm containers running for the next start to adopt."""
    status_s: float = 2.0
    """How often a gateway takes account of itself when nothing changes; a large fleet hears it less often."""
    plane: PlaneConfig = field(default_factory=PlaneConfig)
    pool: PoolConfig = field(default_factory=PoolConfig)
    llm: LlmConfig = field(default_factory=LlmConfig)
    safety: SafetyConfig = field(default_factory=SafetyConfig)
    robots: RobotsConfig = field(default_factory=RobotsConfig)
    floor: FloorConfig = field(default_factory=FloorConfig)
    record: RecordConfig = field(default_factory=RecordConfig)
    tasks: TasksConfig = field(default_factory=TasksConfig)
    observe: ObserveConfig = field(default_factory=ObserveConfig)
    alerts: AlertsConfig = field(default_factory=AlertsConfig)

    def endpoints(self) -> tuple[str, ...]:
        """Where this gateway and the others are reached, by its configuration, each once."""
        others = (endpoint for name, endpoint in self.plane.peers.items() if name != self.id)
        return tuple(dict.fromkeys((*self.plane.listen, *self.plane.connect, *others)))

    def dialling(self, keys: str = "") -> PlaneConfig:
        """How a program beside this gateway, such as its recorder, links to it and to the others.

        `keys`: the program's own; empty: the gateway's.
        """
        chosen = keys or self.plane.keys
        # A certificate names addresses, and "any" is none.
        endpoints = (dialled_here(each) for each in self.endpoints()) if chosen else self.endpoints()
        return PlaneConfig(mode="peer", connect=tuple(endpoints), keys=chosen, roster=self.plane.roster)


def load(path: Path) -> GatewayConfig:
    """Read a configuration file.

    Raises:
        ConfigError: it is absent, not TOML, or a key is unknown, of the wrong type or not allowed; the message
            names file and key.
    """
    try:
        text = path.read_text()
    except OSError as error:
        raise ConfigError(
            f"configuration {path} cannot be read: {error.strerror}", remedy="give a file with --config"
        ) from error
    try:
        config = msgspec.convert(tomllib.loads(text), GatewayConfig)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path} is not TOML: {error}", remedy="see docs/configuration.md") from error
    except msgspec.ValidationError as error:
        raise ConfigError(f"{path}: {error}", remedy="see docs/configuration.md for the keys") from error
    check(config, str(path))
    return config


def check(config: GatewayConfig, source: str) -> None:
    """Check what types cannot tell; ConfigError names the key."""
    try:
        check_name(config.id, "id")
        check_name(config.fleet, "fleet")
        config.plane.check()
        config.plane.check_own(config.id)
        config.plane.check_links()
        config.robots.check()
        if config.plane.keys:
            for link in config.robots.mavlink:
                link.check_keyed()
        config.floor.check()
        config.tasks.battery.check(reserved=bool(config.plane.voters) and config.floor.enabled)
        config.record.check()
        config.llm.check()
        config.safety.check()
        config.observe.check()
        config.alerts.check()
    except (PayloadError, ConfigError) as error:
        raise ConfigError(f"{source}: {error.message}", remedy=error.remedy) from error
    if config.log_level not in ("debug", "info", "warning", "error"):
        raise ConfigError(f"{source}: log_level {config.log_level!r}", remedy="use debug, info, warning or error")
    if config.log_format not in ("json", "text"):
        raise ConfigError(f"{source}: log_format {config.log_format!r}", remedy="use json or text")


def dump(config: GatewayConfig) -> str:
    """Write a configuration as TOML with all that differs from the defaults."""
    defaults = cast("dict[str, Any]", msgspec.to_builtins(GatewayConfig(id=config.id)))
    written: dict[str, Any] = {"id": config.id}
    for key, value in cast("dict[str, Any]", msgspec.to_builtins(config)).items():
        if isinstance(value, dict):
            section = cast("dict[str, Any]", value)
            written[key] = {name: each for name, each in section.items() if each != defaults[key].get(name)}
        elif value != defaults[key]:
            written[key] = value
    return tomli_w.dumps({key: value for key, value in written.items() if value != {}})
