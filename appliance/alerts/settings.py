"""Where alerts are delivered to outside of the fleet."""

from pathlib import Path
from typing import Annotated

from msgspec import Meta, Struct

from appliance.errors import ConfigError
from appliance.model.alerts import AlertLevel


class AlertsConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Delivery of alerts by webhook, e-mail and other services. Off by default, and then its package is not loaded."""

    urls_file: str = ""
    """File with the addresses that alerts are delivered to, one a line, as Apprise writes them (`jsons://host/path`,
    `mailtos://user:password@host`); empty: none. Readable by the service alone, since addresses hold passwords; read
    again when it changes."""
    level: AlertLevel = AlertLevel.WARNING
    """`warning`: all alerts; `critical`: only those."""
    over: bool = True
    """Whether it is also delivered that an alert is over."""
    every_s: Annotated[float, Meta(ge=1, le=86400)] = 30.0
    """An address gets one message in so long; what happens meanwhile goes into the next one together."""

    @property
    def file(self) -> Path:
        """The file of addresses."""
        return Path(self.urls_file).expanduser()

    def check(self) -> None:
        """Raise ConfigError for what cannot be."""
        if self.level not in AlertLevel:
            raise ConfigError(f"alerts.level is {str(self.level)[:40]!r}", remedy="use warning or critical")
