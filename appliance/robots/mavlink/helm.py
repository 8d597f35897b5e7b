"""Everything that one MAVLink vehicle can be told, by what its heartbeat says it is."""

import asyncio

import msgspec
import structlog

from appliance.model import Site
from appliance.robots.commands import Done, Verb
from appliance.robots.mavlink import dialect, parameters
from appliance.robots.mavlink.byhand import ByHand
from appliance.robots.mavlink.copter import Copter
from appliance.robots.mavlink.craft import Craft
from appliance.robots.mavlink.missions import Missions
from appliance.robots.mavlink.payload import Payload
from appliance.robots.mavlink.protocol import command
from appliance.robots.mavlink.rover import Rover
from appliance.robots.mavlink.vehicle import Vehicle
from appliance.robots.settings import RobotsConfig
from appliance.robots.verbs import HoldArgs, ModeArgs, NoArgs, ParameterArgs, RobotFailure, in_range

log = structlog.get_logger(__name__)

_MAX_HOLD_S = 86_400.0
_LARGEST = 3.4e38
"""What a 32-bit float holds."""


class Helm:
    """Of one vehicle. `verbs` may be asked again at any time: what a vehicle is is known by its heartbeat alone."""

    def __init__(self, vehicle: Vehicle, *, site: Site, config: RobotsConfig) -> None:
        self._vehicle = vehicle
        self._craft = Craft(vehicle, site=site, config=config)
        missions = Missions(self._craft)
        self._missions = missions
        self._copter = Copter(self._craft, missions)
        self._rover = Rover(self._craft, missions)
        self._payload = Payload(self._craft)

    def ready(self) -> None:
        """Raise RobotFailure while it cannot be reached."""
        self._craft.ready()

    async def halt(self) -> None:
        """Bring it to rest where it is; RobotFailure while a pilot or failsafe has it."""
        await self._craft.halt()

    def verbs(self) -> dict[str, Verb]:
        """Return what it can do; only `state` for vehicles whose modes are not known here."""
        found = {"state": Verb(run=self.state)}
        if not self._vehicle.commandable:
            return found
        verb = self._craft.verb
        if self._vehicle.flies:
            found |= {
                "goto": verb(self._copter.goto),
                "takeoff": verb(self._copter.takeoff),
                "land": verb(self._copter.land, safe=True),
                "return_home": verb(self._copter.return_home, safe=True),
                "orbit": verb(self._missions.orbit),
            }
        else:
            found |= {"goto": verb(self._rover.goto), "return_home": verb(self._rover.return_home, safe=True)}
        return found | {
            "hold": verb(self.hold, preempts=True),
            "velocity": verb(ByHand(self._craft).velocity, resumable=False, preempts=True),
            "arm": verb(self.arm),
            "disarm": verb(self.disarm, safe=True),
            "mission": verb(self._missions.mission),
            "set_mode": verb(self.set_mode, preempts=True),
            "parameter": Verb(run=self.parameter, resumable=True),
            "release": Verb(run=self.release, resumable=True),
            **self._payload.verbs(),
        }

    async def state(self, args: NoArgs) -> Done:  # noqa: ARG002 - verbs have one shape
        """Say what is known of it."""
        info = self._vehicle.info("", tuple(self.verbs()))
        said = {"flies": info.flies, "armed": info.armed, "online": info.online}
        return Done({**msgspec.to_builtins(info), **said} | self._craft.where())

    async def hold(self, args: HoldArgs) -> Done:
        """Stop where it is; with a duration, stay that long."""
        in_range("hold", "duration_s", args.duration_s, 0.0, _MAX_HOLD_S)
        await self._craft.halt()
        await asyncio.sleep(args.duration_s or 0.0)
        return Done({"held_s": args.duration_s or 0.0} | self._craft.where())

    async def arm(self, args: NoArgs) -> Done:  # noqa: ARG002 - verbs have one shape
        """Arm the motors, when nothing speaks against it."""
        if not self._vehicle.armed:
            await self._craft.mode(self._craft.modes.guided)
            await self._craft.arm()
        return Done(self._craft.where())

    async def disarm(self, args: NoArgs) -> Done:  # noqa: ARG002 - verbs have one shape
        """Disarm; the autopilot refuses in the air."""
        if self._vehicle.armed:
            await command(
                self._vehicle,
                dialect.ARM,
                0.0,
                patience=self._craft.patience,
                check=lambda: self._craft.check_control(safe=True),
            )
            await self._craft.confirm(lambda: not self._vehicle.armed)
        return Done(self._craft.where())

    async def set_mode(self, args: ModeArgs) -> Done:
        """Change the mode. It ends what the base does, and the mode counts as the gateway's own."""
        modes = self._craft.modes
        name = args.mode.strip().upper()
        if name not in modes.numbers:
            known = ", ".join(sorted(modes.numbers))
            raise RobotFailure("payload", f"set_mode: there is no mode {args.mode[:40]!r}", remedy=f"known: {known}")
        if name in modes.by_hand:
            raise RobotFailure(
                "refused",
                f"in {name} sticks move {self._vehicle.name}, and a gateway has none",
                remedy=f"use one of {', '.join(sorted(modes.plain))}",
            )
        if name not in modes.plain:
            raise RobotFailure(
                "refused",
                f"in {name} {self._vehicle.name} goes where nobody has checked that it may",
                remedy=f"give a mission by `mission`, which is checked, or use one of {', '.join(sorted(modes.plain))}",
            )
        await self._craft.mode(name)
        return Done(self._craft.where())

    async def parameter(self, args: ParameterArgs) -> Done:
        """Read or write one of the autopilot's parameters; written only while it stands disarmed."""
        name = parameters.check_name(args.name)
        patience = self._craft.patience
        if args.value is None:
            return Done({"name": name, "value": await parameters.read(self._vehicle, name, patience=patience)})
        in_range("parameter", "value", args.value, -_LARGEST, _LARGEST)
        if self._vehicle.armed:
            raise RobotFailure("refused", f"{self._vehicle.name} is armed", remedy="write parameters while it stands")
        return Done({"name": name, "value": await parameters.write(self._vehicle, name, args.value, patience=patience)})

    async def release(self, args: NoArgs) -> Done:  # noqa: ARG002 - verbs have one shape
        """Take the vehicle back from a pilot; a failsafe that is in force keeps it."""
        if self._vehicle.condition.failsafe and self._vehicle.armed:
            raise RobotFailure(
                "refused",
                f"{self._vehicle.name} is under a failsafe: {self._vehicle.condition.failsafe}",
                remedy="`land` and `return_home` are taken all the same",
            )
        before = self._vehicle.control.release()
        if before is not None:
            log.warning("vehicle taken back by an operator", robot=self._vehicle.name, from_=before.by, why=before.why)
        return Done({"was": "" if before is None else before.why} | self._craft.where())
