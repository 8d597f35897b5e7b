"""Simulated MAVLink vehicles, one or many in a process: they send to a gateway, as SITL's `--out` does, or wait for it.

Its link can be made bad in the ways radio links are (`air`), the same each way.
"""

import asyncio
import math
import time
from collections.abc import Sequence
from typing import Literal

import structlog
from msgspec import Struct, field

from appliance.errors import ConfigError
from appliance.model import Place, Site
from appliance.model.robot_api import MAX_SYSTEM, Remote, read_remote
from appliance.model.site import inside
from appliance.robots.mavlink import dialect
from appliance.robots.mavlink.dialect import Codec, Frame, Message
from appliance.robots.mavlink.links import Link, open_link
from appliance.robots.mavlink.signing import Signer, read_key
from appliance.skills._lib import coordinates
from workshop.robots.air import Air, Channel
from workshop.robots.autopilot import AnyAutopilot
from workshop.robots.components import Component, SimCamera, SimGimbal
from workshop.robots.copter import SimCopter
from workshop.robots.flight import Point
from workshop.robots.rover import SimRover
from workshop.robots.telemetry import STREAMS_HZ, telemetry

log = structlog.get_logger(__name__)

TICK_S = 0.1
"""10 Hz."""
_LATE_S = 1.0
"""A process that was stopped for longer does not fly on for the time it missed."""


class VehicleSettings(Struct, frozen=True, kw_only=True):
    """One simulated vehicle."""

    kind: Literal["copter", "rover"] = "copter"
    to: str = "udp://127.0.0.1:14550"
    """Where the gateway listens, udp:// or tcp://."""
    listen: bool = False
    """Listen there with TCP instead, as SITL does, and let the gateway connect."""
    signing: str = ""
    """File with the link's signing key, as in a gateway's robots.mavlink."""
    system: int = 1
    site: Site = field(default_factory=Site)
    start: str = "home"
    """Its home, a place or a point "x, y"; the site's origin where the site has no places."""
    spot: int = 0
    """Beside it: 0 is the place itself."""
    at: str = ""
    """Where it stands at first, a point "x, y"; empty: at home."""
    rate: float = 1.0
    """How many times faster than real it moves."""
    streams: float = 1.0
    """How many times as often as usual it sends each kind of telemetry, up to once a tick."""
    battery_percent: float = 100.0
    drop: float = 0.0
    """Share of frames lost, each way."""
    double: float = 0.0
    """Share of frames that arrive twice, each way."""
    mix: float = 0.0
    """Share of frames that arrive after later ones, each way."""
    delay_s: float = 0.0
    """Time that frames are on their way, each way."""
    seed: int = 1
    parameters: dict[str, float] = field(default_factory=dict[str, float])
    """Parameters that differ from the defaults when it is switched on: `SIM_WIND_SPD`, `FENCE_ENABLE`, ..."""
    camera: bool = True
    """A camera and a gimbal are on board."""

    @property
    def air(self) -> Air:
        """Its link."""
        return Air(drop=self.drop, double=self.double, mix=self.mix, delay_s=self.delay_s, seed=self.seed)

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
        if not (math.isfinite(self.streams) and 0.0 < self.streams <= 100.0):
            raise ConfigError(f"streams {self.streams:g}", remedy="use more than 0, at most 100")
        self.air.check()


_SPOT_M = 2.0
"""Between robots that start side by side."""


def start_point(site: Site, start: str, spot: int = 0) -> tuple[float, float]:
    """Return where a robot starts, a place or a point "x, y"; ConfigError for a place the site does not have.

    `spot`: 0 is the place itself, the others are round it, nearest first, side by side and clear of obstacles; where
    there are no more, it is counted on from the first.
    """
    place = site.find(start)
    if place is None:
        if (point := coordinates.read(start)) is not None:
            return point[:2]
        if site.places:
            known = ", ".join(sorted(site.places))
            raise ConfigError(f"start {start!r} is no place of site {site.name}", remedy=f"known places: {known}")
        place = Place(x=0.0, y=0.0)
    steps = range(-8, 9)
    spots = sorted(((dx, dy) for dx in steps for dy in steps), key=lambda each: (math.hypot(*each), each))
    walls = (*site.obstacles, *site.forbidden)

    def clear(x: float, y: float) -> bool:
        fenced = site.fence is None or inside(site.fence, x, y, -_SPOT_M / 2)
        return fenced and not any(inside(wall, x, y, _SPOT_M / 2) for wall in walls)

    round_it = [(place.x + _SPOT_M * dx, place.y + _SPOT_M * dy) for dx, dy in spots[1:]]
    near = [(place.x, place.y), *(point for point in round_it if clear(*point))]
    return near[spot % len(near)]


def read_parameters(given: Sequence[str]) -> dict[str, float]:
    """Return parameters by name of `NAME=VALUE` texts; ConfigError for anything else."""
    found: dict[str, float] = {}
    for each in given:
        name, equals, value = each.partition("=")
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if not equals or not name or not math.isfinite(number):
            raise ConfigError(f"{each!r} is no parameter", remedy="write NAME=VALUE, such as SIM_WIND_SPD=6")
        found[name.strip().upper()] = number
    return found


async def run_vehicle(settings: VehicleSettings, *, stop: asyncio.Event | None = None) -> None:
    """Simulate until `stop` is set or the task is cancelled."""
    settings.check()
    await Simulation(settings, make_vehicle(settings)).run(asyncio.Event() if stop is None else stop)


async def run_vehicles(settings: Sequence[VehicleSettings], *, stop: asyncio.Event) -> None:
    """Simulate several until `stop` is set; ConfigError for one that cannot be, before any begins."""
    for each in settings:
        each.check()
    simulations = [Simulation(each, make_vehicle(each)) for each in settings]
    async with asyncio.TaskGroup() as group:
        for number, simulation in enumerate(simulations):
            # Each tick of so many at the same moment would come to the gateway as one burst.
            group.create_task(simulation.run(stop, after_s=TICK_S * number / len(simulations)))


def make_vehicle(settings: VehicleSettings) -> AnyAutopilot:
    """Make the vehicle that the settings describe; ConfigError for a parameter that it does not have."""
    kind = SimCopter if settings.kind == "copter" else SimRover
    vehicle = kind(
        system=settings.system,
        site=settings.site,
        home=start_point(settings.site, settings.start, settings.spot),
        battery_percent=settings.battery_percent,
    )
    for name, value in settings.parameters.items():
        if name not in vehicle.parameters.values:
            known = ", ".join(sorted(vehicle.parameters.values))
            raise ConfigError(f"a simulated {settings.kind} has no parameter {name!r}", remedy=f"known: {known}")
        vehicle.parameters.values[name] = float(value)
    if settings.at:
        x, y = start_point(settings.site, settings.at)
        vehicle.flight.position = Point(x - vehicle.home[0], y - vehicle.home[1], 0.0)
    return vehicle


class Simulation:
    """Drives one vehicle by the clock and carries its messages, and those of what is on board."""

    def __init__(self, settings: VehicleSettings, vehicle: AnyAutopilot) -> None:
        self.vehicle = vehicle
        self.parts: list[Component] = [SimCamera(vehicle), SimGimbal(vehicle)] if settings.camera else []
        self._settings = settings
        self._down: Channel[bytes] = Channel(settings.air, direction=0)
        self._up: Channel[Frame] = Channel(settings.air, direction=1)
        self._intervals = {name: 1.0 / (hz * settings.streams) for name, hz in STREAMS_HZ.items()}
        self._due = dict.fromkeys(STREAMS_HZ, 0.0)
        self._link: Link | None = None
        self._codecs: dict[int, Codec] = {}

    async def run(self, stop: asyncio.Event, *, after_s: float = 0.0) -> None:
        """Run until `stop` is set, beginning in so long."""
        await asyncio.sleep(after_s)
        signer = Signer(read_key(self._settings.signing), link_id=0) if self._settings.signing else None
        for number in (dialect.COMPONENT_AUTOPILOT, *(part.number for part in self.parts)):
            self._codecs[number] = Codec(self._settings.system, number, signer=signer)
        codec = self._codecs[dialect.COMPONENT_AUTOPILOT]
        self._link = await open_link(self._settings.remote, codec, self)
        log.info("simulated vehicle", kind=self._settings.kind, system=self._settings.system, to=self._settings.to)
        began = before = time.monotonic()
        try:
            while not stop.is_set():
                now = time.monotonic()
                dt = min(now - before, _LATE_S) * self._settings.rate
                before = now
                self._arrived(now)
                self._tick(dt, now, round((now - began) * 1000))
                self._transmit(time.monotonic())
                try:
                    async with asyncio.timeout(TICK_S):
                        await stop.wait()
                except TimeoutError:
                    continue
        finally:
            await self._link.close()

    def _tick(self, dt: float, now: float, boot_ms: int) -> None:
        """Let time pass on board, and send what is due."""
        vehicle = self.vehicle
        self._send(vehicle.step(dt, now))
        for part in self.parts:
            self._send(part.step(dt, now), part.number)
        if vehicle.pictures and self.parts:
            # The camera is the autopilot's to release, in missions and where it is addressed itself.
            camera = self.parts[0]
            if isinstance(camera, SimCamera):
                self._send([camera.take() for _ in range(vehicle.pictures)], camera.number)
            vehicle.pictures = 0
        for name, interval in self._intervals.items():
            if interval > 0 and now >= self._due[name]:
                # Late ticks do not add up to bursts.
                self._due[name] = max(self._due[name] + interval, now)
                self._send([telemetry(vehicle, name, boot_ms)])

    @property
    def busy(self) -> bool:
        """Never: what comes is small."""
        return False

    def receive(self, link: int, frame: Frame, address: tuple[str, int]) -> None:
        """Take a frame off the link."""
        del link, address
        now = time.monotonic()
        self._up.send(frame, now)
        self._arrived(now)
        self._transmit(time.monotonic())

    def _arrived(self, now: float) -> None:
        """Act on what has come through the air."""
        for frame in self._up.due(now):
            message = frame.message
            if (
                frame.name == "COMMAND_LONG"
                and message.command == dialect.SET_INTERVAL
                and message.target_system in (0, self._settings.system)
                and message.target_component in (0, dialect.COMPONENT_AUTOPILOT)
            ):
                self._set_interval(message)
            self._send(self.vehicle.handle(frame, now))
            for part in self.parts:
                self._send(part.handle(frame), part.number)

    def _set_interval(self, message: Message) -> None:
        """Take a wish for a stream: microseconds, 0 for the usual, -1 for none."""
        names = {dialect.constant(f"MAVLINK_MSG_ID_{name}"): name for name in STREAMS_HZ}
        name = names.get(int(message.param1))
        if name is not None:
            wish = float(message.param2)
            self._intervals[name] = 1.0 / STREAMS_HZ[name] if wish == 0 else max(wish / 1e6, 0.02) if wish > 0 else 0.0

    def _send(self, messages: list[Message], component: int = dialect.COMPONENT_AUTOPILOT) -> None:
        now = time.monotonic()
        for message in messages:
            # One that is lost on the way was sent all the same, as the next sequence number tells.
            self._down.send(self._codecs[component].pack(message), now)

    def _transmit(self, now: float) -> None:
        """Hand over what has come through the air to all that are there."""
        if self._link is None:
            return
        for raw in self._down.due(now):
            for other in self._link.others:
                self._link.transmit(raw, other)
