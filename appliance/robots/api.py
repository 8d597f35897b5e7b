"""What a gateway answers about its MAVLink links and robots, and the orders by which they come and go at run time."""

from msgspec import Struct, field

from appliance.robots.settings import MavlinkLink


class LinksAsk(Struct, frozen=True, kw_only=True):
    """Verb `robot_links`: which MAVLink links are there, and how are they?"""


class LinkAdd(Struct, frozen=True, kw_only=True):
    """Verb `robot_link_add`: open a link and keep it over restarts; the same again changes nothing."""

    link: MavlinkLink
    by: str = ""
    """Who wants it, for the log."""


class LinkRemove(Struct, frozen=True, kw_only=True):
    """Verb `robot_link_remove`: close a link for good, also one of the configuration."""

    url: str
    """As the list shows it."""
    by: str = ""


class RobotForget(Struct, frozen=True, kw_only=True):
    """Verb `robot_forget`: remove the row of a robot that is offline; it comes back when it is heard again."""

    robot: str
    by: str = ""
    """Who wants it, for the log."""


class Forgotten(Struct, frozen=True, kw_only=True):
    """A robot whose row was removed."""

    robot: str
    gateway: str
    """Which did it."""


class SenderFacts(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One MAVLink sender as heard on one link."""

    system: int
    component: int
    received: int = 0
    lost: int = 0
    """By gaps in its sequence numbers."""
    loss: float = 0.0
    """Share of its frames that did not arrive, 0 to 1."""
    late: int = 0
    """Frames that came after later ones."""
    repeated: int = 0
    """Frames that had come before, on this link or another; dropped."""
    silent_s: float = 0.0


class LatencyFacts(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Round trips of TIMESYNC to one other end, milliseconds."""

    end: str
    last_ms: float
    least_ms: float
    mean_ms: float
    count: int


class LinkFacts(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One link and what went over it since it was opened."""

    number: int
    """The link's number, which is also that of its signatures."""
    url: str
    listens: bool = False
    signed: bool = False
    added: bool = False
    """At run time, not by the configuration."""
    ends: tuple[str, ...] = ()
    """Other ends heard lately."""
    frames_in: int = 0
    frames_out: int = 0
    bytes_in: int = 0
    bytes_out: int = 0
    in_hz: float = 0.0
    """Frames a second, over the last second or so; likewise the following."""
    out_hz: float = 0.0
    in_bytes_s: float = 0.0
    out_bytes_s: float = 0.0
    refused: dict[str, int] = field(default_factory=dict[str, int])
    """Damaged and unbelieved frames, floods, and what could not be sent, by kind."""
    damped: tuple[str, ...] = ()
    """Messages that come in a storm just now and are cut, with their senders: `PARAM_VALUE of 1/1`."""
    senders: tuple[SenderFacts, ...] = ()
    latency: tuple[LatencyFacts, ...] = ()
    problem: str = ""
    """Why it is not connected, where it is not."""


class LinkList(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """All MAVLink links of a gateway; put every second on `gw/{gateway}/mavlink/links` where it has any."""

    gateway: str
    links: tuple[LinkFacts, ...] = ()
    routes: dict[str, str] = field(default_factory=dict[str, str])
    """Where each `system/component` was heard last: the link's URL and the end."""
