"""What is delivered of alerts, to whom, when and by which gateway. Pure.

Each address has a course of its own: what it was told, and when it may be told more. What happens before that time is
gathered into the next message, and what an address did not take is tried again, so that a limit loses nothing.
"""

from collections.abc import Iterable, Mapping
from datetime import UTC, datetime

from msgspec import Struct, field

from appliance.alerts.rules import CRITICAL, DELIVERY, HAPPENED, ordered
from appliance.alerts.settings import AlertsConfig
from appliance.model import GatewayStatus
from appliance.model.alerts import Alert

MOST_LINES = 20
"""Alerts that a message describes; further ones are counted in it."""
RETRY_S = 10.0
"""Before an address that refused a message is tried again; twice as long each time, up to `MOST_RETRY_S`."""
MOST_RETRY_S = 300.0
DOWN_S = 3600.0
"""An address that has refused all for so long is not waited for: the others' word that an alert is delivered counts."""
RECENT_S = 600.0
"""For how long a gateway that could not deliver says so; then it may try again in its turn."""


class Message(Struct, frozen=True):
    """One message: alerts that are new, and those that are over."""

    fleet: str
    news: tuple[Alert, ...] = ()
    over: tuple[Alert, ...] = ()

    @property
    def critical(self) -> bool:
        """Whether one of the new ones is."""
        return any(each.level is CRITICAL for each in self.news)

    @property
    def title(self) -> str:
        """How many of what."""
        critical = sum(each.level is CRITICAL for each in self.news)
        counts = ((critical, "critical"), (len(self.news) - critical, "warning"), (len(self.over), "over"))
        return f"SwiftBot {self.fleet}: {', '.join(f'{count} {what}' for count, what in counts if count)}"

    @property
    def body(self) -> str:
        """A line for each, the most urgent first."""
        lines = [_line(each) for each in ordered(self.news)]
        lines += [f"✔ over: {each.subject} {_clean(each.name)}: {_clean(each.what)}" for each in self.over]
        if left := len(lines) - MOST_LINES:
            lines[MOST_LINES:] = [f"and {left} more: `swiftbot alerts` lists them"] if left > 0 else []
        return "\n".join(lines)


class Course(Struct):
    """What one address was told; times are monotonic seconds."""

    told: dict[str, Alert] = field(default_factory=dict[str, Alert])
    """By id, as it was told last."""
    over: dict[str, Alert] = field(default_factory=dict[str, Alert])
    """Told before, over since, and that was not told yet."""
    next_at: float = float("-inf")
    failures: int = 0
    """In a row."""
    failing_since: float = 0.0
    failed_at: float = float("-inf")
    problem: str = ""
    """Why the last message was refused."""

    def knows(self, alert: Alert) -> bool:
        """Whether the address was told of an alert as it is now; what begins again or becomes worse is told again."""
        known = self.told.get(alert.id)
        if known is None:
            return alert.told_ns > 0
        worse = alert.level is CRITICAL and known.level is not CRITICAL
        return alert.told_ns > known.told_ns or (alert.since_ns <= known.since_ns and not worse)

    def see(self, alerts: Iterable[Alert]) -> None:
        """Note how alerts are now that it knows of."""
        for alert in alerts:
            self.over.pop(alert.id, None)
            if self.knows(alert):
                self.told[alert.id] = alert

    def end(self, alert: Alert) -> None:
        """Note that an alert is over: told where it was told of, and nobody had acknowledged it."""
        known = self.told.pop(alert.id, None)
        if known is not None and alert.acked is None and known.acked is None and known.kind not in HAPPENED:
            self.over[alert.id] = known

    def message(self, alerts: Iterable[Alert], config: AlertsConfig, *, fleet: str, now: float) -> Message | None:
        """Return what is to be delivered now; None: nothing, or it is too soon."""
        if now < self.next_at:
            return None
        news = tuple(
            each
            for each in alerts
            if each.acked is None
            and (each.level is CRITICAL or config.level is not CRITICAL)
            and not (self.failures and each.kind == DELIVERY)  # it would tell of itself once it is over
            and not self.knows(each)
        )
        over = tuple(self.over.values()) if config.over else ()
        return Message(fleet, news, over) if news or over else None

    def took(self, message: Message, config: AlertsConfig, *, now: float) -> None:
        """Note that the address took a message."""
        self.told |= {each.id: each for each in message.news}
        for each in message.over:
            self.over.pop(each.id, None)
        self.failures, self.problem, self.failed_at = 0, "", float("-inf")
        self.next_at = now + config.every_s

    def refused(self, reason: str, *, now: float) -> None:
        """Note that it did not."""
        if not self.failures:
            self.failing_since = now
        self.next_at = now + min(RETRY_S * 2**self.failures, MOST_RETRY_S)
        self.failures = min(self.failures + 1, 30)
        self.problem, self.failed_at = reason, now

    def down(self, now: float) -> bool:
        """Whether it has refused all for a long time."""
        return self.failures > 0 and now - self.failing_since > DOWN_S


def delivered(alerts: Iterable[Alert], courses: Iterable[Course], *, now: float) -> list[Alert]:
    """Return the alerts that all addresses were told of, which their records do not say yet."""
    waited_for = [each for each in courses if not each.down(now)]
    return [
        alert
        for alert in alerts
        if not alert.told_ns and waited_for and all(alert.id in each.told and each.knows(alert) for each in waited_for)
    ]


def sender(gateways: Mapping[str, GatewayStatus]) -> str:
    """Return which gateway delivers: the first that can of those that are set to; empty: none is."""
    ready = [
        (bool(status.delivery.problem), status.draining, name)
        for name, status in gateways.items()
        if status.delivery is not None
    ]
    return min(ready)[2] if ready else ""


def _line(alert: Alert) -> str:
    since = datetime.fromtimestamp(alert.since_ns / 1e9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    sign = "✘" if alert.level is CRITICAL else "▲"
    remedy = f" → {_clean(alert.remedy)}" if alert.remedy else ""
    return f"{sign} {alert.subject} {_clean(alert.name)}: {_clean(alert.what)} (since {since}){remedy}"


def _clean(text: str) -> str:
    """Return text of others without control characters and what turns its direction."""
    return "".join(each if each.isprintable() else " " for each in text)[:500]
