"""Fleet events: what this process sees happen in its fleet, as one stream with its consumers in one order (`Stage`).

The plane publishes, and `robots.authority`. Each part that reacts subscribes one function, which switches over the
event's type. Every consumer sees every event, one after the other: an event that a consumer publishes is delivered once
all have seen the present one. Everything runs on the event loop; a consumer returns at once, and starts a task for what
takes time.
"""

from collections import deque
from collections.abc import Callable
from enum import IntEnum
from typing import Literal, NamedTuple

import structlog

log = structlog.get_logger(__name__)


class Joined(NamedTuple):
    """The first token of a gateway is seen: it counts as a member, and has its place on the ring."""

    gateway: str


class Lost(NamedTuple):
    """The last token of a gateway has gone: it is no member, and its keys have other owners."""

    gateway: str


class Stall(NamedTuple):
    """A period in which this process did not run: since what moment of `membership.clock`, and for how many seconds."""

    since: float
    lasted_s: float


class Stalled(NamedTuple):
    """This process stood still, and runs again; published once for each stall."""

    stall: Stall


class Relinked(NamedTuple):
    """What a member has put for a moment did not arrive: this gateway's session was reopened; no member was lost."""

    gateway: str


class RingChanged(NamedTuple):
    """The shard is compared with the members of a new ring, or records that belong to it came late.

    Gateways only: a client holds no shard.
    """


class FactsChanged(NamedTuple):
    """What the registry holds of some gateway, container or robot is new."""

    kind: Literal["gateway", "container", "robot"]


class AuthorityChanged(NamedTuple):
    """A robot is stopped, freed, taken over or given back: who may command it is new. By `robots.authority`."""


FleetEvent = Joined | Lost | Stalled | Relinked | RingChanged | FactsChanged | AuthorityChanged
Consumer = Callable[[FleetEvent], None]


class Stage(IntEnum):
    """The order of the consumers. Within a stage the one that subscribed first comes first."""

    LINKS = 1
    """`membership.Outlived`: after a stall, looks for links that are to be made again."""
    FACTS = 2
    """`registry.Registry`: asks a newcomer for its facts, forgets those of one that is lost."""
    RECORDS = 3
    """`anti_entropy`: compares and hands over records; publishes `RingChanged` once the shard is compared."""
    ROBOTS = 4
    """`robots.authority`: exchanges soft stops and leases with a newcomer."""
    VOLUMES = 5
    """`pool.volumes`: which state volumes other gateways hold."""
    OFFLOAD = 6
    """`tasks.offload`, `tasks.migration`: what is known of other gateways' offers; runs that wait look again."""
    TASKS = 7
    """`tasks.manager`: takes over and gives up tasks; fails attempts on a lost gateway; wakes coordinators."""
    WATCHERS = 8
    """What shows or measures: this gateway's status, the terminal UI, clients that wait for a gateway, benchmarks."""


class FleetEvents:
    """The stream of one process."""

    def __init__(self) -> None:
        self._consumers: tuple[tuple[Stage, Consumer], ...] = ()
        self._waiting: deque[FleetEvent] = deque()
        self._publishing = False

    def subscribe(self, stage: Stage, consumer: Consumer) -> Callable[[], None]:
        """Have a consumer called with every event from now on; returns what ends that (more than once is harmless)."""
        entry = (stage, consumer)
        # A stable sort; tuples of it are never compared beyond the stage.
        self._consumers = tuple(sorted((*self._consumers, entry), key=lambda one: one[0]))

        def end() -> None:
            self._consumers = tuple(other for other in self._consumers if other is not entry)

        return end

    def publish(self, event: FleetEvent) -> None:
        """Deliver an event to all consumers, or leave it to the delivery under way. From the event loop only."""
        self._waiting.append(event)
        if self._publishing:
            return
        self._publishing = True
        try:
            while self._waiting:
                self._deliver(self._waiting.popleft())
        finally:
            self._publishing = False

    def _deliver(self, event: FleetEvent) -> None:
        for stage, consumer in self._consumers:
            try:
                consumer(event)
            except Exception:  # supervision boundary: the other consumers must see the event all the same
                log.exception("a consumer of fleet events failed", stage=stage.name, fleet_event=event)
