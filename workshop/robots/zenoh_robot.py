"""A simulated mobile manipulator as a process of its own: base, arm and camera, speaking Zenoh itself.

It stands for robots that need no gateway to be reached: it puts its own RobotInfo, holds its own liveliness token
and answers its own command key, with the same desk and ledger that gateways use for MAVLink vehicles. Its ledger
lives as long as its process: a rover that is switched off forgets, and starts at its charger again.
"""

import asyncio
import base64
import contextlib
import math
import secrets
import time
from contextlib import AsyncExitStack
from typing import NoReturn

import msgspec
import structlog
from msgspec import Struct, field

from appliance.errors import ConfigError, ConflictError, UnreachableError
from appliance.model import Notice, Pose, RobotCommand, RobotInfo, Site, encode, keyspace
from appliance.model.keys import check_name
from appliance.model.robots import plausible_battery
from appliance.model.site import blocked_leg
from appliance.plane.session import Session
from appliance.plane.settings import PlaneConfig
from appliance.robots.executor import UNREADABLE, CommandExecutor, Done, IdempotencyLog, Verb
from appliance.robots.limits import check_velocity, check_way
from appliance.robots.verbs import (
    MAX_FRAMES,
    MAX_SIDE,
    CaptureArgs,
    GotoArgs,
    HoldArgs,
    NoArgs,
    PickArgs,
    PlaceArgs,
    RecordArgs,
    RobotFailure,
    VelocityArgs,
    in_range,
)
from workshop.robots import camera
from workshop.robots.around import Around
from workshop.robots.driving import Driving
from workshop.robots.ears import Ears
from workshop.robots.mavlink import start_point
from workshop.robots.tools import Tools
from workshop.robots.world import WORLD, WORLD_OF, Aim, Thing, Things, World, aim, words

log = structlog.get_logger(__name__)

TICK_S = 0.1
STATE_S = 0.2
"""RobotInfo at 5 Hz."""
GRASP_S = 2.0
"""What the arm needs for a thing, simulated seconds."""
SHUTTER_S = 0.3
USUAL_RECORD_S, USUAL_FPS = 5.0, 5.0
_RETRY_S = 0.5
_SEEN_S = 5.0
"""How often a robot whose name is taken shows that it is there."""
_SETTLE_S = 0.8
"""How long a robot shows itself before it takes commands: four states, in which another of its name is heard."""
_OPERATOR = "operator"
_SNAPSHOT_S = 1.0
_MAX_HOLD_S = 86_400.0
_CHARGER_M = 1.0
_LATE_S = 1.0


class RobotSettings(Struct, frozen=True, kw_only=True):
    """One simulated rover."""

    name: str
    fleet: str = "default"
    connect: tuple[str, ...] = ()
    """Endpoints of gateways; the next is taken when one is gone."""
    site: Site = field(default_factory=Site)
    start: str = "charger"
    """Its home, a place or a point "x, y"; the site's origin where the site has no places."""
    spot: int = 0
    """Beside it: 0 is the place itself."""
    at: str = ""
    """Where it stands at first, a point "x, y"; empty: at home."""
    holding: str = ""
    """What it has in its hand at first."""
    rate: float = 1.0
    """How many times faster than real it moves."""
    battery_percent: float = 100.0

    def check(self) -> None:
        """Raise ConfigError or PayloadError for what cannot be simulated."""
        check_name(self.name, "robot")
        start_point(self.site, self.start, self.spot)
        if self.at:
            start_point(self.site, self.at)
        if not (math.isfinite(self.rate) and 0.0 < self.rate <= 100.0):
            raise ConfigError(f"rate {self.rate:g}", remedy="use more than 0, at most 100")
        if not plausible_battery(self.battery_percent):
            raise ConfigError(f"a charge of {self.battery_percent:g} %", remedy="use 0 to 100")


async def run_robot(settings: RobotSettings, *, stop: asyncio.Event | None = None) -> None:
    """Simulate until `stop` is set or the task is cancelled; waits for a gateway as long as there is none.

    Raises:
        ConflictError: another robot of its name started at the same time, and is older.
    """
    settings.check()
    stop = asyncio.Event() if stop is None else stop
    session = await _connect(settings, stop)
    if session is None:
        return
    try:
        await Rover(settings, session).run(stop)
    finally:
        await session.close()


async def _connect(settings: RobotSettings, stop: asyncio.Event) -> Session | None:
    config = PlaneConfig(mode="client", connect=settings.connect)
    while not stop.is_set():
        try:
            return await Session.open(config, settings.fleet)
        except UnreachableError as error:
            log.info("waiting for a gateway", robot=settings.name, reason=error.message)
            try:
                async with asyncio.timeout(_RETRY_S):
                    await stop.wait()
            except TimeoutError:
                continue
    return None


class Rover:
    """One rover on one session."""

    def __init__(self, settings: RobotSettings, session: Session) -> None:
        self.name = settings.name
        self.world = World(settings.site)
        self.home = start_point(settings.site, settings.start, settings.spot)
        at = start_point(settings.site, settings.at) if settings.at else self.home
        self.driving = Driving(*at, battery_percent=settings.battery_percent)
        self._holding = settings.holding
        self.refused: dict[str, int] = {}
        self._speaker = f"{time.time_ns():020d}-{secrets.token_hex(4)}"
        self._older = ""
        """Another robot of this name that was heard and started earlier."""
        self._site = settings.site
        self._rate = settings.rate
        self._session = session
        self._trail: list[tuple[float, float]] = []
        self._around = Around(
            self.name, self.world, pose=lambda: self.driving.pose, wait=self._wait, announce=self._announce
        )
        self._tools = Tools(
            self.name,
            self.world,
            self.driving,
            session,
            site=self._open_site,
            wait=self._wait,
            announce=self._announce,
            drive=self._drive,
        )
        self.desk = CommandExecutor(
            self.name,
            session=session,
            ledger=IdempotencyLog(self.name),
            verbs=self._verbs(),
            ready=lambda: None,
            halt=self._halt,
            refused=self.refused,
        )

    def _verbs(self) -> dict[str, Verb]:
        return {
            "state": Verb(run=self._state),
            "goto": Verb(run=self._goto, uses=("base",), resumable=True),
            "return_home": Verb(run=self._return_home, uses=("base",), resumable=True),
            "hold": Verb(run=self._hold, uses=("base",), resumable=True, preempts=True),
            "velocity": Verb(run=self._velocity, uses=("base",), preempts=True),
            "pick": Verb(run=self._pick, uses=("arm",)),
            "place": Verb(run=self._place, uses=("arm",)),
            "capture": Verb(run=self._capture, uses=("camera",), resumable=True),
            "record": Verb(run=self._record, uses=("camera",), resumable=True),
            **self._around.verbs(),
            **self._tools.verbs(),
        }

    async def run(self, stop: asyncio.Event) -> None:
        """Move, tell and answer until `stop` is set."""
        session, keys = self._session, self._session.keys
        async with AsyncExitStack() as stack:
            follow = session.subscribe_typed(WORLD, self._follow)
            stack.callback(follow.close)
            stack.callback(session.subscribe_typed(keyspace.ROBOT, self._meet, self.name).close)
            await self._catch_up()
            if not await self._named_alone(stop):
                return
            if self._holding:
                self._announce(self.world.load(self.name, self._holding, self.driving.pose))
            for closer in (
                session.serve(keys(WORLD_OF, self.name), self._tell_world),
                session.serve(keys(keyspace.COMMAND, self.name), self.desk.handle, signers=keyspace.COMMAND.asks),
                session.declare_alive(keys(keyspace.ROBOT_ALIVE, self.name)),
            ):
                stack.callback(closer.close)
            stack.push_async_callback(self.desk.close)
            ears = Ears(self.name, self._around, session)
            ears.listen()
            stack.push_async_callback(ears.close)
            log.info("simulated rover", robot=self.name, at=self.home)
            await self._live(stop)

    async def _named_alone(self, stop: asyncio.Event) -> bool:
        """Wait until no other robot has this one's name; False when it is to stop first.

        Raises:
            ConflictError: one that started at the same instant is older.
        """
        while await self._until_free(stop):
            # One that started at the same instant holds no token yet: both show themselves first.
            await self._settle(stop)
            if not await self._session.alive_now(self._session.keys(keyspace.ROBOT_ALIVE, self.name)):
                return not stop.is_set()
        return False

    async def _until_free(self, stop: asyncio.Event) -> bool:
        """Wait until no robot holds the token of this name, which is reported once; False when it is to stop first."""
        session, reported, seen_at = self._session, False, -math.inf
        while await session.alive_now(session.keys(keyspace.ROBOT_ALIVE, self.name)):
            if not reported:
                reported = True
                log.error("another robot has this name: waiting until it is gone", robot=self.name)
                self._report_namesake()
            if time.monotonic() - seen_at >= _SEEN_S:
                seen_at = time.monotonic()
                session.publish(keyspace.ROBOT, self.info(), self.name)  # heeded by no roster, but seen
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(_RETRY_S):
                    await stop.wait()
                    return False
        return True

    def _report_namesake(self) -> None:
        notice = Notice(
            id=f"{self.name}/namesake/{self._speaker}",
            to=_OPERATOR,
            text=f"a second robot that calls itself {self.name} is refused: give it a name of its own",
            at_ns=time.time_ns(),
        )
        self._session.publish(keyspace.NOTICE, notice, _OPERATOR)

    def _meet(self, key: str, info: RobotInfo | None) -> None:
        """Hear the states under this name: of two that started at the same instant the older has it, as in rosters."""
        del key
        if info is not None and info.speaker and info.speaker < self._speaker:
            self._older = info.speaker

    async def _settle(self, stop: asyncio.Event) -> None:
        """Show itself for a moment; ConflictError when an older one does so, too."""
        self._older = ""  # of those that have gone
        until = time.monotonic() + _SETTLE_S
        while time.monotonic() < until and not stop.is_set():
            self._session.publish(keyspace.ROBOT, self.info(), self.name)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(STATE_S):
                    await stop.wait()
            if self._older:
                self._yield_name()

    def _yield_name(self) -> NoReturn:
        self._report_namesake()
        raise ConflictError(
            f"another robot is called {self.name}, and started earlier ({self._older}, this one {self._speaker})",
            remedy="give each a name of its own",
        )

    async def _live(self, stop: asyncio.Event) -> None:
        before = told = 0.0
        while not stop.is_set():
            if self._older:
                # A log that is played tells of older ones, too: what counts is one that takes commands.
                asked = encode(RobotCommand(id=f"{self.name}/who", verb="state"))
                key = self._session.keys(keyspace.COMMAND, self.name)
                if await self._session.answerers(key, asked, timeout_s=_SNAPSHOT_S) > 1:
                    self._yield_name()
                self._older = ""
            now = time.monotonic()
            dt = min(now - before, _LATE_S) * self._rate if before else 0.0
            before = now
            self.driving.step(dt)
            self._charge(dt)
            self.world.carry(self.name, self.driving.pose)
            if now - told >= STATE_S:
                told = now
                self._session.publish(keyspace.ROBOT, self.info(), self.name)
            try:
                async with asyncio.timeout(TICK_S):
                    await stop.wait()
            except TimeoutError:
                continue

    def info(self) -> RobotInfo:
        """Describe it for the roster."""
        held = self.world.held_by(self.name)
        busy = self.desk.busy
        return RobotInfo(
            id=self.name,
            kind="zenoh",
            uses=("base", "arm", "camera", "speaker", "microphone"),
            verbs=(*self.desk.verbs, "stop"),
            pose=self.driving.pose,
            home=Pose(x=self.home[0], y=self.home[1]),
            battery_percent=round(self.driving.battery_percent, 1),
            armed=True,
            mode=busy[0] if busy else "idle",
            holding=held.name if held else "",
            note=", ".join(busy),
            speaker=self._speaker,
        )

    def _charge(self, dt: float) -> None:
        charger = self._site.find("charger")
        if (
            charger is not None
            and not self.driving.moving
            and math.hypot(charger.x - self.driving.x, charger.y - self.driving.y) <= _CHARGER_M
        ):
            self.driving.charge(dt)

    # --- base --------------------------------------------------------------------------------------------------

    async def _state(self, args: NoArgs) -> Done:  # noqa: ARG002 - verbs have one shape
        info = self.info()
        return Done({**msgspec.to_builtins(info), "flies": False, "online": True} | self._where())

    def _open_site(self) -> Site:
        """The site as it is now: a door that is shut is an obstacle."""
        shut = self.world.shut
        return msgspec.structs.replace(self._site, obstacles=(*self._site.obstacles, *shut)) if shut else self._site

    async def _goto(self, args: GotoArgs) -> Done:
        points = check_way(self._open_site(), self.driving.pose, args, flies=False)
        driven = self.driving.driven_m
        way = [(point.x, point.y) for point in points]
        await self._drive(way, args.speed_mps)
        return Done({"waypoints": len(way), "driven_m": round(self.driving.driven_m - driven, 2)} | self._where())

    async def _return_home(self, args: NoArgs) -> Done:  # noqa: ARG002 - verbs have one shape
        here = (self.driving.x, self.driving.y)
        closed = (*self._site.forbidden, *self._open_site().obstacles)
        # It plans no ways of its own: straight where nothing is between, else back the way it came.
        way = [self.home] if blocked_leg(closed, here, [self.home]) is None else [*reversed(self._trail), self.home]
        await self._drive(way, None)
        self._trail = []
        return Done({"moved": True} | self._where())

    async def _drive(self, way: list[tuple[float, float]], speed: float | None) -> None:
        driving = self.driving
        driving.go(way, speed)
        self._trail = [*self._trail, (driving.x, driving.y)][-200:]
        try:
            while driving.moving:
                if driving.battery_percent <= 0.0:
                    raise RobotFailure("robot", f"{self.name}'s battery is empty", remedy="bring it to its charger")
                await asyncio.sleep(TICK_S / 2)
        finally:
            driving.halt()
        self._trail = [*self._trail, *way][-200:]

    async def _hold(self, args: HoldArgs) -> Done:
        in_range("hold", "duration_s", args.duration_s, 0.0, _MAX_HOLD_S)
        self.driving.halt()
        await self._wait(args.duration_s or 0.0)
        return Done({"held_s": args.duration_s or 0.0} | self._where())

    async def _velocity(self, args: VelocityArgs) -> Done:
        east, north, _ = check_velocity(self._open_site(), self.driving.pose, args, flies=False)
        self.driving.by_hand(east, north, args.turn_dps)
        try:
            # Real seconds, whatever the rate: a person's hand is on it.
            await asyncio.sleep(args.for_s)
        finally:
            self.driving.halt()
        return Done({"moved_s": args.for_s} | self._where())

    async def _halt(self) -> None:
        self.driving.halt()

    # --- arm ---------------------------------------------------------------------------------------------------

    async def _pick(self, args: PickArgs) -> Done:
        self.world.check_pick(self.name, args.object, self.driving.pose)
        await self._wait(GRASP_S)
        # Looked at again: it may have driven on, or another robot may have been quicker.
        thing = self.world.check_pick(self.name, args.object, self.driving.pose)
        self._announce(self.world.pick(self.name, thing))
        return Done({"object": thing.name, "holding": thing.name} | self._where())

    async def _place(self, args: PlaceArgs) -> Done:
        self.world.check_place(self.name, args.object, args.at, self.driving.pose)
        await self._wait(GRASP_S)
        thing, x, y = self.world.check_place(self.name, args.object, args.at, self.driving.pose)
        put = self.world.place(self.name, thing, x, y)
        self._announce(put)
        return Done({"object": thing.name, "at": args.at, "position": {"x": put.x, "y": put.y}} | self._where())

    def _announce(self, thing: Thing) -> None:
        self._session.publish(WORLD, thing, words(thing.name).replace(" ", "_"))

    def _follow(self, key: str, thing: Thing | None) -> None:
        if thing is not None and not self.world.take_in(thing):
            log.debug("world change known already", key=key)

    async def _tell_world(self, key: str, payload: bytes) -> bytes:  # noqa: ARG002 - the shape of a handler
        return encode(Things(self.world.things))

    async def _catch_up(self) -> None:
        """Ask the robots that are here already what has become of the things."""
        for message in await self._session.query_all(self._session.keys(WORLD_OF), b"", timeout_s=_SNAPSHOT_S):
            try:
                told = msgspec.json.decode(message.payload, type=Things)
            except UNREADABLE as error:
                self.refused["world_malformed"] = self.refused.get("world_malformed", 0) + 1
                log.warning("world of another robot unreadable", key=message.key, error=str(error))
                continue
            for thing in told.things:
                self.world.take_in(thing)

    # --- camera ------------------------------------------------------------------------------------------------

    async def _capture(self, args: CaptureArgs) -> Done:
        width = args.width or camera.WIDTH
        height = args.height or camera.HEIGHT
        in_range("capture", "width", width, 16, MAX_SIDE)
        in_range("capture", "height", height, 16, MAX_SIDE)
        await self._wait(SHUTTER_S)
        pose, view = self._aim(args.target)
        data = await asyncio.to_thread(self._picture, pose, view, width, height, "png")
        self._publish(data, "png")
        about = {
            "target": args.target,
            "known": view.known,
            "bearing_deg": round(view.bearing_deg, 1),
            "distance_m": round(view.distance_m, 2),
            "width": width,
            "height": height,
        }
        return Done(about | self._where(), {"image.png": data})

    async def _record(self, args: RecordArgs) -> Done:
        duration = USUAL_RECORD_S if args.duration_s is None else args.duration_s
        fps = USUAL_FPS if args.fps is None else args.fps
        in_range("record", "duration_s", duration, 0.1, 600.0)
        in_range("record", "fps", fps, 0.1, 30.0)
        count = max(1, round(duration * fps))
        if count > MAX_FRAMES:
            raise RobotFailure(
                "payload", f"record: {count} frames, {MAX_FRAMES} fit one answer", remedy="shorten it or lower the fps"
            )
        frames: dict[str, bytes] = {}
        for number in range(count):
            pose, view = self._aim(args.target)
            began = time.monotonic()
            data = await asyncio.to_thread(self._picture, pose, view, camera.WIDTH, camera.HEIGHT, "jpeg")
            self._publish(data, "jpeg")
            frames[f"frame-{number:03d}.jpg"] = data
            # A picture that took longer than its turn is not waited for on top.
            await asyncio.sleep(max(0.0, 1.0 / fps / self._rate - (time.monotonic() - began)))
        return Done(
            {"target": args.target, "frames": count, "duration_s": duration, "fps": fps} | self._where(), frames
        )

    def _aim(self, target: str) -> tuple[Pose, Aim]:
        pose = self.driving.pose
        return pose, aim(self.world, target, pose, camera.EYE_M)

    def _picture(self, pose: Pose, view: Aim, width: int, height: int, form: str) -> bytes:
        picture = camera.render(self.world, pose, view, robot=self.name, width=width, height=height)
        return camera.png(picture) if form == "png" else camera.jpeg(picture)

    def _publish(self, data: bytes, form: str) -> None:
        """Put the picture as foxglove.CompressedImage, so that it shows in the log."""
        seconds, nanoseconds = divmod(time.time_ns(), 1_000_000_000)
        image = {
            "timestamp": {"sec": seconds, "nsec": nanoseconds},
            "frame_id": f"{self.name}/camera",
            "data": base64.b64encode(data).decode(),
            "format": form,
        }
        self._session.put(self._session.keys(keyspace.CAMERA, self.name), encode(image))

    # --- pieces ------------------------------------------------------------------------------------------------

    async def _wait(self, seconds: float) -> None:
        """Let simulated seconds pass."""
        await asyncio.sleep(seconds / self._rate)

    def _where(self) -> dict[str, object]:
        pose = self.driving.pose
        held = self.world.held_by(self.name)
        return {
            "pose": {"x": pose.x, "y": pose.y, "z": pose.z, "heading_deg": pose.heading_deg},
            "battery_percent": round(self.driving.battery_percent, 1),
            "holding": held.name if held else "",
        }
