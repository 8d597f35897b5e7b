"""How the terminal UI behaves: a person's own file, and bounds that keep it small over SSH and on a gateway."""

import os
import tomllib
from pathlib import Path
from typing import Literal

import msgspec
from msgspec import Struct, field

from appliance.errors import ConfigError


class TuiConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the terminal UI: `tui.toml` in the person's own configuration directory."""

    refresh_hz: float = 3.0
    """Redraws a second at most; only lines that changed are sent to the terminal."""
    tasks: int = 2000
    """Tasks remembered, newest first."""
    entries: int = 2000
    """Lines of the log screen remembered."""
    resync_s: float = 15.0
    """How often the task list is asked for as a whole, in case a push was missed."""
    reconnect_s: float = 2.0
    """Pause between attempts to connect."""
    silence_s: float = 6.0
    """Seconds without any gateway after which the connection is opened again."""
    ping_s: float = 5.0
    """Pause between rounds in which the latency of each gateway is measured."""
    write: bool = False
    """Start unlocked: what changes the fleet needs no `:write` first."""
    theme: str = "dark"
    """dark, light, blind-dark, blind-light, contrast-dark or contrast-light."""
    glyphs: Literal["auto", "unicode", "ascii"] = "auto"
    """Signs that are drawn; `auto`: ASCII on the console of Linux (`TERM=linux`), on a `vt100` and the like, and where
    the locale is not UTF-8."""
    signals: tuple[Literal["bell", "notification"], ...] = ()
    """What the terminal does when there is a new critical alert: ring its bell, show a notification of the desktop
    (OSC 9, in terminals that have it); once for all that are new."""
    logs: tuple[str, ...] = ()
    """Further folders in which recorded logs are looked for, for the screen of replay."""
    animation: bool = False
    """Smooth scrolling and fading: pleasant on one's own machine, slow over a network."""
    keys: dict[str, str] = field(default_factory=dict[str, str])
    """Own keys by action, such as `palette = "f2"`: terminal multiplexers take many of the control keys."""

    def check(self) -> None:
        """Raise ConfigError for values that cannot work, naming the key."""
        if not 0.2 <= self.refresh_hz <= 20:
            raise ConfigError(f"tui.refresh_hz is {self.refresh_hz}", remedy="give 0.2 to 20 redraws a second")
        for key in ("tasks", "entries"):
            if getattr(self, key) < 1:
                raise ConfigError(f"tui.{key} is {getattr(self, key)}", remedy="give a number above 0")
        for key in ("resync_s", "reconnect_s", "silence_s", "ping_s"):
            if not getattr(self, key) > 0:
                raise ConfigError(f"tui.{key} is {getattr(self, key)}", remedy="give a time above 0 seconds")


def default_path() -> Path:
    """Where a person's own settings are, whether there are any or not."""
    base = os.environ.get("XDG_CONFIG_HOME") or str(Path.home() / ".config")
    return Path(base) / "swiftbot" / "tui.toml"


def load(path: Path | None = None) -> TuiConfig:
    """Read the settings of a file; without one those of the person, or the defaults.

    Raises:
        ConfigError: the file cannot be read, or a key is unknown or wrong; the message names file and key.
    """
    if path is None and not default_path().is_file():
        return TuiConfig()
    path = path or default_path()
    remedy = "see docs/tui.md for the keys"
    try:
        config = msgspec.convert(tomllib.loads(path.read_text(encoding="utf-8")), TuiConfig)
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error.strerror}", remedy="give another file") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is not TOML: {error}", remedy=remedy) from error
    except msgspec.ValidationError as error:
        raise ConfigError(f"{path}: {error}", remedy=remedy) from error
    config.check()
    return config
