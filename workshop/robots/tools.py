"""What the simulated robot does with tools and sensors: work on things within reach, push them, listen, measure, scan.

What it measures is there in the simulated world: distances are those to its boxes, devices that are switched on are
warm and hum, a cut thing stays cut for every robot. What the world has not (gas, light) it cannot measure, and says so.
"""

import array
import asyncio
import io
import math
import time
import wave
from collections.abc import Awaitable, Callable

import numpy as np
from PIL import Image

from appliance.model import Pose, RobotInfo, Site, keyspace
from appliance.model.site import bearing_deg, blocked_leg
from appliance.plane.session import Session
from appliance.robots.executor import Done, Verb
from appliance.robots.limits import check_speed
from appliance.robots.verbs import (
    FollowArgs,
    ListenArgs,
    MeasureArgs,
    NamedArgs,
    NamedToArgs,
    NoArgs,
    PourArgs,
    RobotFailure,
    ThermalArgs,
    in_range,
)
from workshop.robots import camera
from workshop.robots.driving import Driving
from workshop.robots.world import ON, Thing, World, aim, words

WORK_S = 4.0
"""What the arm needs for one piece of work, simulated seconds."""
PUSH_MPS = 0.5
STEP_M = 1.0
"""How far a thing is pushed when no place is named."""
SCAN_STEPS = 180
SCAN_MOST_M = 8.0
SOUND_HZ = 8000
HUM_HZ, HUM_M = 120.0, 10.0
"""A device that is on hums, and how far that is heard."""
_TICK_S = 0.1
_MAX_S = 3600.0

DONE = {"clean": "clean", "cut": "cut", "fasten": "fastened", "unfasten": "loose"}
"""What a thing is after such work."""


class Tools:
    """Of one robot.

    Args:
        robot: its name.
        world: as it knows it.
        driving: its base.
        session: by which it sees other robots.
        site: gives the site as it is now, shut doors among its obstacles.
        wait: lets simulated seconds pass.
        announce: tells the others of a change.
        drive: goes a way at a speed, until it is there.
    """

    def __init__(
        self,
        robot: str,
        world: World,
        driving: Driving,
        session: Session,
        *,
        site: Callable[[], Site],
        wait: Callable[[float], Awaitable[None]],
        announce: Callable[[Thing], None],
        drive: Callable[[list[tuple[float, float]], float | None], Awaitable[None]],
    ) -> None:
        self._robot, self._world, self._driving, self._session = robot, world, driving, session
        self._site, self._wait, self._announce, self._drive = site, wait, announce, drive

    def verbs(self) -> dict[str, Verb]:
        """Return the verbs by name."""
        return {
            "clean": Verb(run=self._working("clean"), uses=("arm",), resumable=True),
            "cut": Verb(run=self._working("cut"), uses=("arm",)),
            "unfasten": Verb(run=self._working("unfasten"), uses=("arm",), resumable=True),
            "fasten": Verb(run=self._fasten, uses=("arm",), resumable=True),
            "pour": Verb(run=self._pour, uses=("arm",)),
            "push": Verb(run=self._push, uses=("base", "arm")),
            "follow": Verb(run=self._follow, uses=("base",)),
            "measure": Verb(run=self._measure),
            "listen": Verb(run=self._listen, uses=("microphone",)),
            "thermal": Verb(run=self._thermal, uses=("camera",), resumable=True),
            "scan": Verb(run=self._scan),
        }

    # --- arm ---------------------------------------------------------------------------------------------------

    def _working(self, verb: str) -> Callable[[NamedArgs], Awaitable[Done]]:
        async def run(args: NamedArgs) -> Done:
            return await self._work(verb, args.object, DONE[verb])

        return run

    async def _work(self, verb: str, name: str, condition: str) -> Done:
        thing = self._world.check_reach(self._robot, name, self._driving.pose, what=verb)
        await self._wait(WORK_S)
        # Looked at again: it may have been carried off meanwhile.
        thing = self._world.check_reach(self._robot, name, self._driving.pose, what=verb)
        self._announce(self._world.become(self._robot, thing, condition))
        return Done({"object": thing.name, "condition": condition})

    async def _fasten(self, args: NamedToArgs) -> Done:
        if args.to:
            self._world.check_reach(self._robot, args.to, self._driving.pose, what="fasten a part to")
        return await self._work("fasten", args.object, f"fastened to {args.to}" if args.to else DONE["fasten"])

    async def _pour(self, args: PourArgs) -> Done:
        held = self._world.held_by(self._robot)
        if held is None or words(args.object) not in words(held.name):
            raise RobotFailure(
                "precondition",
                f"{self._robot} holds {f'the {held.name}' if held else 'nothing'}, not the {args.object[:60]}",
                remedy=f"pick the {args.object[:60]} first",
            )
        into = self._world.check_reach(self._robot, args.into, self._driving.pose, what="pour into")
        await self._wait(WORK_S)
        into = self._world.check_reach(self._robot, args.into, self._driving.pose, what="pour into")
        self._announce(self._world.become(self._robot, held, "empty"))
        self._announce(self._world.become(self._robot, into, f"holds what was in the {held.name}"))
        return Done({"object": held.name, "into": into.name})

    async def _push(self, args: NamedToArgs) -> Done:
        pose = self._driving.pose
        thing = self._world.check_pick(self._robot, args.object, pose)
        x, y = self._pushed_to(thing, args.to, pose)
        way = [(x, y)]
        site = self._site()
        if (blocked := blocked_leg((*site.forbidden, *site.obstacles), (pose.x, pose.y), way)) is not None:
            raise RobotFailure("precondition", f"{blocked[1].name} is in the way of the {thing.name}")
        self._announce(self._world.pick(self._robot, thing))
        try:
            await self._drive(way, PUSH_MPS)
        finally:
            here = self._driving.pose
            held = self._world.held_by(self._robot)
            if held is not None:
                self._announce(self._world.place(self._robot, held, *self._world.free_spot(here.x, here.y)))
        return Done({"object": thing.name, "to": args.to, "pushed_m": round(math.hypot(x - pose.x, y - pose.y), 2)})

    def _pushed_to(self, thing: Thing, to: str, pose: Pose) -> tuple[float, float]:
        if to:
            place = self._world.site.find(to)
            if place is None:
                known = ", ".join(sorted(self._world.site.places))
                raise RobotFailure("not-found", f"the site has no place {to[:60]!r}", remedy=f"places: {known}")
            return place.x, place.y
        away = math.radians(bearing_deg(thing.x - pose.x, thing.y - pose.y))
        return pose.x + STEP_M * math.sin(away), pose.y + STEP_M * math.cos(away)

    # --- base --------------------------------------------------------------------------------------------------

    async def _follow(self, args: FollowArgs) -> Done:
        in_range("follow", "duration_s", args.duration_s, 0.1, _MAX_S)
        in_range("follow", "distance_m", args.distance_m, 0.5, 50.0)
        check_speed(self._world.site, args.speed_mps, verb="follow")
        driven, seen = self._driving.driven_m, dict[str, tuple[float, float]]()
        name = words(args.target).replace(" ", "_")

        def see(key: str, info: RobotInfo | None) -> None:
            del key
            if info is not None and info.pose is not None:
                seen[info.id] = (info.pose.x, info.pose.y)

        closer = self._session.subscribe_typed(keyspace.ROBOT, see, name) if _is_name(name) else None
        began = time.monotonic()
        lost = True
        try:
            while time.monotonic() - began < args.duration_s:
                target = seen.get(name) or self._person(args.target)
                if target is None and time.monotonic() - began > 2.0:
                    raise RobotFailure(
                        "not-found", f"there is no {args.target[:60]!r} to be seen", remedy="name a robot"
                    )
                lost = target is None or not self._keep_behind(target, args)
                await asyncio.sleep(_TICK_S)
        finally:
            self._driving.halt()
            if closer is not None:
                closer.close()
        return Done({"driven_m": round(self._driving.driven_m - driven, 2), "in_sight": not lost})

    def _keep_behind(self, target: tuple[float, float], args: FollowArgs) -> bool:
        """Go towards a target up to the distance kept; False where something is in between: it waits."""
        here = (self._driving.x, self._driving.y)
        gap = math.dist(here, target)
        if gap <= args.distance_m + 0.2:
            self._driving.halt()
            return True
        share = (gap - args.distance_m) / gap
        point = (here[0] + share * (target[0] - here[0]), here[1] + share * (target[1] - here[1]))
        site = self._site()
        if blocked_leg((*site.forbidden, *site.obstacles), here, [point]) is not None:
            self._driving.halt()
            return False
        self._driving.go([point], args.speed_mps)
        return True

    def _person(self, name: str) -> tuple[float, float] | None:
        for person in self._world.site.people:
            place = self._world.site.find(person.at)
            if place is not None and words(person.name) == words(name):
                return place.x, place.y
        return None

    # --- sensors -----------------------------------------------------------------------------------------------

    async def _measure(self, args: MeasureArgs) -> Done:
        await self._wait(0.5)
        pose, quantity = self._driving.pose, words(args.quantity)
        if "distance" in quantity.split():
            view = aim(self._world, args.target, pose, camera.EYE_M)
            if not args.target or not view.known:
                raise RobotFailure("not-found", f"there is no {args.target[:60]!r} to be measured to")
            return Done({"number": round(view.distance_m, 2), "unit": "m"})
        if "temperature" in quantity.split():
            thing = self._world.find(args.target, pose.x, pose.y) if args.target else None
            return Done(
                {"number": camera.WARM_C if thing is not None and thing.state == ON else camera.AIR_C, "unit": "°C"}
            )
        if "sound" in quantity.split() or "noise" in quantity.split():
            loud = self._hum()
            return Done({"number": round(30.0 + 40.0 * loud, 1), "unit": "dB"})
        raise RobotFailure(
            "not-found",
            f"{self._robot} has no sensor for {args.quantity[:60]!r}",
            remedy="distance, temperature, sound",
        )

    def _hum(self) -> float:
        """Loudness of the devices that are on about here, 0 to 1."""
        pose = self._driving.pose
        gaps = [math.hypot(each.x - pose.x, each.y - pose.y) for each in self._world.things if each.state == ON]
        return max((max(0.0, 1.0 - gap / HUM_M) for gap in gaps), default=0.0)

    async def _listen(self, args: ListenArgs) -> Done:
        in_range("listen", "duration_s", args.duration_s, 0.1, 120.0)
        await self._wait(args.duration_s)
        at = np.arange(round(args.duration_s * SOUND_HZ)) / SOUND_HZ
        samples = (8000.0 * self._hum() * np.sin(math.tau * HUM_HZ * at)).astype(np.int16)
        out = io.BytesIO()
        with wave.open(out, "wb") as file:
            file.setnchannels(1)
            file.setsampwidth(2)
            file.setframerate(SOUND_HZ)
            file.writeframes(array.array("h", samples.tolist()).tobytes())
        return Done({"duration_s": args.duration_s}, {"sound.wav": out.getvalue()})

    async def _thermal(self, args: ThermalArgs) -> Done:
        await self._wait(0.5)
        pose = self._driving.pose
        view = aim(self._world, args.target, pose, camera.EYE_M)
        celsius = await asyncio.to_thread(camera.temperatures, self._world, pose, view, robot=self._robot)
        kelvin = np.round((celsius + 273.15) * 100.0).astype(np.uint16)
        out = io.BytesIO()
        Image.fromarray(kelvin).save(out, "PNG")
        return Done({"target": args.target, "known": view.known}, {"thermal.png": out.getvalue()})

    async def _scan(self, args: NoArgs) -> Done:  # noqa: ARG002 - verbs have one shape
        await self._wait(0.2)
        pose = self._driving.pose
        bearings = np.radians(np.arange(SCAN_STEPS) * 360.0 / SCAN_STEPS)
        reach = camera.reach(self._site(), pose, bearings, SCAN_MOST_M)
        return Done(
            {
                "from_deg": 0.0,
                "step_deg": 360.0 / SCAN_STEPS,
                "most_m": SCAN_MOST_M,
                "ranges_m": [round(float(each), 3) if each < SCAN_MOST_M else None for each in reach],
                "pose": {"x": pose.x, "y": pose.y, "z": pose.z, "heading_deg": pose.heading_deg},
            }
        )


def _is_name(name: str) -> bool:
    return bool(name) and all(each.isalnum() or each in "_.-" for each in name) and name.isascii()
