"""What all verbs of a MAVLink vehicle are made of: change its mode, arm it, watch it on its way, move it by hand.

A verb ends when the vehicle says that it is where it should be, never when a command was acknowledged. Modes are
changed by DO_SET_MODE and verified by the heartbeat, since an acknowledgement can be lost or late. Nothing here
commands a vehicle that a pilot or a failsafe has (`vehicle.Control`).

Manual control moves it for a moment at a time, by velocities in its guided mode; then it holds by itself:
SET_POSITION_TARGET_LOCAL_NED with velocities in the body's frame (ArduPilot, "Copter Commands in Guided Mode" and
"Rover Commands in Guided Mode"). The autopilot stops by itself when none came for `GUID_TIMEOUT`, 3 s; the end is sent.
"""

import asyncio
import math
from collections.abc import Callable, Sequence
from itertools import pairwise

import structlog

from appliance.model import Pose, Site
from appliance.model.site import to_globe, to_site
from appliance.robots.executor import Done, Terms, Verb, verb, verbs_of
from appliance.robots.limits import breach, check_velocity
from appliance.robots.mavlink import dialect
from appliance.robots.mavlink.dialect import Message, make
from appliance.robots.mavlink.protocols import RetryPolicy, ask, command
from appliance.robots.mavlink.vehicle import Modes, Report, Vehicle, apart_s
from appliance.robots.settings import RobotsConfig
from appliance.robots.verbs import RobotFailure, VelocityArgs

log = structlog.get_logger(__name__)

POLL_S = 0.1
CONFIRM_S = 3.5
"""Three heartbeats: the mode is in each."""
_ROUNDS = 4
_NEARER_M = 0.5
"""Coming nearer by less than this is no progress."""
_PREARM_S = 1.0
"""How long an autopilot takes to say what keeps it from arming."""
_BODY_OFFSET_NED = 9
"""MAV_FRAME_BODY_OFFSET_NED."""
_VELOCITY_AND_YAW_RATE = 0x05C7
"""POSITION_TARGET_TYPEMASK: position, acceleration and yaw are not meant."""
_RESTS = 5
"""Zero velocities are not acknowledged: of five, one arrives over a link that loses a fifth."""
TAKEN = "taken"
"""Code of failures because a pilot or a failsafe has the vehicle: waiting for it to be given back may help."""

Point = tuple[float, float, float]


class VehicleController:
    """One vehicle as its verbs see it."""

    def __init__(self, vehicle: Vehicle, *, site: Site, config: RobotsConfig) -> None:
        self.vehicle = vehicle
        self.site = site
        self.config = config
        self.patience = RetryPolicy(timeout_s=config.ack_timeout_s, tries=config.tries)

    @property
    def modes(self) -> Modes:
        """Its modes; RobotFailure where they are not known here."""
        modes = self.vehicle.modes
        if modes is None:
            raise RobotFailure("robot", f"the modes of {self.vehicle.name} are not known here")
        return modes

    def verbs_of(self, *parts: object) -> dict[str, Verb]:
        """Return the verbs that those parts of it carry out; guarded ones are refused while somebody else has it."""
        return verbs_of(*parts, check=lambda safe: self.check_control(safe=safe), flies=self.vehicle.flies)

    def ready(self) -> None:
        """Raise RobotFailure while it cannot be reached."""
        if not self.vehicle.online:
            raise RobotFailure(
                "robot",
                f"{self.vehicle.name} is offline: no heartbeat for {self.config.heartbeat_lost_s:g} s",
                remedy="check its power and its link",
                retryable=True,
            )

    def check_control(self, *, safe: bool = False) -> None:
        """Raise RobotFailure while a pilot, or unless `safe` a failsafe, has the vehicle."""
        seized = self.vehicle.control.seized
        if seized is not None and not (safe and seized.by == "failsafe"):
            raise self.taken("is not commanded")

    def taken(self, what: str) -> RobotFailure:
        """Make the failure that says who has the vehicle."""
        seized = self.vehicle.control.seized
        why = seized.why if seized is not None else "it is not this gateway's"
        said = f" ({self.vehicle.text})" if self.vehicle.text else ""
        if seized is not None and seized.by == "failsafe":
            remedy = "see to the vehicle: it is commanded again when the failsafe is over, or it has disarmed"
        else:
            remedy = f"give it back in {self.modes.guided}, or take it with the command `release`"
        return RobotFailure(TAKEN, f"{self.vehicle.name} {what}: {why}{said}", remedy=remedy)

    # --- modes and motors --------------------------------------------------------------------------------------

    async def mode(self, name: str, *, safe: bool = False, behind: Message | None = None) -> None:
        """Change the mode and wait until the heartbeat says so; RobotFailure when it does not, or is taken over.

        A pilot may take the vehicle at any moment of the change, so control is looked at before each sending: a repeat
        would take it back from them. `safe`: goes on under a failsafe. `behind`: sent right behind the first request.
        """
        vehicle = self.vehicle
        wanted = self.modes.numbers[name]
        loop = asyncio.get_running_loop()

        def check() -> None:
            self.check_control(safe=safe)

        def changed(since: float) -> bool:
            check()
            return vehicle.heard_at > since and vehicle.custom_mode == wanted

        check()
        vehicle.control.order(wanted, loop.time())
        for _ in range(_ROUNDS):
            # What was heard before is no answer: an order given just before this one may not have shown yet, and an
            # acknowledgement that comes late may be that one's.
            sent = loop.time()
            flag = dialect.CUSTOM_MODE_FLAG
            await command(vehicle, dialect.SET_MODE, flag, wanted, patience=self.patience, check=check, behind=behind)
            behind = None
            if await self.confirm(lambda since=sent: changed(since)):
                return
        raise RobotFailure("robot", f"{vehicle.name} stays in {vehicle.mode} instead of {name}", retryable=True)

    async def arm(self, *, safe: bool = False) -> None:
        """Arm in the guided mode, after the autopilot's own checks and the gateway's.

        RobotFailure with all that speaks against it, a person who has chosen another mode meanwhile too. `safe`: goes
        on under a failsafe.
        """
        vehicle = self.vehicle

        def check() -> None:
            self.check_control(safe=safe)
            # With the motors off nobody has taken it, yet a mode that was chosen on the ground is somebody's plan.
            if not vehicle.armed and vehicle.mode != self.modes.guided:
                raise RobotFailure(
                    TAKEN,
                    f"{vehicle.name} is not armed: it was changed to {vehicle.mode} meanwhile, not by this gateway",
                    remedy=f"see who is at the vehicle; it is armed in {self.modes.guided}",
                )

        if vehicle.armed:
            check()
            return
        problems = list(self._unfit())
        outcome = await ask(vehicle, dialect.RUN_PREARM, patience=self.patience)
        # An autopilot that does not know the command still checks when it is armed.
        if outcome.result == dialect.ACCEPTED and vehicle.condition.prearm is False:
            loop = asyncio.get_running_loop()
            began = loop.time()
            await asyncio.sleep(_PREARM_S)
            problems += [*outcome.said, *vehicle.texts.since(began, loop.time())]
        if problems:
            raise RobotFailure(
                "robot",
                f"{vehicle.name} is not fit to arm: {'; '.join(dict.fromkeys(problems))}",
                remedy="see to what it says, then try again",
                retryable=True,
            )
        await command(vehicle, dialect.ARM, 1.0, patience=self.patience, check=check)
        if not await self.confirm(lambda: vehicle.armed):
            raise RobotFailure("robot", f"{vehicle.name} acknowledged arming and is not armed", retryable=True)

    def _unfit(self) -> Sequence[str]:
        """What the gateway itself sees that speaks against arming."""
        vehicle = self.vehicle
        found = [f"its estimator has {each}" for each in vehicle.condition.estimator]
        if vehicle.condition.failsafe:
            found.append(f"failsafe: {vehicle.condition.failsafe}")
        left = self._breach()
        return [*found, left] if left else found

    async def confirm(self, holds: Callable[[], bool], within_s: float = CONFIRM_S) -> bool:
        """Wait for the vehicle to say so itself."""
        loop = asyncio.get_running_loop()
        deadline = loop.time() + within_s
        while not holds():
            if loop.time() >= deadline:
                return False
            await asyncio.sleep(POLL_S / 2)
        return True

    async def halt(self) -> None:
        """Bring it to rest where it is; RobotFailure when it cannot be told, does not answer, or is somebody else's.

        Whatever is armed is halted, on the ground too: a multirotor whose motors spin up would else begin its mission.
        The guided mode alone does not end a take-off or a target given in that mode (to change to the mode it is in
        does nothing), a velocity of zero does.
        """
        vehicle = self.vehicle
        if not vehicle.online:
            last = "armed" if vehicle.armed else "disarmed"
            raise RobotFailure(
                "robot",
                f"{vehicle.name} could not be told to hold: it is offline, and was {last} when it was heard last",
                remedy="its own failsafe has it; a soft stop (`swiftbot stop`) reaches it when it is back",
                retryable=True,
            )
        if not vehicle.armed:
            return
        if not vehicle.commandable:
            raise RobotFailure(
                "refused",
                f"{vehicle.name} is armed and was not halted: it is watched, not commanded",
                remedy="stop it from its ground station",
            )
        if vehicle.control.seized is not None:
            log.info("not halted: somebody else has it", robot=vehicle.name, why=vehicle.control.seized.why)
            raise self.taken("was not halted")
        await self.mode(self.modes.guided)
        for _ in range(_RESTS):
            self.check_control()
            self.push(VelocityArgs())
            await asyncio.sleep(POLL_S / 2)

    # --- on the way --------------------------------------------------------------------------------------------

    async def travel(
        self,
        verb: str,
        mode: str,
        there: Callable[[], bool],
        left: Callable[[], float],
        *,
        safe: bool = False,
        steady: Callable[[], bool] = lambda: False,
    ) -> None:
        """Wait until `there`; RobotFailure when it no longer comes nearer, leaves the site, or is taken over.

        Args:
            verb: what it does, for messages.
            mode: the mode in which it does so.
            there: whether it has arrived.
            left: what is left, metres.
            safe: goes on under a failsafe, being what a failsafe would do.
            steady: whether it rightly stays where it is for the time being.
        """
        vehicle = self.vehicle
        loop = asyncio.get_running_loop()
        best, since = left(), loop.time()
        seen = vehicle.track.count
        outside = self._breach()
        while not there():
            await asyncio.sleep(POLL_S)
            if there():
                return
            now, distance = loop.time(), left()
            told, seen = vehicle.track.since(seen), vehicle.track.count
            await self._check_way(verb, mode, told, outside=outside, safe=safe)
            if distance < best - _NEARER_M or steady():
                best, since = min(best, distance), now
            elif now - since > self.config.stall_s:
                await self.halt()
                raise RobotFailure(
                    "robot",
                    f"{vehicle.name} has not come nearer for {self.config.stall_s:g} s during {verb}, "
                    f"{distance:.1f} m were left",
                    remedy="look at the vehicle and its way",
                    retryable=True,
                )

    async def _check_way(self, verb: str, mode: str, told: Sequence[Report], *, outside: str, safe: bool) -> None:
        vehicle = self.vehicle
        seized = vehicle.control.seized
        if seized is not None and not (safe and seized.by == "failsafe"):
            raise self.taken(f"was taken over during {verb}")
        name = self.modes.name(vehicle.custom_mode)
        if name != mode and name not in self.modes.follows.get(mode, frozenset()):
            raise RobotFailure(
                TAKEN,
                f"{vehicle.name} left {mode} for {vehicle.mode} during {verb}: {vehicle.text or 'not by us'}",
                remedy="a pilot or a failsafe has taken over; see to the vehicle",
            )
        if not vehicle.armed and verb not in ("land", "return_home"):
            raise RobotFailure("robot", f"{vehicle.name} disarmed during {verb}: {vehicle.text}".rstrip(": "))
        if not outside and not safe and (left := self._strayed(told)):
            await self.halt()
            raise RobotFailure(
                "refused",
                f"{vehicle.name} was stopped during {verb}: {left}",
                remedy="see to the vehicle, and bring it back inside",
            )

    def _strayed(self, told: Sequence[Report]) -> str:
        """Look at every position that was told, and between them: there may be many between two looks."""
        flies = self.vehicle.flies
        for before, here in pairwise(told):
            apart = apart_s(before, here)
            if left := breach(self.site, here.pose, flies=flies, before=before.pose, apart_s=apart):
                return left
        return self._breach()

    def _breach(self) -> str:
        pose = self.vehicle.pose
        return "" if pose is None else breach(self.site, pose, flies=self.vehicle.flies)

    def target(self, latitude_deg: float, longitude_deg: float, relative_m: float) -> None:
        """Send a position to go to in the guided mode; these are not acknowledged."""
        self.vehicle.send(
            make(
                "SET_POSITION_TARGET_GLOBAL_INT",
                time_boot_ms=0,
                target_system=self.vehicle.system,
                target_component=self.vehicle.component,
                coordinate_frame=dialect.FRAME_RELATIVE,
                type_mask=0x0DF8,  # position alone counts
                lat_int=round(latitude_deg * 1e7),
                lon_int=round(longitude_deg * 1e7),
                alt=relative_m,
                vx=0.0,
                vy=0.0,
                vz=0.0,
                afx=0.0,
                afy=0.0,
                afz=0.0,
                yaw=0.0,
                yaw_rate=0.0,
            )
        )

    def push(self, move: VelocityArgs) -> None:
        """Send velocities in the body's frame, for the guided mode; these are not acknowledged."""
        vehicle = self.vehicle
        vehicle.send(
            make(
                "SET_POSITION_TARGET_LOCAL_NED",
                time_boot_ms=0,
                target_system=vehicle.system,
                target_component=vehicle.component,
                coordinate_frame=_BODY_OFFSET_NED,
                type_mask=_VELOCITY_AND_YAW_RATE,
                x=0.0,
                y=0.0,
                z=0.0,
                vx=move.forward_mps,
                vy=-move.left_mps,
                vz=-move.up_mps,
                afx=0.0,
                afy=0.0,
                afz=0.0,
                yaw=0.0,
                yaw_rate=math.radians(move.turn_dps),
            )
        )

    # --- where it is -------------------------------------------------------------------------------------------

    async def fix(self) -> Pose:
        """Wait a little for the position: a vehicle that has just come online has not told it yet."""
        await self.confirm(lambda: self.vehicle.fixed)
        return self.position()

    def position(self) -> Pose:
        """Return where it is; RobotFailure when it does not know."""
        pose = self.vehicle.pose
        if pose is None:
            raise RobotFailure(
                "robot", f"{self.vehicle.name} does not know where it is", remedy="wait for its GPS", retryable=True
            )
        return pose

    def site_point(self, latitude_deg: float, longitude_deg: float, altitude_m: float) -> Point:
        """Return the site's metres of a point on the globe."""
        return to_site(self.site, latitude_deg, longitude_deg, altitude_m)

    def globe_point(self, x: float, y: float, z: float = 0.0) -> Point:
        """Return latitude, longitude and altitude of a point of the site."""
        return to_globe(self.site, x, y, z)

    def distance(self, point: Point) -> float:
        """Return metres to a point: on the ground for what drives."""
        pose = self.position()
        if not self.vehicle.flies:
            return math.hypot(pose.x - point[0], pose.y - point[1])
        return math.dist((pose.x, pose.y, pose.z), point)

    def left(self, way: Sequence[Point], last: int) -> float:
        """Metres left to go: to the next waypoint by the mission's own count (item `last`), and along the rest."""
        behind = max(0, min(len(way) - 1, last - self.vehicle.mission_at))
        rest = way[len(way) - 1 - behind :]
        return self.distance(rest[0]) + sum(math.dist(one, other) for one, other in pairwise(rest))

    def where(self) -> dict[str, object]:
        """Return what every answer tells."""
        pose = self.vehicle.pose
        return {
            "pose": None if pose is None else {"x": pose.x, "y": pose.y, "z": pose.z, "heading_deg": pose.heading_deg},
            "battery_percent": self.vehicle.battery_percent,
            "mode": self.vehicle.mode,
        }


_EVERY_S = 0.1


class ManualControl:
    """Of one vehicle."""

    def __init__(self, craft: VehicleController) -> None:
        self._craft = craft

    @verb(Terms(resumable=False, preempts=True))
    async def velocity(self, args: VelocityArgs) -> Done:
        """Move for `for_s` seconds; RobotFailure where it may not, or is on the ground and flies."""
        craft, vehicle = self._craft, self._craft.vehicle
        check_velocity(craft.site, await craft.fix(), args, flies=vehicle.flies)
        if not vehicle.armed or (vehicle.flies and not vehicle.airborne):
            what = "is on the ground" if vehicle.flies else "is not armed"
            first = "takeoff" if vehicle.flies else "arm"
            raise RobotFailure("precondition", f"{vehicle.name} {what}", remedy=f"`{first}` first")
        if vehicle.mode != craft.modes.guided:
            await craft.mode(craft.modes.guided)
        loop = asyncio.get_running_loop()
        until = loop.time() + args.for_s
        try:
            while loop.time() < until:
                craft.check_control()
                craft.push(args)
                await asyncio.sleep(min(_EVERY_S, max(0.0, until - loop.time())))
        finally:
            craft.push(VelocityArgs())
        return Done({"moved_s": args.for_s} | craft.where())
