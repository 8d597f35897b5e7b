"""What operators have to know of and have to do something about, and the requests about it."""

from typing import Annotated

from msgspec import Meta, Struct

from appliance.model.messages import OpenEnum
from appliance.model.steering import Signed, Word


class AlertLevel(OpenEnum):
    """How urgent it is, the most urgent first."""

    CRITICAL = "critical"
    """Something does not work: a robot or gateway is gone, a task failed."""
    WARNING = "warning"
    """It works less than it could, or waits for a person."""


class Subject(OpenEnum):
    """What an alert is about."""

    GATEWAY = "gateway"
    ROBOT = "robot"
    TASK = "task"
    RECORDER = "recorder"
    QUESTION = "question"
    SCHEDULE = "schedule"


class Alert(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """An alert as the fleet keeps it: a record of the DHT, and a put at each change."""

    id: str
    """Its kind and what it is about, such as `robot-offline.rover_1`: while it lasts there is one of them."""
    kind: str
    level: AlertLevel
    what: str
    """What is the case."""
    subject: Subject
    name: str
    """Of the gateway, robot, task, recorder, question or schedule."""
    remedy: str = ""
    """What to do about it."""
    since_ns: int = 0
    """When it began, Unix nanoseconds, by the clock of the gateway that noticed it."""
    until_ns: int = 0
    """When it is too late to do something, such as to approve a plan; 0: no such time."""
    changed_ns: int = 0
    acked: Word | None = None
    """Who has acknowledged it, and why; None: nobody yet."""
    told_ns: int = 0
    """When all addresses outside of the fleet were told of it (`alerts.urls_file`); 0: not yet, or there are none."""
    cleared_ns: int = 0
    """When it was over; only in the last put of it."""
    gateway: str = ""
    """The gateway that wrote it last."""


class AlertsAsk(Struct, frozen=True, kw_only=True, omit_defaults=True, forbid_unknown_fields=True):
    """`alerts`."""

    local: bool = False
    """Only those whose records are the asked gateway's."""


class AlertList(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The alerts, the most urgent first; `unreachable`: gateways that did not answer, whose alerts may be missing."""

    alerts: tuple[Alert, ...] = ()
    unreachable: tuple[str, ...] = ()


MOST_ACKED = 1000


class AlertAck(Signed, frozen=True, kw_only=True):
    """`alert_ack`: `ids` of those that are acknowledged."""

    ids: Annotated[tuple[str, ...], Meta(min_length=1, max_length=MOST_ACKED)]


class AlertsAcked(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What was acknowledged, and `unknown`: ids of alerts that are over, or never were."""

    alerts: tuple[Alert, ...] = ()
    unknown: tuple[str, ...] = ()
