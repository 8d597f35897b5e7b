"""What of a gateway goes to monitoring systems, and where to."""

from typing import Annotated
from urllib.parse import urlsplit

from msgspec import Meta, Struct

from appliance.errors import ConfigError

SIGNALS = ("traces", "metrics", "logs")


class ObserveConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Monitoring of this gateway. Nothing of it is on by default, and then none of its packages is loaded."""

    prometheus: Annotated[int, Meta(ge=0, le=65535)] = 0
    """Port of the Prometheus endpoint `/metrics`, such as 9464; 0: none. Always on the loopback: it has no password."""
    otlp: str = ""
    """Base URL of an OpenTelemetry collector that takes OTLP over HTTP, such as `http://127.0.0.1:4318`; empty: none.
    Headers and certificates are set by OpenTelemetry's variables, such as `OTEL_EXPORTER_OTLP_HEADERS`."""
    signals: tuple[str, ...] = SIGNALS
    """What the collector gets: `traces`, `metrics`, `logs`."""
    interval_s: Annotated[float, Meta(ge=1, le=3600)] = 15.0
    """How often the collector gets metrics."""
    texts: bool = False
    """Whether traces hold what people typed and robots answered: instructions, notes, failures. Names, states and times
    always. Log lines hold such texts anyway: leave `logs` out of `signals` where they may not leave the machine."""

    @property
    def active(self) -> bool:
        """Whether anything is on."""
        return bool(self.prometheus or self.otlp)

    def check(self) -> None:
        """Raise ConfigError for what cannot be."""
        if self.otlp:
            url = urlsplit(self.otlp)
            if url.scheme not in ("http", "https") or not url.hostname or url.query or url.fragment:
                raise ConfigError(
                    f"observe.otlp {self.otlp[:80]!r} is no address of a collector",
                    remedy="write it as http://127.0.0.1:4318, without /v1/traces",
                )
        if unknown := [each for each in self.signals if each not in SIGNALS]:
            raise ConfigError(f"observe.signals {unknown[0][:40]!r}", remedy=f"use {', '.join(SIGNALS)}")
