"""The camera and the gimbal of a simulated vehicle: components of their own, which beat and answer for themselves.

Camera Protocol v2 and Gimbal Protocol v2 (mavlink.io) as far as stations use them: information, capture with a sequence
number that makes a repeated order one picture, status, recording; a gimbal manager that must be asked for control,
limits, angles at a bounded rate, a point to look at. No I/O.
"""

import math
from typing import TYPE_CHECKING

from appliance.model.site import to_site
from appliance.robots.mavlink import dialect
from appliance.robots.mavlink.dialect import Frame, Message, constant, make

if TYPE_CHECKING:
    from workshop.robots.autopilot import AnyAutopilot

_KEPT = 200
GIMBAL_DPS = 60.0
PITCH_DEG = (-90.0, 30.0)
YAW_DEG = (-160.0, 160.0)
_CONFIGURE = constant("MAV_CMD_DO_GIMBAL_MANAGER_CONFIGURE")
_CONTROLS = -2
_INFORMATION, _SETTINGS, _STORAGE, _STATUS, _CAPTURED, _MANAGER, _MANAGER_STATUS, _ATTITUDE = (
    constant(f"MAVLINK_MSG_ID_{name}")
    for name in (
        "CAMERA_INFORMATION",
        "CAMERA_SETTINGS",
        "STORAGE_INFORMATION",
        "CAMERA_CAPTURE_STATUS",
        "CAMERA_IMAGE_CAPTURED",
        "GIMBAL_MANAGER_INFORMATION",
        "GIMBAL_MANAGER_STATUS",
        "GIMBAL_DEVICE_ATTITUDE_STATUS",
    )
)


class Component:
    """A component under its vehicle's system id."""

    number: int
    kind: int

    def __init__(self, vehicle: "AnyAutopilot") -> None:
        self._vehicle = vehicle
        self._beat_at = -math.inf
        self._boot_ms = 0

    def handle(self, frame: Frame) -> list[Message]:
        """Take in a message that may be for this component; return the answers."""
        message = frame.message
        if frame.name not in ("COMMAND_LONG", "COMMAND_INT"):
            return []
        if message.target_system not in (0, self._vehicle.system) or message.target_component != self.number:
            return []
        result, extra = self._do(int(message.command), message, (frame.system, frame.component))
        ack = make(
            "COMMAND_ACK",
            command=message.command,
            result=result,
            progress=0,
            result_param2=0,
            target_system=frame.system,
            target_component=frame.component,
        )
        return [ack, *extra]

    def step(self, dt: float, now: float) -> list[Message]:
        """Go on by `dt` simulated seconds; beat once a second."""
        self._boot_ms = round(self._vehicle.clock * 1000)
        said = self._move(dt)
        if now - self._beat_at >= 1.0:
            self._beat_at = now
            said.append(
                make(
                    "HEARTBEAT",
                    type=self.kind,
                    autopilot=dialect.AUTOPILOT_NONE,
                    base_mode=0,
                    custom_mode=0,
                    system_status=dialect.STATE_ACTIVE,
                    mavlink_version=3,
                )
            )
        return said

    def _move(self, dt: float) -> list[Message]:
        del dt
        return []

    def _do(self, command: int, message: Message, sender: tuple[int, int]) -> tuple[int, list[Message]]:
        raise NotImplementedError


class SimCamera(Component):
    """Takes pictures that it keeps, and records."""

    number = dialect.COMPONENT_CAMERA
    kind = dialect.TYPE_CAMERA

    def __init__(self, vehicle: "AnyAutopilot") -> None:
        super().__init__(vehicle)
        self.taken: list[Message] = []
        """CAMERA_IMAGE_CAPTURED of each picture, the last ones kept."""
        self.count = 0
        self.recording_since: float | None = None
        self._sequence: int | None = None

    def _do(self, command: int, message: Message, sender: tuple[int, int]) -> tuple[int, list[Message]]:
        del sender
        match command:
            case dialect.REQUEST_MESSAGE:
                told = self._requested(int(message.param1), int(message.param2))
                return (dialect.UNSUPPORTED, []) if told is None else (dialect.ACCEPTED, [told])
            case dialect.IMAGE_START:
                sequence = int(message.param4)
                if sequence and sequence == self._sequence:
                    return dialect.ACCEPTED, self.taken[-1:]  # the same order again
                self._sequence = sequence
                return dialect.ACCEPTED, [self.take()]
            case dialect.VIDEO_START:
                if self.recording_since is None:
                    self.recording_since = self._vehicle.clock
                return dialect.ACCEPTED, []
            case dialect.VIDEO_STOP:
                self.recording_since = None
                return dialect.ACCEPTED, []
            case _:
                return dialect.UNSUPPORTED, []

    def take(self) -> Message:
        """Take a picture."""
        latitude, longitude, altitude = self._vehicle.where()
        self.count += 1
        picture = make(
            "CAMERA_IMAGE_CAPTURED",
            time_boot_ms=self._boot_ms,
            time_utc=0,
            camera_id=1,
            lat=round(latitude * 1e7),
            lon=round(longitude * 1e7),
            alt=round(altitude * 1e3),
            relative_alt=round(self._vehicle.flight.position.z * 1e3),
            q=[1.0, 0.0, 0.0, 0.0],
            image_index=self.count - 1,
            capture_result=1,
            file_url=f"sim://{self._vehicle.system}/{self.count - 1:05d}.jpg".encode(),
        )
        self.taken = [*self.taken, picture][-_KEPT:]
        return picture

    def _requested(self, number: int, index: int) -> Message | None:
        match number:
            case _ if number == _CAPTURED:
                wanted = [each for each in self.taken if not index or each.image_index == index]
                return wanted[-1] if wanted else None
            case _ if number == _STATUS:
                return self._status()
            case _ if number == _SETTINGS:
                return make("CAMERA_SETTINGS", time_boot_ms=self._boot_ms, mode_id=0)
            case _ if number == _STORAGE:
                return self._storage()
            case _ if number == _INFORMATION:
                return self._information()
            case _:
                return None

    def _status(self) -> Message:
        since = self.recording_since
        recorded = 0 if since is None else round((self._vehicle.clock - since) * 1000)
        return make(
            "CAMERA_CAPTURE_STATUS",
            time_boot_ms=self._boot_ms,
            image_status=0,
            video_status=0 if since is None else 1,
            image_interval=0.0,
            recording_time_ms=recorded,
            available_capacity=8000.0,
            image_count=self.count,
        )

    def _storage(self) -> Message:
        return make(
            "STORAGE_INFORMATION",
            time_boot_ms=self._boot_ms,
            storage_id=1,
            storage_count=1,
            status=2,
            total_capacity=8192.0,
            used_capacity=192.0,
            available_capacity=8000.0,
            read_speed=50.0,
            write_speed=20.0,
        )

    def _information(self) -> Message:
        flags = sum(
            constant(f"CAMERA_CAP_FLAGS_{name}")
            for name in ("CAPTURE_IMAGE", "CAPTURE_VIDEO", "CAN_CAPTURE_IMAGE_IN_VIDEO_MODE")
        )
        return make(
            "CAMERA_INFORMATION",
            time_boot_ms=self._boot_ms,
            vendor_name=list(b"swiftbot".ljust(32, b"\0")),
            model_name=list(b"simulated".ljust(32, b"\0")),
            firmware_version=1,
            focal_length=4.5,
            sensor_size_h=6.2,
            sensor_size_v=4.6,
            resolution_h=640,
            resolution_v=480,
            lens_id=0,
            flags=flags,
            cam_definition_version=0,
            cam_definition_uri=b"",
        )


class SimGimbal(Component):
    """Turns at a bounded rate within its limits, for the one in control of it."""

    number = dialect.COMPONENT_GIMBAL
    kind = dialect.TYPE_GIMBAL

    def __init__(self, vehicle: "AnyAutopilot") -> None:
        super().__init__(vehicle)
        self.pitch_deg = 0.0
        self.yaw_deg = 0.0
        self.control: tuple[int, int] = (0, 0)
        """System and component in control."""
        self._wanted = (0.0, 0.0)
        self._point: tuple[float, float, float] | None = None
        self._told_at = 0.0

    def _do(self, command: int, message: Message, sender: tuple[int, int]) -> tuple[int, list[Message]]:
        match command:
            case dialect.REQUEST_MESSAGE:
                told = self._requested(int(message.param1))
                return (dialect.UNSUPPORTED, []) if told is None else (dialect.ACCEPTED, [told])
            case _ if command == _CONFIGURE:
                if message.param1 == _CONTROLS:
                    self.control = sender
                elif message.param1 >= 0:
                    self.control = (int(message.param1), int(message.param2))
                return dialect.ACCEPTED, []
            case dialect.GIMBAL_ANGLES:
                if self.control != sender:
                    return dialect.DENIED, []
                pitch, yaw = float(message.param1), float(message.param2)
                if not (PITCH_DEG[0] <= pitch <= PITCH_DEG[1] and YAW_DEG[0] <= yaw <= YAW_DEG[1]):
                    return dialect.DENIED, []
                self._wanted, self._point = (pitch, yaw), None
                return dialect.ACCEPTED, []
            case dialect.LOOK_AT:
                if self.control != sender:
                    return dialect.DENIED, []
                whole = hasattr(message, "z")
                latitude = message.x / 1e7 if whole else message.param5
                longitude = message.y / 1e7 if whole else message.param6
                height = message.z if whole else message.param7
                self._point = to_site(self._vehicle.site, latitude, longitude, height)
                return dialect.ACCEPTED, []
            case _:
                return dialect.UNSUPPORTED, []

    def _move(self, dt: float) -> list[Message]:
        vehicle = self._vehicle
        if self._point is not None:
            here = vehicle.flight.position
            east = self._point[0] - vehicle.home[0] - here.x
            north = self._point[1] - vehicle.home[1] - here.y
            down = math.degrees(math.atan2(self._point[2] - here.z, max(math.hypot(east, north), 0.01)))
            aside = math.degrees(math.atan2(east, north)) - vehicle.flight.heading_deg
            self._wanted = (down, math.remainder(aside, 360.0))
        most = GIMBAL_DPS * dt
        pitch, yaw = (
            max(low, min(high, wanted)) for wanted, (low, high) in zip(self._wanted, (PITCH_DEG, YAW_DEG), strict=True)
        )
        self.pitch_deg += max(-most, min(most, pitch - self.pitch_deg))
        self.yaw_deg += max(-most, min(most, yaw - self.yaw_deg))
        if vehicle.clock - self._told_at < 0.5:
            return []
        self._told_at = vehicle.clock
        return [self._attitude()]

    def _requested(self, number: int) -> Message | None:
        low, high = (math.radians(each) for each in PITCH_DEG)
        left, right = (math.radians(each) for each in YAW_DEG)
        if number == _MANAGER:
            return make(
                "GIMBAL_MANAGER_INFORMATION",
                time_boot_ms=self._boot_ms,
                cap_flags=0,
                gimbal_device_id=self.number,
                roll_min=0.0,
                roll_max=0.0,
                pitch_min=low,
                pitch_max=high,
                yaw_min=left,
                yaw_max=right,
            )
        if number == _MANAGER_STATUS:
            return make(
                "GIMBAL_MANAGER_STATUS",
                time_boot_ms=self._boot_ms,
                flags=0,
                gimbal_device_id=self.number,
                primary_control_sysid=self.control[0],
                primary_control_compid=self.control[1],
                secondary_control_sysid=0,
                secondary_control_compid=0,
            )
        return self._attitude() if number == _ATTITUDE else None

    def _attitude(self) -> Message:
        pitch, yaw = math.radians(self.pitch_deg) / 2, math.radians(self.yaw_deg) / 2
        turned = [
            math.cos(pitch) * math.cos(yaw),
            -math.sin(pitch) * math.sin(yaw),
            math.sin(pitch) * math.cos(yaw),
            math.cos(pitch) * math.sin(yaw),
        ]
        return make(
            "GIMBAL_DEVICE_ATTITUDE_STATUS",
            target_system=0,
            target_component=0,
            time_boot_ms=self._boot_ms,
            flags=0,
            q=turned,
            angular_velocity_x=0.0,
            angular_velocity_y=0.0,
            angular_velocity_z=0.0,
            failure_flags=0,
        )
