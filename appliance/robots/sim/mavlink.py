"""A simulated MAVLink copter as a process of its own: it sends to a gateway, as SITL's `--out` does, or waits for one.

Its link can be made lossy, which is what radio links are: the same share of frames is dropped each way.
"""

import asyncio
import math
import random
import time

import structlog
from msgspec import Struct, field

from appliance.errors import ConfigError
from appliance.model import Site
from appliance.robots.mavlink import dialect
from appliance.robots.mavlink.dialect import Codec, Frame, Message
from appliance.robots.mavlink.links import Link, open_link
from appliance.robots.mavlink.signing import Signer, read_key
from appliance.robots.settings import MAX_SYSTEM, Remote, read_remote
from appliance.robots.sim.copter import STREAMS_HZ, SimCopter
from appliance.robots.sim.telemetry import telemetry

log = structlog.get_logger(__name__)

TICK_S = 0.1
"""10 Hz."""
_LATE_S = 1.0
"""A process that was stopped for longer does not fly on for the time it missed."""


class VehicleSettings(Struct, frozen=True, kw_only=True):
    """One simulated copter."""

    to: str = "udp://127.0.0.1:14550"
    """Where the gateway listens, udp:// or tcp://."""
    listen: bool = False
    """Listen there with TCP instead, as SITL does, and let the gateway connect."""
    signing: str = ""
    """File with the link's signing key, as in a gateway's robots.mavlink."""
    system: int = 1
    site: Site = field(default_factory=Site)
    start: str = "home"
    """Place it starts at, and its home; the site's origin where there is no such place."""
    rate: float = 1.0
    """How many times faster than real it moves."""
    battery_percent: float = 100.0
    drop: float = 0.0
    """Share of frames lost, each way."""
    seed: int = 1

    @property
    def remote(self) -> Remote:
        """Where it speaks; ConfigError when that is not understood."""
        return read_remote(self.to, listens=self.listen)

    def check(self) -> None:
        """Raise ConfigError for what cannot be simulated."""
        if self.remote.listens and self.remote.scheme == "udp":
            raise ConfigError(f"a simulated vehicle cannot listen on {self.to}", remedy="use tcp://host:port")
        if not 1 <= self.system <= MAX_SYSTEM:
            raise ConfigError(f"MAVLink system id {self.system}", remedy="use 1 to 255")
        if not (math.isfinite(self.rate) and 0.0 < self.rate <= 100.0):
            raise ConfigError(f"rate {self.rate:g}", remedy="use more than 0, at most 100")
        if not 0.0 <= self.drop < 1.0:
            raise ConfigError(f"drop {self.drop:g}", remedy="use a share from 0 to below 1")


def start_point(site: Site, start: str) -> tuple[float, float]:
    """Return where a robot starts; ConfigError for a place the site does not have."""
    place = site.find(start)
    if place is None:
        if not site.places:
            return 0.0, 0.0
        known = ", ".join(sorted(site.places))
        raise ConfigError(f"start {start!r} is no place of site {site.name}", remedy=f"known places: {known}")
    return place.x, place.y


async def run_vehicle(settings: VehicleSettings, *, stop: asyncio.Event | None = None) -> None:
    """Simulate until `stop` is set or the task is cancelled."""
    settings.check()
    copter = SimCopter(
        system=settings.system,
        site=settings.site,
        home=start_point(settings.site, settings.start),
        battery_percent=settings.battery_percent,
    )
    await Simulation(settings, copter).run(asyncio.Event() if stop is None else stop)


class Simulation:
    """Drives one copter by the clock and carries its messages."""

    def __init__(self, settings: VehicleSettings, copter: SimCopter) -> None:
        self.copter = copter
        self._settings = settings
        self._chance = random.Random(settings.seed)  # noqa: S311 - a lossy link, no secret
        self._intervals = {name: 1.0 / hz for name, hz in STREAMS_HZ.items()}
        self._due = dict.fromkeys(STREAMS_HZ, 0.0)
        self._link: Link | None = None

    async def run(self, stop: asyncio.Event) -> None:
        """Run until `stop` is set."""
        signer = Signer(read_key(self._settings.signing), link_id=0) if self._settings.signing else None
        codec = Codec(self._settings.system, dialect.COMPONENT_AUTOPILOT, signer=signer)
        self._link = await open_link(self._settings.remote, codec, self._heard)
        log.info("simulated copter", system=self._settings.system, to=self._settings.to)
        began = before = time.monotonic()
        try:
            while not stop.is_set():
                now = time.monotonic()
                dt = min(now - before, _LATE_S) * self._settings.rate
                before = now
                self._send(self.copter.step(dt, now))
                for name, interval in self._intervals.items():
                    if interval > 0 and now >= self._due[name]:
                        # Late ticks do not add up to bursts.
                        self._due[name] = max(self._due[name] + interval, now)
                        self._send([telemetry(self.copter, name, round((now - began) * 1000))])
                try:
                    async with asyncio.timeout(TICK_S):
                        await stop.wait()
                except TimeoutError:
                    continue
        finally:
            await self._link.close()

    def _heard(self, frame: Frame, address: tuple[str, int]) -> None:
        del address
        if self._lost():
            return
        if frame.name == "COMMAND_LONG" and frame.message.command == dialect.SET_INTERVAL:
            self._set_interval(frame.message)
        self._send(self.copter.handle(frame, time.monotonic()))

    def _set_interval(self, message: Message) -> None:
        """Take a wish for a stream: microseconds, 0 for the usual, -1 for none."""
        names = {dialect.constant(f"MAVLINK_MSG_ID_{name}"): name for name in STREAMS_HZ}
        name = names.get(int(message.param1))
        if name is not None:
            wish = float(message.param2)
            self._intervals[name] = 1.0 / STREAMS_HZ[name] if wish == 0 else max(wish / 1e6, 0.02) if wish > 0 else 0.0

    def _send(self, messages: list[Message]) -> None:
        for message in messages:
            if self._link is None:
                return
            raw = self._link.codec.pack(message)
            for other in self._link.others:
                if not self._lost():  # a lost one was sent all the same, as the next sequence number tells
                    self._link.transmit(raw, other)

    def _lost(self) -> bool:
        return self._settings.drop > 0 and self._chance.random() < self._settings.drop
