"""What a vehicle carries: camera, gimbal, gripper, servo outputs, and a voice.

Camera and gimbal by their protocols (mavlink.io: Camera Protocol v2, Gimbal Protocol v2): a camera or gimbal that
beats as a component of its own is addressed itself, else the autopilot, which then stands in for it. What these
protocols confirm is waited for; where a component confirms nothing, the answer says so (`confirmed`).
"""

import asyncio
import math
import secrets

from appliance.robots.executor import Done, Terms, verb
from appliance.robots.mavlink import dialect, statustext
from appliance.robots.mavlink.controller import VehicleController
from appliance.robots.mavlink.dialect import Message, constant, make
from appliance.robots.mavlink.protocols import ask, command, command_at
from appliance.robots.mavlink.statustext import MAX_PARTS, PART
from appliance.robots.verbs import (
    GimbalArgs,
    GripperArgs,
    RobotFailure,
    SayArgs,
    ServoArgs,
    TriggerArgs,
    VideoArgs,
    in_range,
)

_CAPTURED, _CAPTURE_STATUS, _MANAGER = (
    constant(f"MAVLINK_MSG_ID_{name}")
    for name in ("CAMERA_IMAGE_CAPTURED", "CAMERA_CAPTURE_STATUS", "GIMBAL_MANAGER_INFORMATION")
)
_CONFIGURE = constant("MAV_CMD_DO_GIMBAL_MANAGER_CONFIGURE")
_MYSELF, _UNCHANGED = -2.0, -1.0
_SHUTTER_S = 3.0
"""How long a camera takes for a picture before it is asked for it."""
_GIMBAL_S = 6.0
_BEATS_S = 2.2
"""Two heartbeats: a vehicle that has just come may have told of its autopilot alone."""
_NEAR_DEG = 3.0
MAX_PICTURES = 100
MAX_WORDS = MAX_PARTS * PART
MAX_TUNE = 230
_NOTICE = 5
"""MAV_SEVERITY_NOTICE."""
_TUNE = "MFT200L16<cdefgab>cdefgab"
"""What is played before words, so that people look up: two quick scales (MML)."""


class Payload:
    """Of one craft. Autopilots refuse what they do not have."""

    def __init__(self, craft: VehicleController) -> None:
        self._craft = craft
        self._manager: int | None = None

    # --- camera ------------------------------------------------------------------------------------------------

    @verb(Terms(uses=("camera",), resumable=False, guarded=False))
    async def trigger(self, args: TriggerArgs) -> Done:
        """Take pictures; each has a number, which distinguishes a repeated order from a further one."""
        in_range("trigger", "count", args.count, 1, MAX_PICTURES)
        in_range("trigger", "interval_s", args.interval_s, 0.0, 3600.0)
        images: list[dict[str, object]] = []
        for number in range(args.count):
            if number:
                await asyncio.sleep(args.interval_s)
            taken = await self._picture()
            if taken is not None:
                images.append(taken)
        return Done({"count": args.count, "confirmed": len(images), "images": images} | self._craft.where())

    async def _picture(self) -> dict[str, object] | None:
        craft = self._craft
        vehicle = craft.vehicle
        camera = await self._component(dialect.TYPE_CAMERA)
        # Far from what other stations count up from 1, and below what a float holds exactly.
        number = 1_000_000 + secrets.randbelow(15_000_000)
        async with vehicle.listening("CAMERA_IMAGE_CAPTURED") as answers:
            await command(
                vehicle, dialect.IMAGE_START, 0.0, 0.0, 1.0, float(number), patience=craft.patience, component=camera
            )
            told = await _first(answers, _SHUTTER_S)
            if told is None and camera is not None:
                # The news of it was lost: it is asked for. 0 is the newest (MAV_CMD_REQUEST_MESSAGE).
                await ask(vehicle, dialect.REQUEST_MESSAGE, _CAPTURED, 0.0, patience=craft.patience, component=camera)
                told = await _first(answers, _SHUTTER_S)
        if told is None:
            return None
        if told.capture_result != 1:
            raise RobotFailure(
                "robot", f"the camera of {vehicle.name} could not take the picture", remedy="look at it", retryable=True
            )
        x, y, z = craft.site_point(told.lat / 1e7, told.lon / 1e7, told.alt / 1e3)
        url = told.file_url.decode("utf-8", "replace") if isinstance(told.file_url, bytes) else str(told.file_url)
        where = {"x": round(x, 2), "y": round(y, 2), "z": round(z, 2)}
        return {"index": int(told.image_index), "file_url": url.rstrip("\0"), "position": where}

    @verb(Terms(uses=("camera",), guarded=False))
    async def video(self, args: VideoArgs) -> Done:
        """Start or stop recording; confirmed by the camera's own status."""
        craft = self._craft
        vehicle = craft.vehicle
        camera = await self._component(dialect.TYPE_CAMERA)
        starts = args.action == "start"
        number = dialect.VIDEO_START if starts else dialect.VIDEO_STOP
        await command(vehicle, number, 0.0, 0.0, patience=craft.patience, component=camera)
        recording = None
        if camera is not None:
            async with vehicle.listening("CAMERA_CAPTURE_STATUS") as answers:
                await ask(vehicle, dialect.REQUEST_MESSAGE, _CAPTURE_STATUS, patience=craft.patience, component=camera)
                status = await _first(answers, _SHUTTER_S)
            recording = None if status is None else bool(status.video_status)
            if recording is not None and recording != starts:
                doing = "does not record" if starts else "still records"
                raise RobotFailure(
                    "robot", f"the camera of {vehicle.name} {doing}", remedy="look at it", retryable=True
                )
        return Done({"recording": starts, "confirmed": recording is not None} | craft.where())

    async def _component(self, kind: int) -> int | None:
        """Return the component of that MAV_TYPE; one that has not beaten for two seconds is none."""
        vehicle = self._craft.vehicle
        await self._craft.confirm(lambda: vehicle.component_of(kind) is not None, within_s=_BEATS_S)
        return vehicle.component_of(kind)

    # --- gimbal ------------------------------------------------------------------------------------------------

    @verb(Terms(uses=("gimbal",), guarded=False))
    async def gimbal(self, args: GimbalArgs) -> Done:
        """Turn the gimbal to angles, or keep it on a point of the site.

        A gimbal that cannot turn sideways has its vehicle turn, so control is looked at before each sending.
        """
        craft = self._craft
        point = args.x is not None and args.y is not None
        if point == (args.pitch_deg is not None or args.yaw_deg is not None):
            raise RobotFailure("payload", "gimbal: give pitch_deg and yaw_deg, or x and y", remedy="one of the two")
        manager = await self._find_manager()
        if args.x is not None and args.y is not None:
            in_range("gimbal", "x", args.x, -1e4, 1e4)
            in_range("gimbal", "y", args.y, -1e4, 1e4)
            in_range("gimbal", "z", args.z, -1e3, 1e4)
            at = craft.globe_point(args.x, args.y, args.z)
            await command_at(
                craft.vehicle,
                dialect.LOOK_AT,
                at=at,
                patience=craft.patience,
                component=manager,
                frame=dialect.FRAME_GLOBAL,
                check=craft.check_control,
            )
            return Done({"at": {"x": args.x, "y": args.y, "z": args.z}} | craft.where())
        pitch, yaw = args.pitch_deg or 0.0, args.yaw_deg or 0.0
        in_range("gimbal", "pitch_deg", pitch, -90.0, 90.0)
        in_range("gimbal", "yaw_deg", yaw, -180.0, 180.0)
        async with craft.vehicle.listening("GIMBAL_DEVICE_ATTITUDE_STATUS") as answers:
            nothing = math.nan
            await command(
                craft.vehicle,
                dialect.GIMBAL_ANGLES,
                pitch,
                yaw,
                nothing,
                nothing,
                0.0,
                0.0,
                0.0,
                patience=craft.patience,
                component=manager,
                check=craft.check_control,
            )
            confirmed = await _turned(answers, pitch)
        return Done({"pitch_deg": pitch, "yaw_deg": yaw, "confirmed": confirmed} | craft.where())

    async def _find_manager(self) -> int:
        """Return the component that manages the gimbal, in control of which this gateway is afterwards."""
        craft = self._craft
        vehicle = craft.vehicle
        if self._manager is None:
            gimbal = await self._component(dialect.TYPE_GIMBAL)
            for candidate in (gimbal, vehicle.component):
                if candidate is None:
                    continue
                asked = await ask(
                    vehicle, dialect.REQUEST_MESSAGE, _MANAGER, patience=craft.patience, component=candidate
                )
                if asked.result == dialect.ACCEPTED:
                    self._manager = candidate
                    break
            else:
                raise RobotFailure(
                    "robot", f"{vehicle.name} has no gimbal that answers", remedy="look whether it is powered"
                )
        control = (_MYSELF, _MYSELF, _UNCHANGED, _UNCHANGED)
        await ask(
            vehicle,
            _CONFIGURE,
            *control,
            patience=craft.patience,
            component=self._manager,
            check=craft.check_control,
        )
        return self._manager

    # --- gripper, servo, voice ---------------------------------------------------------------------------------

    @verb(Terms(uses=("gripper",), guarded=False))
    async def gripper(self, args: GripperArgs) -> Done:
        """Grab or release."""
        in_range("gripper", "instance", args.instance, 1, 8)
        closes = 1.0 if args.action == "grab" else 0.0
        vehicle = self._craft.vehicle
        await command(vehicle, dialect.GRIPPER, float(args.instance), closes, patience=self._craft.patience)
        return Done({"gripper": args.action} | self._craft.where())

    @verb(Terms(uses=("servo",), guarded=False))
    async def servo(self, args: ServoArgs) -> Done:
        """Set an output that the configuration leaves to the gateway: among the others are motors and rudders."""
        config = self._craft.config
        if args.output not in config.servos:
            free = ", ".join(str(each) for each in config.servos) or "none"
            raise RobotFailure(
                "refused",
                f"output {args.output} of {self._craft.vehicle.name} is not the gateway's to set",
                remedy=f"robots.servos names those that are: {free}",
            )
        in_range("servo", "pwm_us", args.pwm_us, 800, 2200)
        vehicle, patience = self._craft.vehicle, self._craft.patience
        await command(vehicle, dialect.SERVO, float(args.output), float(args.pwm_us), patience=patience)
        return Done({"output": args.output, "pwm_us": args.pwm_us} | self._craft.where())

    @verb(Terms(uses=("speaker",), resumable=False, guarded=False))
    async def say(self, args: SayArgs) -> Done:
        """Show words at the vehicle and on all ground stations, and play a tune. Nothing of it is acknowledged."""
        vehicle = self._craft.vehicle
        words = " ".join(args.text.split())
        if not words and not args.tune:
            raise RobotFailure("payload", "say: neither text nor tune", remedy="give one of them")
        if len(args.tune) > MAX_TUNE or not args.tune.isascii():
            raise RobotFailure("payload", f"say: a tune has up to {MAX_TUNE} ASCII characters")
        data = words.encode("utf-8")
        if len(data) > MAX_WORDS:
            raise RobotFailure("payload", f"say: {len(data)} bytes of text, {MAX_WORDS} are possible")
        tune = (args.tune or _TUNE).encode("ascii")
        vehicle.send(
            make(
                "PLAY_TUNE",
                target_system=vehicle.system,
                target_component=vehicle.component,
                tune=tune[:30],
                tune2=tune[30:],
            )
        )
        for each in statustext.parts(data, _NOTICE):
            vehicle.announce(each)
        return Done({"said": words, "tune": tune.decode(), "acknowledged": False} | self._craft.where())


async def _first(answers: asyncio.Queue[Message], within_s: float) -> Message | None:
    """Return the next message, None when none comes."""
    try:
        async with asyncio.timeout(within_s):
            return await answers.get()
    except TimeoutError:
        return None


async def _turned(answers: asyncio.Queue[Message], pitch_deg: float) -> bool:
    """Wait until the gimbal says that it is at a pitch; False when it says nothing, or does not get there."""
    try:
        async with asyncio.timeout(_GIMBAL_S):
            while True:
                w, x, y, z = (await answers.get()).q
                if not all(math.isfinite(each) for each in (w, x, y, z)):
                    continue  # not known: no angle
                pitch = math.degrees(math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x)))))
                if abs(pitch - pitch_deg) <= _NEAR_DEG:
                    return True
    except TimeoutError:
        return False
